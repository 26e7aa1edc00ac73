"""The vehicle's cameras: their schedule, their images, and their publication."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.exposure import exposure_by
from airl_mav.camera.frame import Frame, FurtherImage
from airl_mav.camera.imaging import ImageFormation
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.noise import noise_of, noisy_frame
from airl_mav.camera.render import Motion, Mount, camera_pose
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import Vector
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.camera_kind import Renderer
from airl_mav.profiles.conditions import SensorNoise
from firmware_sim.plant.sensors import Rate


class _Eye:
    """One of a vehicle's cameras: what it sees when it is triggered."""

    def __init__(
        self, camera: Camera, arena: Arena, noise: SensorNoise, renderer: Renderer, name: str = ""
    ) -> None:
        """Take the camera, its arena, conditions, the renderer, and a further camera's name."""
        self._expose = exposure_by(renderer, name)
        self._noise = noise_of(camera, noise, name)
        self._forming = ImageFormation(camera, name) if camera.imaging is not None else None
        self.intrinsics = Intrinsics.of(camera)
        self._mount, self._max_range = Mount.of(camera), camera.range_m
        self._arena = arena
        self.follows = self._forming is not None and self._forming.follows
        """Whether an image depends on the one before."""

    def restart(self) -> None:
        """Begin an episode."""
        if self._forming is not None:
            self._forming.restart()

    def take(self, elapsed_us: int, motion: Motion, seed: int, number: int) -> FurtherImage:
        """Return an image of an episode.

        Args:
            elapsed_us: Time since the episode's start [µs].
            motion: How the vehicle moves then.
            seed: Of the episode.
            number: The image's in the episode, by the rate.
        """
        image: NDArray[Any]
        jpeg = None
        if self._forming is not None:
            image, jpeg = self._forming.take(self._arena, elapsed_us, motion, seed, number)
        else:
            at, attitude = camera_pose(motion.position, motion.quaternion, self._mount)
            centers = self._arena.centers_at(elapsed_us)
            image = self._expose(
                *(self._arena, centers, self.intrinsics, self._max_range, at, attitude), number
            )
        if self._noise is not None:
            image = noisy_frame(image, self._noise, seed, number)
        return FurtherImage(image, self.intrinsics, jpeg)


class ExposedFrame(Frame):
    """A frame whose images are drawn when one of them is first read: few of them are."""

    def __init__(
        self,
        sequence: int,
        capture_time_us: int,
        intrinsics: Intrinsics,
        draw: Callable[[], Mapping[str, FurtherImage]],
    ) -> None:
        """Take what a frame has, and what draws the images: by camera, "" is the main one."""
        exposed = {"sequence": sequence, "capture_time_us": capture_time_us}
        vars(self).update(exposed, intrinsics=intrinsics, draw=draw)

    @cached_property
    def images(self) -> Mapping[str, FurtherImage]:
        """All images, by camera."""
        draw: Callable[[], Mapping[str, FurtherImage]] = vars(self)["draw"]
        return draw()

    @property
    def image(self) -> NDArray[Any]:
        """The main camera's image."""
        return self.images[""].image

    @property
    def jpeg(self) -> bytes | None:
        """The file that it was decoded from; None: it was never compressed."""
        return self.images[""].jpeg

    @cached_property
    def further(self) -> Mapping[str, FurtherImage]:
        """Those of the further cameras, by name."""
        return {name: each for name, each in self.images.items() if name}

    def __reduce__(self) -> tuple[type[Frame], tuple[Any, ...]]:
        """Return a frame with its images: another process has no camera to draw them."""
        shown = self.image, self.intrinsics, self.jpeg, self.further
        return Frame, (self.sequence, self.capture_time_us, *shown)


class SimulatedCamera:
    """Takes frames of an arena at a fixed rate, from a vehicle's pose: images of all cameras."""

    def __init__(
        self,
        camera: Camera,
        arena: Arena,
        start_us: int = 0,
        noise: SensorNoise | None = None,
        seed: int = 0,
        renderer: Renderer = "raycast",
        further: Mapping[str, Camera] | None = None,
    ) -> None:
        """Make the cameras of a vehicle profile.

        Args:
            camera: The main camera.
            arena: What it sees.
            start_us: When the first frame is due [µs].
            noise: Conditions that its images are taken in; None: the usual ones.
            seed: Of that noise.
            renderer: What draws its images.
            further: Those that are triggered with it, by name; None: there are none.
        """
        asked = noise or SensorNoise()
        cameras = {"": camera, **(further or {})}
        self._eyes = {
            name: _Eye(each, arena, asked, renderer, name) for name, each in cameras.items()
        }
        self._intrinsics = self._eyes[""].intrinsics
        self._in_order = any(each.follows for each in self._eyes.values())
        self._seed = seed
        self._rate_hz = camera.rate_hz
        self._sequence = 0
        # The first picture loads or compiles the kernels: better here than in flight.
        at_rest = Motion.at_rest(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        for each in self._eyes.values():
            each.take(0, at_rest, seed, 0)
        self.restart(start_us)

    def restart(self, time_us: int) -> None:
        """Begin an episode, and with it its moving obstacles: the next frame is due at `time_us`.

        Sequence numbers go on, so that no frame of the new episode is taken for an old one.
        """
        self._start_us = self.next_us = time_us
        """`next_us`: simulated time from which on the next frame is due [µs]."""
        self._rate = Rate(self._rate_hz)
        for each in self._eyes.values():
            each.restart()

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Take a frame that is due and hand it to `publish`; see `take`."""
        publish(self.take(time_us, motion))

    def capture(self, time_us: int, position: Vector, quaternion: Vector) -> Frame:
        """Take a frame that is due of a vehicle at rest; see `take`."""
        return self.take(time_us, Motion.at_rest(position, quaternion))

    def take(self, time_us: int, motion: Motion) -> Frame:
        """Take a frame that is due; the next is due one period after the slot that this one fills.

        Slots lie at whole multiples of the period, so that a rate that the tick does not divide
        is kept on average. Slots that were missed are left out.

        It is exposed at simulated `time_us` [µs], which is the middle of an exposure that takes
        time, from where the vehicle is then; `motion` is kept, not copied. The images are drawn
        when they are read, unless one of them depends on the one before.
        """
        elapsed_us = time_us - self._start_us
        self._rate.due(elapsed_us)
        self.next_us = self._start_us + math.ceil(self._rate.next_us)
        seen = elapsed_us, motion, self._seed, self._rate.period

        def draw() -> Mapping[str, FurtherImage]:
            return {name: each.take(*seen) for name, each in self._eyes.items()}

        frame = ExposedFrame(self._sequence, time_us, self._intrinsics, draw)
        if self._in_order:
            _ = frame.images
        self._sequence += 1
        return frame


class CameraServer:
    """Publishes frames over ZeroMQ; a subscriber gets the newest, or none, never a queue.

    Publishing does not block: a slow or stopped companion cannot hold the simulator.
    """

    awaited = True

    def __init__(
        self, endpoint: str, context: zmq.Context[zmq.Socket[bytes]] | None = None
    ) -> None:
        """Bind.

        Args:
            endpoint: As "tcp://127.0.0.1:5560"; port 0 or * lets the system choose one.
            context: A ZeroMQ context to share; None = one of its own.

        Raises:
            UsageError: The port is taken, or the endpoint is none.
        """
        self._owns_context = context is None
        self._context = zmq.Context() if context is None else context
        self._socket = self._context.socket(zmq.PUB)
        # Not a high-water mark of 1: that keeps the oldest frame and drops the newest.
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self.close()
            if error.errno == zmq.EADDRINUSE:
                port = endpoint.rsplit(":", 1)[-1]
                raise UsageError(
                    f"camera port {port} is taken ({endpoint}); choose another with --camera-port"
                ) from error
            raise UsageError(
                f"camera endpoint {endpoint!r}: {error}; accepted: tcp://ADDRESS:PORT, ipc://PATH"
            ) from error
        self.endpoint: str = self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rstrip("\0")
        """Where subscribers connect, with the port that was chosen."""

    def publish(self, frame: Frame) -> None:
        """Offer a frame to whoever is connected, in place of any that is still waiting."""
        self._socket.send(frame.to_bytes(), zmq.NOBLOCK)

    def close(self) -> None:
        """Disconnect all subscribers and free the port."""
        self._socket.close(linger=0)
        if self._owns_context:
            self._context.term()

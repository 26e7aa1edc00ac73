"""Cameras of the vehicle: schedule, images, and publication."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import zmq
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame, FurtherImage
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.noise import noise_of, noisy_frame
from airl_mav.camera.render import Motion, Mount, camera_pose, colour, expose
from airl_mav.core import constants, errors
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import SensorNoise
from firmware_sim.engine.ticks import is_due


class _Eye:
    """Single camera of a vehicle, for images on a trigger."""

    def __init__(self, camera: Camera, arena: Arena, noise: SensorNoise, name: str = "") -> None:
        """Store camera, arena and conditions; `name` is an additional camera's."""
        self._noise = noise_of(camera, noise, name)
        self._forming = colour("sensor")(camera, name) if camera.imaging is not None else None
        self.intrinsics = Intrinsics.of(camera)
        self._mount, self._max_range = Mount.of(camera), camera.range_m
        self._arena = arena
        self.follows = self._forming is not None and self._forming.follows
        """True if an image depends on the previous one."""

    def restart(self) -> None:
        """Start an episode."""
        if self._forming is not None:
            self._forming.restart()

    def take(self, elapsed_us: int, motion: Motion, seed: int, number: int) -> FurtherImage:
        """Return an image of an episode, `elapsed_us` [µs] after its start, in a motion.

        `number` counts the images of the episode, from the frame rate.
        """
        image: NDArray[Any]
        jpeg = None
        if self._forming is not None:
            # `ImageFormation` makes the image and its JPEG file.
            image, jpeg = self._forming.take(self._arena, elapsed_us, motion, seed, number)
        else:
            at, attitude = camera_pose(motion.position, motion.quaternion, self._mount)
            centers = self._arena.centers_at(elapsed_us)
            image = expose(self._arena, centers, self.intrinsics, self._max_range, at, attitude)
        if self._noise is not None:
            image = noisy_frame(image, self._noise, seed, number)
        return FurtherImage(image, self.intrinsics, jpeg)


class ExposedFrame(Frame):
    """Frame with images that are rendered on first access, because few are read."""

    def __init__(
        self,
        sequence: int,
        capture_time_us: int,
        intrinsics: Intrinsics,
        draw: Callable[[], Mapping[str, FurtherImage]],
    ) -> None:
        """Store the fields and the renderer of images by camera; "" is the main camera."""
        exposed = {"sequence": sequence, "capture_time_us": capture_time_us}
        # Frame is frozen: write its fields past its `__setattr__`.
        vars(self).update(exposed, intrinsics=intrinsics, draw=draw)

    @cached_property
    def images(self) -> Mapping[str, FurtherImage]:
        """All images, by camera name."""
        draw: Callable[[], Mapping[str, FurtherImage]] = vars(self)["draw"]
        return draw()

    @property
    def image(self) -> NDArray[Any]:
        """Image of the main camera."""
        return self.images[""].image

    @property
    def jpeg(self) -> bytes | None:
        """JPEG file of the image; None = never compressed."""
        return self.images[""].jpeg

    @cached_property
    def further(self) -> Mapping[str, FurtherImage]:
        """Images of the additional cameras, by name."""
        return {name: each for name, each in self.images.items() if name}

    def __reduce__(self) -> tuple[type[Frame], tuple[Any, ...]]:
        """Return a frame with its images: another process has no camera to render them."""
        shown = self.image, self.intrinsics, self.jpeg, self.further
        return Frame, (self.sequence, self.capture_time_us, *shown)


class SimulatedCamera:
    """Camera that takes frames of an arena at a fixed rate, with images of all cameras."""

    def __init__(
        self,
        camera: Camera,
        arena: Arena,
        start_us: int = 0,
        noise: SensorNoise | None = None,
        seed: int = 0,
        further: Mapping[str, Camera] | None = None,
    ) -> None:
        """Create the main camera of a vehicle profile, and additional ones on its trigger.

        The first frame is due at `start_us` [µs]; `noise` are the image conditions (None = the
        defaults), `seed` is the seed of the noise.
        """
        asked = noise or SensorNoise()
        cameras = {"": camera, **(further or {})}
        self._eyes = {name: _Eye(each, arena, asked, name) for name, each in cameras.items()}
        self._intrinsics = self._eyes[""].intrinsics
        self._in_order = any(each.follows for each in self._eyes.values())
        self._seed = seed
        self._rate_hz = camera.rate_hz
        self._sequence = 0
        # The first image loads or compiles the kernels: better here than in flight.
        at_rest = Motion.at_rest(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        for each in self._eyes.values():
            each.take(0, at_rest, seed, 0)
        self.restart(start_us)

    def restart(self, time_us: int) -> None:
        """Start an episode and its moving obstacles; the next frame is due at `time_us` [µs].

        Sequence numbers continue, so frames of different episodes are distinct.
        """
        self._start_us = self.next_us = time_us
        """`next_us`: simulated time at which the next frame is due [µs]."""
        self._schedule = np.array([self._rate_hz, 0.0, 0.0])
        for each in self._eyes.values():
            each.restart()

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Take a due frame and pass it to `publish`; see `take`."""
        publish(self.take(time_us, motion))

    def skip_unread(self, read_us: int) -> None:
        """Skip due frames that newer ones replace before `read_us`; see `OnboardCamera`."""
        # The next frame is exposed at the first tick after its slot.
        last_us = read_us - constants.US_PER_S / self._rate_hz - constants.TICK_US
        while self.next_us < last_us and not self._in_order:
            self._schedule_next(self.next_us)

    def _schedule_next(self, time_us: int) -> int:
        """Number the frame due at `time_us` [µs] and schedule the next; return the number."""
        is_due(self._schedule, time_us - self._start_us)
        self.next_us = self._start_us + math.ceil(self._schedule[1])
        self._sequence += 1
        return self._sequence - 1

    def take(self, time_us: int, motion: Motion) -> Frame:
        """Take a due frame; the next is due one period after the slot of this one.

        Slots are at whole multiples of the period, which keeps the average rate even if the tick
        does not divide the period. Missed slots are skipped.

        The exposure is at simulated `time_us` [µs], or centred on it if it takes time, from the
        vehicle's pose at that time; `motion` is kept, not copied. The images are rendered on
        access, unless an image depends on the previous one.
        """
        number = self._schedule_next(time_us)
        seen = time_us - self._start_us, motion, self._seed, int(self._schedule[2])

        def draw() -> Mapping[str, FurtherImage]:
            return {name: each.take(*seen) for name, each in self._eyes.items()}

        frame = ExposedFrame(number, time_us, self._intrinsics, draw)
        if self._in_order:
            _ = frame.images
        return frame


class CameraServer:
    """Publisher of frames over ZeroMQ. A subscriber receives only the newest frame, never a queue.

    Publishing does not block: a slow or stopped companion cannot delay the simulator.
    """

    awaited = True
    transport_us = None

    def __init__(
        self,
        endpoint: str,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
        key: bytes | None = None,
    ) -> None:
        """Bind the socket to an endpoint such as "tcp://127.0.0.1:5560"; port 0 or * = any.

        `key` is CURVE's secret key; None = unencrypted.
        Raises UsageError if the port is in use, or if the endpoint is invalid.
        """
        self._owns_context = context is None
        self._context = zmq.Context() if context is None else context
        self._socket = self._context.socket(zmq.PUB)
        # A high-water mark of 1 would keep the oldest frame and drop the newest.
        self._socket.setsockopt(zmq.CONFLATE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            if key is not None:
                # A subscriber needs the public key, which only the owners of the key can compute.
                self._socket.setsockopt(zmq.CURVE_SERVER, 1)
                self._socket.setsockopt(zmq.CURVE_SECRETKEY, key)
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            # The constructor fails, so no other code closes the socket.
            self.close()
            if error.errno == zmq.EADDRINUSE:
                port = endpoint.rsplit(":", 1)[-1]
                raise errors.UsageError(
                    f"camera port {port} is taken ({endpoint}); choose another with --camera-port"
                ) from error
            raise errors.UsageError(
                f"camera endpoint {endpoint!r}: {error}; accepted: tcp://ADDRESS:PORT, ipc://PATH"
            ) from error
        self.endpoint: str = self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rstrip("\0")
        """Endpoint for subscribers, with the selected port."""

    def publish(self, frame: Frame) -> None:
        """Send a frame to all subscribers. Replaces a frame that is still waiting."""
        self._socket.send(frame.to_bytes(), zmq.NOBLOCK)

    def close(self) -> None:
        """Disconnect all subscribers and free the port."""
        self._socket.close(linger=0)
        if self._owns_context:
            self._context.term()


class OnboardCamera(Protocol):
    """Camera that takes frames when due, for example `SimulatedCamera`."""

    @property
    def next_us(self) -> int:
        """Earliest simulated time of the next required call [µs]."""

    def restart(self, time_us: int) -> None:
        """Start an episode and its moving obstacles; a frame is due at `time_us` [µs]."""

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Take the frame due at `time_us` [µs] in a motion, and publish completed frames."""

    def skip_unread(self, read_us: int) -> None:
        """Skip due frames that newer ones replace before simulated `read_us` [µs], if possible."""

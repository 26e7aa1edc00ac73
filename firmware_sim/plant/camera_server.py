"""The vehicle's depth camera: its schedule, its images, and their publication."""

from __future__ import annotations

import math

import numpy as np
import zmq
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame, depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.constants import DEG, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.profiles.vehicle import Camera
from airl_mav.vehicle.rotation import Quat, Vec


class DepthCamera:
    """Takes frames of an arena at a fixed rate, from a vehicle's pose."""

    def __init__(
        self, intrinsics: Intrinsics, mount: Mount, rate_hz: float, max_range: float, arena: Arena
    ) -> None:
        """Make a camera whose first frame is due at time 0.

        Args:
            intrinsics: The lens and the image.
            mount: The camera's place on the body.
            rate_hz: Frames a second, > 0.
            max_range: Greatest depth along the optical axis that gives a return [m].
            arena: What is seen.
        """
        self._intrinsics = intrinsics
        self._mount = mount
        self._rate_hz = rate_hz
        self._max_range = max_range
        self._arena = arena
        self._start_us = 0
        self._slot = 0
        self._sequence = 0
        # The first picture loads or compiles the kernels: better here than in flight.
        self._look(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), arena.obstacles.center)

    @classmethod
    def from_profile(cls, camera: Camera, arena: Arena) -> DepthCamera:
        """Make the camera of a vehicle profile."""
        k = Intrinsics.of(camera)
        mount = Mount((camera.forward_m, 0.0, -camera.up_m), camera.pitch_up_deg * DEG)
        return cls(k, mount, camera.rate_hz, camera.range_m, arena)

    def reset(self, arena: Arena, time_us: int) -> None:
        """Look at another arena; the next frame is due at `time_us`.

        Sequence numbers go on, so that no frame of the new episode is taken for an old one.
        """
        self._arena = arena
        self._start_us = time_us
        self._slot = 0

    @property
    def next_us(self) -> int:
        """Simulated time from which on the next frame is due [µs]."""
        return self._slot_time_us(self._slot)

    def due(self, time_us: int) -> bool:
        """Return whether the next frame is due at a simulated time [µs]."""
        return time_us >= self.next_us

    def capture(
        self,
        time_us: int,
        position: Vec | NDArray[np.float64],
        quaternion: Quat | NDArray[np.float64],
        centers: NDArray[np.float64],
    ) -> Frame:
        """Take a frame now; the next is due one period after the slot that this one fills.

        Slots lie at whole multiples of the period, so that a rate that the tick does not divide
        is kept on average. Slots that were missed are left out.

        Args:
            time_us: Simulated time of the exposure [µs].
            position: (3,) vehicle NED [m].
            quaternion: (4,) vehicle body -> NED [w, x, y, z].
            centers: (n, 3) present obstacle centres NED [m], as `Arena.centers_at` gives them.
        """
        self._slot = max(self._slot, self._slot_at(time_us)) + 1
        depth = self._look(position, quaternion, centers)
        frame = Frame(self._sequence, time_us, depth_to_z16(depth), self._intrinsics)
        self._sequence += 1
        return frame

    def _look(
        self,
        position: Vec | NDArray[np.float64],
        quaternion: Quat | NDArray[np.float64],
        centers: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        at, attitude = camera_pose(position, quaternion, self._mount)
        return render(self._arena, centers, self._intrinsics, self._max_range, at, attitude)

    def _slot_at(self, time_us: int) -> int:
        """Return the slot whose period holds a time."""
        slot = int((time_us - self._start_us) * self._rate_hz / US_PER_S)
        # Rounding may put a time that is exactly on a slot into the one before.
        return slot + 1 if self._slot_time_us(slot + 1) <= time_us else slot

    def _slot_time_us(self, slot: int) -> int:
        return self._start_us + math.ceil(slot * US_PER_S / self._rate_hz)


class CameraServer:
    """Publishes frames over ZeroMQ; a subscriber gets the newest, or none, never a queue.

    Publishing does not block: a slow or stopped companion cannot hold the simulator.
    """

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

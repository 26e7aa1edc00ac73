"""A vehicle's camera as a simulation asks for its frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.camera.render import Motion
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.camera_kind import Renderer
from airl_mav.profiles.conditions import SensorNoise


class OnboardCamera(Protocol):
    """Takes frames when they are due; `camera_server.SimulatedCamera` is one."""

    @property
    def next_us(self) -> int:
        """Simulated time from which on there is something to do [µs]."""
        ...

    def restart(self, time_us: int) -> None:
        """Begin an episode, and with it its moving obstacles: a frame is due at `time_us` [µs]."""
        ...

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Take what is due of a vehicle in motion at `time_us` [µs], and publish what is done."""
        ...


class CameraMaker(Protocol):
    """Makes cameras; see `camera_server.SimulatedCamera`."""

    def __call__(
        self,
        camera: Camera,
        arena: Arena,
        start_us: int,
        noise: SensorNoise | None,
        seed: int,
        renderer: Renderer,
        further: Mapping[str, Camera] | None = None,
    ) -> OnboardCamera:
        """Return the camera of a vehicle profile, with those that are triggered with it."""
        ...

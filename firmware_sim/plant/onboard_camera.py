"""Interface of a vehicle's camera to the simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.camera.render import Motion
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.conditions import SensorNoise
from airl_mav.profiles.projections import Renderer


class OnboardCamera(Protocol):
    """Camera that takes frames when due, for example `camera_server.SimulatedCamera`."""

    @property
    def next_us(self) -> int:
        """Earliest simulated time of the next required call [µs]."""
        ...

    def restart(self, time_us: int) -> None:
        """Start an episode and its moving obstacles; a frame is due at `time_us` [µs]."""
        ...

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Take the frame due at `time_us` [µs] in a motion, and publish completed frames."""
        ...

    def skip_unread(self, read_us: int) -> None:
        """Skip due frames that newer ones replace before simulated `read_us` [µs], if possible."""


class CameraMaker(Protocol):
    """Factory of cameras; see `camera_server.SimulatedCamera`."""

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
        """Return the camera of a vehicle profile, with the additional cameras it triggers."""
        ...

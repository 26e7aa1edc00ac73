"""What the camera of a vehicle profile takes, as pictures for people: with its lens and sensor."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.exposure import expose
from airl_mav.camera.imaging import ImageFormation
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Motion, Mount, camera_pose
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import quat_to_matrix
from airl_mav.flight.trajectory import pose_at
from airl_mav.profiles.camera import Camera
from airl_mav.report.camera_pictures import Pixels
from airl_mav.report.depth_colours import coloured
from airl_mav.report.replay.flight import ReplayedFlight

TURNED_OVER_US = 20_000
"""Angular rates of a recorded flight are those between so long before and after a moment [µs]."""


class TakingCamera:
    """Takes pictures, one ray a pixel, with the table `imaging` where the camera has one."""

    def __init__(self, camera: Camera, name: str = "") -> None:
        """Take the camera of a vehicle profile; it sits on the vehicle as it does there.

        `name` is that of a further camera.
        """
        self._camera, self._intrinsics = camera, Intrinsics.of(camera)
        self._forming = None if camera.imaging is None else ImageFormation(camera, name)
        self._mount = Mount.of(camera)

    def __call__(self, arena: Arena, elapsed_us: int, motion: Motion, seed: int) -> Pixels:
        """Return a picture (h, w, 3), or (h, w) of grey; depth in colours.

        Args:
            arena: What is seen.
            elapsed_us: Time since the episode's start [µs].
            motion: How the vehicle moves.
            seed: Of what the sensor draws.
        """
        image: NDArray[Any]
        if self._forming is not None:
            frame = elapsed_us // self._camera.period_us
            image = self._forming.take(arena, elapsed_us, motion, seed, frame).image
        else:
            at, attitude = camera_pose(motion.position, motion.quaternion, self._mount)
            range_m, centers = self._camera.range_m, arena.centers_at(elapsed_us)
            image = expose(arena, centers, self._intrinsics, range_m, at, attitude)
        if self._camera.kind == "depth":
            return coloured(image, self._camera.range_m)
        return image if self._camera.kind == "rgb" else image[..., 0]


def taken_film(
    flight: ReplayedFlight, camera: TakingCamera, moments: Iterable[int]
) -> Iterator[Pixels]:
    """Yield what a camera takes along the way of a recorded flight.

    Args:
        flight: The flight.
        camera: The camera.
        moments: When [µs].

    Raises:
        UsageError: The arena of the flight cannot be made any more.
    """
    if flight.arena is None:
        raise UsageError(f"flight {flight.label}: its arena cannot be made any more")
    for time_us in moments:
        motion = recorded_motion(flight, time_us)
        elapsed_us = time_us - flight.record.started_us
        yield camera(flight.arena, elapsed_us, motion, flight.record.seed)


def recorded_motion(flight: ReplayedFlight, time_us: int) -> Motion:
    """Return how the vehicle of a recorded flight moved at a time [µs]."""
    position, velocity, quaternion = pose_at(flight.path, time_us)
    return Motion(position, quaternion, velocity, _rates(flight, time_us))


def _rates(flight: ReplayedFlight, time_us: int) -> NDArray[np.float64]:
    """Return the angular velocity FRD (3,) [rad/s] of a recorded flight, by its attitudes."""
    *_, before = pose_at(flight.path, time_us - TURNED_OVER_US)
    *_, after = pose_at(flight.path, time_us + TURNED_OVER_US)
    turn = quat_to_matrix(before).T @ quat_to_matrix(after)
    # Of a small rotation: its skew part.
    skew = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    rates: NDArray[np.float64] = skew * (US_PER_S / (2.0 * TURNED_OVER_US))
    return rates

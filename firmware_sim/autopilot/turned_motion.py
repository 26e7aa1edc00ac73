"""Comparison of GPS and IMU motion: detects equal motion with a rotated heading.

With a wrong heading, the IMU velocity is the GPS velocity rotated about the vertical: equal in
magnitude, at a constant angle. A wrong tilt or gyro leaves no such relation.

Over a window of fixes, velocities are complex numbers minus their means, u from the IMU under a
heading and w from GPS:

    unrotated     sum |w - u|^2             = |w|^2 + |u|^2 - 2 Re(u* w)
    best rotation min sum |w - e^(i a) u|^2 = |w|^2 + |u|^2 - 2 |u* w|

Source: G. Wahba, A Least Squares Estimate of Satellite Attitude (SIAM Review 7(3), 1965), whose
solution in the plane is the angle of u* w.
"""

from __future__ import annotations

import cmath
from typing import Any

import numpy as np

from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel

WINDOW = 20
"""Window length in fixes: 2 s at 10 Hz."""

FELT = 7
"""Index of the IMU-only velocity in the yaw estimator (`yaw_estimator.SHARED_SIZE`)."""

EXCUSED = 2.0
"""Factor on the GPS noise up to which there is no disagreement, as IMU velocity drifts."""


@kernel
def note_motion(record: Any, north: float, east: float, accuracy: float) -> None:
    """Record a fix in the record of a flight controller.

    Args:
        record: Updated; its yaw estimator holds the IMU-only velocity up to a constant.
        north: GPS velocity [m/s].
        east: GPS velocity [m/s].
        accuracy: Standard deviation of each component [m/s].
    """
    slot = record.motions % WINDOW
    record.felt_motion[slot, 0] = record.yaw_shared[FELT]
    record.felt_motion[slot, 1] = record.yaw_shared[FELT + 1]
    record.seen_motion[slot, 0], record.seen_motion[slot, 1] = north, east
    record.motions += 1
    record.motion_variance = accuracy * accuracy


class TurnedMotion:
    """Newest velocities from IMU and GPS."""

    def __init__(self, record: Any) -> None:
        """Use the record of a flight controller."""
        self._record = record

    def restart(self) -> None:
        """Discard all velocities."""
        self._record["motions"] = 0

    @property
    def _seen(self) -> Vector:
        return self._complex("seen_motion")

    def _complex(self, name: str) -> Vector:
        """Return the newest velocities as complex numbers, north and east."""
        record = self._record
        rows = record[name][0, : min(record["motions"].item(0), WINDOW)]
        velocities: Vector = rows[:, 0] + 1j * rows[:, 1]
        return velocities

    def explained(self, turn: float) -> float:
        """Return the share of the disagreement that another heading would explain.

        Args:
            turn: Angle from the IMU velocity's axes to the tested heading [rad].

        Returns:
            0 to 1; 0 if there is no disagreement.
        """
        w = self._seen
        if not len(w):
            return 0.0
        u = self._complex("felt_motion") * cmath.exp(1j * turn)
        u, w = u - u.mean(), w - w.mean()
        common = complex(np.vdot(u, w))
        power = float(np.vdot(u, u).real + np.vdot(w, w).real)
        rest = power - 2.0 * EXCUSED * self._record["motion_variance"].item(0) * len(w)
        turned = max(rest - 2.0 * abs(common), 0.0)
        as_they_are = rest - 2.0 * common.real
        return 1.0 - turned / as_they_are if as_they_are > turned else 0.0

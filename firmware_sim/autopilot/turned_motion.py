"""Whether GPS sees the motion that the IMU feels, only in another direction.

Under a wrong heading the velocity by the IMU is that by GPS, turned about the vertical: equally
large, at an angle that stays. A wrong tilt or gyro gives the two nothing in common.

Over a window of fixes velocities are complex numbers less their means, u as the IMU felt them under
a heading and w as GPS saw them:

    as they are  sum |w - u|^2             = |w|^2 + |u|^2 - 2 Re(u* w)
    best turned  min sum |w - e^(i a) u|^2 = |w|^2 + |u|^2 - 2 |u* w|

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
"""Fixes: 2 s at 10 Hz."""

FELT = 7
"""Where the yaw estimator has the velocity by the IMU alone (`yaw_estimator.SHARED_SIZE`)."""

EXCUSED = 2.0
"""This many times what the noise of GPS does is no disagreement: what is felt drifts, too."""


@kernel
def note_motion(record: Any, north: float, east: float, accuracy: float) -> None:
    """Note a fix in the record of a flight controller.

    Args:
        record: Updated; its yaw estimator has the velocity by the IMU alone, but for a constant.
        north: Velocity by GPS [m/s].
        east: Velocity by GPS [m/s].
        accuracy: Standard deviation of each of them [m/s].
    """
    slot = record.motions % WINDOW
    record.felt_motion[slot, 0] = record.yaw_shared[FELT]
    record.felt_motion[slot, 1] = record.yaw_shared[FELT + 1]
    record.seen_motion[slot, 0], record.seen_motion[slot, 1] = north, east
    record.motions += 1
    record.motion_variance = accuracy * accuracy


class TurnedMotion:
    """The newest velocities by IMU and by GPS."""

    def __init__(self, record: Any) -> None:
        """Take the record of a flight controller."""
        self._record = record

    def restart(self) -> None:
        """Forget all."""
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
            turn: From the axes of what is felt to a heading that is asked about [rad].

        Returns:
            0 to 1; 0 where the two do not disagree.
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

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
from collections import deque

import numpy as np

from airl_mav.core.frames import Vector

WINDOW = 20
"""Fixes: 2 s at 10 Hz."""

EXCUSED = 2.0
"""This many times what the noise of GPS does is no disagreement: what is felt drifts, too."""


class TurnedMotion:
    """The newest velocities by IMU and by GPS."""

    def __init__(self) -> None:
        self._felt: deque[complex] = deque(maxlen=WINDOW)
        self._seen: deque[complex] = deque(maxlen=WINDOW)
        self._variance = 0.0

    def take(self, felt: Vector, seen: Vector, accuracy: float) -> None:
        """Take a fix.

        Args:
            felt: Horizontal velocity by the IMU alone (2,) [m/s], but for a constant.
            seen: That by GPS, north and east (2,) [m/s].
            accuracy: Standard deviation of an axis of the latter [m/s].
        """
        self._felt.append(complex(*felt.tolist()))
        self._seen.append(complex(*seen.tolist()))
        self._variance = accuracy**2

    def restart(self) -> None:
        """Forget all."""
        self._felt.clear()
        self._seen.clear()

    def explained(self, turn: float) -> float:
        """Return the share of the disagreement that another heading would explain.

        Args:
            turn: From the axes of what is felt to a heading that is asked about [rad].

        Returns:
            0 to 1; 0 where the two do not disagree.
        """
        if not self._seen:
            return 0.0
        u, w = np.array(self._felt) * cmath.exp(1j * turn), np.array(self._seen)
        u, w = u - u.mean(), w - w.mean()
        common = complex(np.vdot(u, w))
        power = float(np.vdot(u, u).real + np.vdot(w, w).real)
        rest = power - 2.0 * EXCUSED * self._variance * len(w)
        turned = max(rest - 2.0 * abs(common), 0.0)
        as_they_are = rest - 2.0 * common.real
        return 1.0 - turned / as_they_are if as_they_are > turned else 0.0

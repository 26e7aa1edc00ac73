"""Remaining flight time of the battery.

Source: PX4 1.16, Battery::computeRemainingTime.
"""

from __future__ import annotations

import math

from airl_mav.core.constants import US_PER_S
from firmware_sim.interfaces import BatterySample

AVERAGE_S = 50.0
"""Time constant of the mean current [s]."""

_S_PER_H = 3600.0
_MA_PER_A = 1000.0


class Endurance:
    """Estimator of the remaining flight time from the mean current while armed."""

    def __init__(self) -> None:
        self._current_a: float | None = None
        self._time_us = 0

    def update(
        self,
        time_us: int,
        battery: BatterySample,
        capacity_mah: float,
        expected_a: float,
        *,
        armed: bool,
    ) -> float:
        """Return the remaining battery time [s], infinite if the capacity is not set.

        Args:
            time_us: Time of the sample [µs].
            battery: Reading of the power module.
            capacity_mah: BAT1_CAPACITY; 0 or less: not set.
            expected_a: BAT_AVRG_CURRENT, the initial mean.
            armed: True if armed; the mean is only updated while armed.
        """
        if capacity_mah <= 0.0:
            return math.inf
        if self._current_a is None:
            self._current_a = expected_a
        elif armed:
            share = -math.expm1(-(time_us - self._time_us) / (AVERAGE_S * US_PER_S))
            self._current_a += share * (max(battery.current_a, 0.0) - self._current_a)
        self._time_us = time_us
        left_mah = battery.remaining * capacity_mah
        return left_mah / max(self._current_a * _MA_PER_A, 1e-6) * _S_PER_H

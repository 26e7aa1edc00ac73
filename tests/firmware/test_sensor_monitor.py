"""Sensor validity: silent sensors and repeated values."""

from __future__ import annotations

import numpy as np

from airl_mav.core.constants import TICK_US, US_PER_S
from firmware_sim.autopilot.sensor_monitor import SensorMonitor
from firmware_sim.engine.record import WATCHES
from firmware_sim.interfaces import BatterySample, SensorSample

BATTERY = BatterySample(16.0, 1.0, 0.0, 1.0)
LOOK_TICKS = 25


class Stand:
    """A vehicle at rest under watch."""

    def __init__(self, rng: np.random.Generator | None) -> None:
        self.monitor = SensorMonitor(np.full((WATCHES, 3), -1))
        self.rng = rng
        self._ticks = 0

    def wait(self, seconds: float, *, flying: bool = False) -> list[str]:
        """Let time pass; return the texts. Without randomness every sample is the same."""
        told: list[str] = []
        for _ in range(round(seconds * US_PER_S / TICK_US)):
            draw = np.zeros(7) if self.rng is None else self.rng.standard_normal(7)
            now_us = self._ticks * TICK_US
            mag, pressure = draw[:3], float(draw[6])
            sample = SensorSample(now_us, draw[:3], draw[3:6], 20.0, BATTERY, mag, pressure)
            self.monitor.take(sample)
            if self._ticks % LOOK_TICKS == 0:
                told += [m.text for m in self.monitor.judge(sample, flying=flying)]
            self._ticks += 1
        return told


def test_a_noisy_sensor_that_freezes_at_rest_has_failed() -> None:
    stand = Stand(np.random.default_rng(1))
    assert stand.wait(2.0) == []
    stand.rng = None
    told = stand.wait(3.0)
    assert sorted(told) == [
        f"{name} #0 failed: STALE!" for name in ("ACCEL", "BARO", "GYRO", "MAG")
    ]
    assert stand.monitor.distrusted


def test_a_perfect_sensor_repeats_itself_at_rest_and_has_not() -> None:
    stand = Stand(None)
    assert stand.wait(5.0) == []
    assert not stand.monitor.distrusted


def test_in_flight_not_even_the_first_repetition_is_fused() -> None:
    stand = Stand(np.random.default_rng(1))
    stand.wait(0.5, flying=True)
    assert not stand.monitor.distrusted
    stand.rng = None
    stand.wait(2 * TICK_US / US_PER_S, flying=True)
    assert stand.monitor.distrusted

"""How the estimator begins: sensors averaged at rest, level by gravity, north by the compass."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import MAGNETIC_DECLINATION, Geodetic, Vector, quat_from_euler
from airl_mav.vehicle.atmosphere import altitude_m
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.magnetic_field import FieldCheck
from firmware_sim.interfaces import SensorSample

ALIGN_S = 0.5
"""Time at rest over which attitude and barometer are averaged at start [s]."""

LONGEST_ALIGN_S = 10.0
"""Samples at rest that are older are forgotten while a sensor is waited for [s]."""

_NO_COMPASS = 5
"""EKF2_MAG_TYPE: the compass is not used."""


class Aligned(NamedTuple):
    """What is known at the end."""

    quaternion: Vector  # (4,) body -> NED
    altitude_baro_m: float
    """Of the standard atmosphere, by the barometer [m]."""
    fix: Geodetic | None
    """Where GPS says that the vehicle is; None where it was not waited for."""
    by_compass: bool
    """Whether the heading is the compass's; else it is 0."""


class Alignment:
    """Waits for each sensor that is needed, and for the vehicle to have rested."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Begin without a sample; `value` looks up EKF2_* parameters by name."""
        self._value = value
        self._resting: list[SensorSample] = []
        self._seen: set[str] = set()
        """Which of the slower sensors have measured."""
        self.field: Vector | None = None
        """The mean field (3,) FRD [gauss], also where it is too disturbed to be used."""

    def take(self, sample: SensorSample) -> Aligned | None:
        """Take one tick's sensors; return what is known once it is enough."""
        self._resting.append(sample)
        needed = self._needed()
        self._seen |= _kinds(sample, needed)
        elapsed_s = (sample.time_us - self._resting[0].time_us) / US_PER_S
        if elapsed_s < ALIGN_S or len(self._seen) < len(needed):
            if elapsed_s > LONGEST_ALIGN_S:
                self._forget(needed)
            return None
        ax, ay, az = np.mean([s.accel for s in self._resting], axis=0)
        roll, pitch = math.atan2(-ay, -az), math.atan2(ax, math.hypot(ay, az))
        heading = self._heading(roll, pitch) if "mag" in needed else 0.0
        if heading is None:
            # A heading by it would be wrong, and nothing would tell before the vehicle moves.
            self._forget(needed)
            return None
        baro = [altitude_m(s.pressure_hpa) for s in self._resting if s.pressure_hpa is not None]
        fix = None
        if "gps" in needed:
            fixes = [s.gps.position for s in self._resting if s.gps is not None]
            fix = Geodetic(*(float(c) for c in np.mean(fixes, axis=0)))
        self._resting.clear()
        quaternion = quat_from_euler(roll, pitch, heading)
        return Aligned(quaternion, float(np.mean(baro)), fix, "mag" in needed)

    def _heading(self, roll: float, pitch: float) -> float | None:
        """Return the compass's [rad]; None where it does not measure the earth's field."""
        field = np.mean([s.mag for s in self._resting if s.mag is not None], axis=0)
        level = tuple(quat_from_euler(roll, pitch, 0.0).tolist())
        self.field = field
        if FieldCheck.read(self._value).disturbed(field, level):
            return None
        return es.true_heading(field, level, MAGNETIC_DECLINATION)

    def _needed(self) -> tuple[str, ...]:
        """Return the slower sensors of which one sample each is needed.

        GPS is not waited for where external vision may take its place.
        """
        gps = self._value("EKF2_GPS_CTRL") != 0 and not self._value("EKF2_EV_CTRL")
        mag = self._value("EKF2_MAG_TYPE") != _NO_COMPASS
        return (*("gps",) * gps, *("mag",) * mag, "pressure_hpa")

    def _forget(self, needed: tuple[str, ...]) -> None:
        """A sensor is missing: keep the newer half of the samples, so that memory stays bounded."""
        self._resting = self._resting[len(self._resting) // 2 :]
        self._seen = set().union(*(_kinds(sample, needed) for sample in self._resting))


def _kinds(sample: SensorSample, needed: tuple[str, ...]) -> set[str]:
    return {name for name in needed if getattr(sample, name) is not None}

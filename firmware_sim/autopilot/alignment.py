"""Start of the estimator: sensors averaged at rest, level by gravity, north by the compass."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np

from airl_mav.core import frames
from airl_mav.core.constants import US_PER_S
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.atmosphere import altitude_m
from airl_mav.vehicle.rotation import Quat, rotate
from firmware_sim.autopilot import error_state as es
from firmware_sim.engine.record import GPS, MAG, PRESSURE, Record

STRENGTH_GAUSS = float(np.linalg.norm(frames.MAGNETIC_FIELD_NED))
INCLINATION_RAD = math.asin(frames.MAGNETIC_FIELD_NED[2] / STRENGTH_GAUSS)
"""Inclination [rad], positive down."""

_LEAST_GAUSS = 1e-4
"""Minimum strength of a field with a defined direction."""


class Checked(IntFlag):
    """Bits of EKF2_MAG_CHECK."""

    STRENGTH = 1
    INCLINATION = 2


class FieldCheck(NamedTuple):
    """Tolerances for the measured field."""

    checked: int
    strength_gauss: float
    """Maximum error of the strength [gauss]."""
    inclination_rad: float

    @classmethod
    def read(cls, value: Callable[[str], float]) -> FieldCheck:
        """Read the tolerances with a look-up for PX4 parameters."""
        return cls(
            int(value("EKF2_MAG_CHECK")),
            value("EKF2_MAG_CHK_STR"),
            math.radians(value("EKF2_MAG_CHK_INC")),
        )

    def disturbed(self, field: frames.Vector, attitude: Quat) -> bool:
        """Return whether a measured field (3,) FRD [gauss] differs from the earth's field.

        The heading of the attitude, body to world, has no effect.
        """
        strength = float(np.linalg.norm(field))
        # Written with "not <=" so that a NaN counts as disturbed.
        if self.checked & Checked.STRENGTH and not (
            abs(strength - STRENGTH_GAUSS) <= self.strength_gauss
        ):
            return True
        if not self.checked & Checked.INCLINATION:
            return False
        # Only the down component is needed: it does not depend on the heading.
        _, _, down = rotate(attitude, (field.item(0), field.item(1), field.item(2)))
        inclination = math.asin(max(-1.0, min(1.0, down / max(strength, _LEAST_GAUSS))))
        return not abs(inclination - INCLINATION_RAD) <= self.inclination_rad


ALIGN_US = US_PER_S // 2
"""Time at rest over which attitude and barometer are averaged at start [µs]."""

LONGEST_ALIGN_US = 10 * US_PER_S
"""Timeout for a missing sensor [µs]; averaging restarts after it."""

IMU, COMPASS, BAROMETER, FIXES = range(4)
"""Indices into `rest_count`."""

_ACCEL, _FIELD, _ALTITUDE, _PLACE = slice(0, 3), slice(3, 6), 6, slice(7, 10)
"""Indices into `rest_sum`."""

_NO_COMPASS = 5
"""EKF2_MAG_TYPE: the compass is not used."""


class Aligned(NamedTuple):
    """Result of the alignment."""

    quaternion: frames.Vector  # (4,) body -> NED
    altitude_baro_m: float
    """Pressure altitude in the standard atmosphere, from the barometer [m]."""
    fix: frames.Geodetic | None
    """GPS position; None if the alignment did not require GPS."""
    by_compass: bool
    """True if the heading comes from the compass; False: the heading is 0."""


class Alignment:
    """Alignment that waits for the required sensors and for the vehicle to be at rest."""

    def __init__(self, value: Callable[[str], float], record: Record) -> None:
        """Start without samples. The flight controller's record holds the sums of all samples."""
        self._value = value
        self._record = record
        self.field: frames.Vector | None = None
        """Mean field (3,) FRD [gauss], also set if the field is too disturbed to use."""

    def finish(self) -> Aligned | None:
        """Return the alignment, or None until there are enough samples."""
        record, needed = self._record, self._needed()
        elapsed_us = record["time_us"].item(0) - record["rest_since_us"].item(0)
        counts = record["rest_count"][0].tolist()
        # Every required sensor must have at least one sample.
        if elapsed_us < ALIGN_US or not all(counts[kind] for kind in needed):
            if elapsed_us > LONGEST_ALIGN_US:
                self._restart()
            return None
        sums = record["rest_sum"][0]
        ax, ay, az = (sums[_ACCEL] / counts[IMU]).tolist()
        # At rest the accelerometer measures -g: roll and pitch level this vector.
        roll, pitch = math.atan2(-ay, -az), math.atan2(ax, math.hypot(ay, az))
        by_compass, heading = COMPASS in needed, 0.0
        if by_compass:
            # The field in a frame with heading 0 gives the heading directly.
            level = tuple(frames.quat_from_euler(roll, pitch, 0.0).tolist())
            self.field = field = sums[_FIELD] / counts[COMPASS]
            if FieldCheck.read(self._value).disturbed(field, level):
                # A wrong heading would stay unnoticed until the vehicle moves.
                self._restart()
                return None
            heading = es.true_heading(field, level, frames.MAGNETIC_DECLINATION)
        # Mean of altitudes, not of pressures: altitude is not linear in pressure.
        altitude_m = sums.item(_ALTITUDE) / counts[BAROMETER]
        fix = (
            frames.local_to_geodetic(sums[_PLACE] / counts[FIXES], frames.HOME)
            if FIXES in needed
            else None
        )
        return Aligned(frames.quat_from_euler(roll, pitch, heading), altitude_m, fix, by_compass)

    def _needed(self) -> tuple[int, ...]:
        """Return the slow sensors that must deliver at least one sample.

        GPS is not required if external vision may replace it.
        """
        # With external vision enabled, indoor flights without GPS must align too.
        gps = self._value("EKF2_GPS_CTRL") != 0 and not self._value("EKF2_EV_CTRL")
        mag = self._value("EKF2_MAG_TYPE") != _NO_COMPASS
        # A bool as a factor keeps or drops the sensor.
        return (*(FIXES,) * gps, *(COMPASS,) * mag, BAROMETER)

    def _restart(self) -> None:
        """Discard all samples."""
        self._record["rest_since_us"] = -1
        self._record["rest_count"], self._record["rest_sum"] = 0, 0.0


@kernel
def add(c: Any, measured: int) -> None:
    """Add the newest sensors of a flight controller at rest (its fields) to the sums.

    `measured` has the bits of the slow sensors with new data in this tick (`engine.record`).
    """
    # A negative time marks the first sample.
    if c.rest_since_us < 0:
        c.rest_since_us = c.time_us
    c.rest_count[IMU] += 1
    for i in range(3):
        c.rest_sum[i] += c.accel[i]
    if measured & MAG:
        c.rest_count[COMPASS] += 1
        for i in range(3):
            c.rest_sum[3 + i] += c.mag[i]
    if measured & PRESSURE:
        c.rest_count[BAROMETER] += 1
        c.rest_sum[6] += altitude_m(c.pressure_hpa)
    if measured & GPS:
        c.rest_count[FIXES] += 1
        for i in range(3):
            c.rest_sum[7 + i] += c.gps_position[i]


@kernel
def add_record(controller: Record, measured: int) -> None:
    """Add the newest sensors of a record (1,) to the sums, like `add`."""
    add(controller[0], measured)

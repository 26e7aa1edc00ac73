"""Input of the pre-arm checks: sensors, estimator, battery and parameters as plain data."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag, auto
from typing import NamedTuple

from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.failsafes.conditions import Conditions

SUPPLY_CHECK_OFF = 894281
"""Value of CBRK_SUPPLY_CHK that disables the battery checks."""


class HealthComponent(IntFlag):
    """Vehicle components of the checks."""

    GYRO = auto()
    ACCEL = auto()
    MAG = auto()
    BARO = auto()
    GPS = auto()
    DISTANCE_SENSOR = auto()
    BATTERY = auto()
    ESTIMATOR = auto()
    MANUAL_CONTROL = auto()
    LINK = auto()
    SYSTEM = auto()


class ArmingSettings(NamedTuple):
    """Arming parameters: the field name in capitals; defaults are PX4's."""

    com_arm_bat_min: float = -1.0
    com_arm_mag_str: int = 2
    com_arm_mis_req: int = 0
    com_arm_wo_gps: int = 1
    com_rc_in_mode: int = 3
    cbrk_supply_chk: int = 0
    gf_action: int = 2
    nav_dll_act: int = 0
    sys_has_baro: int = 1
    sys_has_gps: int = 1
    sys_has_mag: int = 1
    sys_has_num_dist: int = 0

    @classmethod
    def read(cls, value: Callable[[str], float]) -> ArmingSettings:
        """Read the parameters with a look-up by PX4 name."""
        defaults = cls._field_defaults.values()
        return cls(
            *(
                type(default)(value(name.upper()))
                for name, default in zip(cls._fields, defaults, strict=True)
            )
        )


class Readiness(NamedTuple):
    """Input of the checks, without measured values, so that equal inputs can be cached."""

    mode: Mode
    conditions: Conditions
    settings: ArmingSettings
    converged: bool = True
    """True if the estimator has converged."""
    compass_agrees: bool = True
    """True if the estimator has not disabled the compass."""
    field_disturbed: bool = False
    """True if the compass measures a field other than the earth's."""
    gyro: bool = True
    """True if the sensor's data are valid; the same applies to the sensors below."""
    accel: bool = True
    mag: bool = True
    baro: bool = True
    gps: bool = True
    distance: bool | None = None
    """Validity of the distance sensor; None: there is no sensor."""
    rolled: bool = False
    """True if roll exceeds FD_FAIL_R."""
    pitched: bool = False
    charge_short: bool = False
    """True if the battery's charge is below COM_ARM_BAT_MIN."""
    terminated: bool = False
    armed: bool = False

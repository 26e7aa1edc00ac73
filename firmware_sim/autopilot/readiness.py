"""Input of the pre-arm checks: sensors, estimator, battery and parameters, as plain facts."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag, auto
from typing import NamedTuple

from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.failsafes.conditions import Conditions

SUPPLY_CHECK_OFF = 894281
"""CBRK_SUPPLY_CHK at this value switches the checks of the battery off."""


class Part(IntFlag):
    """Parts of the vehicle that a check is about."""

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
    """Each field is the parameter of that name in capitals; the numbers are PX4's defaults."""

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
        """Read them by a lookup of PX4 parameter names."""
        defaults = cls._field_defaults.values()
        return cls(
            *(
                type(default)(value(name.upper()))
                for name, default in zip(cls._fields, defaults, strict=True)
            )
        )


class Readiness(NamedTuple):
    """Input of the checks. No measured number: it is the same until something has changed."""

    mode: Mode
    conditions: Conditions
    settings: ArmingSettings
    converged: bool = True
    """The estimator knows well enough where the vehicle is and how it points."""
    compass_agrees: bool = True
    """The estimator has not given up the compass."""
    field_disturbed: bool = False
    """The compass measures something else than the earth's field."""
    gyro: bool = True
    """Whether its data are valid, as of all sensors here."""
    accel: bool = True
    mag: bool = True
    baro: bool = True
    gps: bool = True
    distance: bool | None = None
    """Of the distance sensor; None: there is none."""
    rolled: bool = False
    """Roll is beyond FD_FAIL_R."""
    pitched: bool = False
    charge_short: bool = False
    """The battery's charge is below COM_ARM_BAT_MIN."""
    terminated: bool = False
    armed: bool = False

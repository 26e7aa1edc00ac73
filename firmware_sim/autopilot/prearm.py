"""Pre-arm checks: what keeps a vehicle from arming, and says so. One row a check, pure.

The same rows tell a client which part of the vehicle is unhealthy (SYS_STATUS). Source: PX4 1.16,
commander/HealthAndArmingChecks; a check of what this vehicle does not have is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag, auto
from typing import NamedTuple

from firmware_sim.autopilot.autopilot_state import Mode, Severity
from firmware_sim.autopilot.failsafes.conditions import NEEDS, BatteryWarning, Conditions, Need

SUPPLY_CHECK_OFF = 894281
"""CBRK_SUPPLY_CHK at this value switches the checks of the battery off."""


class Part(IntFlag):
    """Parts of the vehicle that a check is about."""

    GYRO = auto()
    ACCEL = auto()
    MAG = auto()
    BARO = auto()
    GPS = auto()
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
    """What the checks look at. No measured number: it is the same until something has changed."""

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
    rolled: bool = False
    """Roll is beyond FD_FAIL_R."""
    pitched: bool = False
    charge_short: bool = False
    """The battery's charge is below COM_ARM_BAT_MIN."""
    terminated: bool = False
    armed: bool = False


class Check(NamedTuple):
    """One check."""

    part: Part
    fails: Callable[[Readiness], bool]
    text: str
    """What the operator is told."""
    said: bool = True
    """Whether PX4 says it by itself when it begins to fail; else only when arming is refused."""
    blocks: Callable[[Readiness], bool] | None = None
    """Whether it keeps the vehicle from arming; None = always."""
    severity: Severity = Severity.CRITICAL


def _lacks(need: Need) -> Callable[[Readiness], bool]:
    return lambda r: bool(NEEDS[r.mode] & need)


def _sensor(part: Part, name: str, fails: Callable[[Readiness], bool]) -> Check:
    return Check(part, fails, f"Preflight Fail: No valid data from {name}")


def _field_fails(r: Readiness, as_asked: int) -> bool:
    return r.field_disturbed and not r.armed and r.settings.com_arm_mag_str == as_asked


def _battery(level: BatteryWarning, text: str) -> Check:
    return Check(
        Part.BATTERY,
        lambda r: _supply_checked(r) and _battery_level(r) is level,
        text,
        blocks=_battery_blocks,
        severity=Severity.EMERGENCY,
    )


def _supply_checked(r: Readiness) -> bool:
    return r.settings.cbrk_supply_chk != SUPPLY_CHECK_OFF


def _charge_required(r: Readiness) -> bool:
    return not r.armed and r.settings.com_arm_bat_min >= 0.0


def _battery_level(r: Readiness) -> BatteryWarning:
    """Return the warning; a charge below COM_ARM_BAT_MIN counts as low at least."""
    warning = r.conditions.battery_warning
    if _charge_required(r) and r.charge_short:
        return max(warning, BatteryWarning.LOW)
    return warning


def _battery_blocks(r: Readiness) -> bool:
    """Return whether the charge forbids arming: below COM_ARM_BAT_MIN, without it critical."""
    if _charge_required(r):
        return r.charge_short
    return r.conditions.battery_warning >= BatteryWarning.CRITICAL


_FIELD_REQUIRED, _FIELD_WARNED = 1, 2
"""COM_ARM_MAG_STR: 1 refuses to arm in a disturbed magnetic field, 2 warns, 0 says nothing."""
_GLOBAL_REQUIRED = 0
"""COM_ARM_WO_GPS: 0 refuses to arm without a global position, 1 warns, 2 says nothing."""
_FENCE_RETURN = 3

CHECKS: tuple[Check, ...] = (
    _sensor(Part.ACCEL, "Accel 0", lambda r: not r.accel),
    _sensor(Part.GYRO, "Gyro 0", lambda r: not r.gyro),
    _sensor(Part.BARO, "Baro 0", lambda r: bool(r.settings.sys_has_baro) and not r.baro),
    _sensor(Part.MAG, "Compass 0", lambda r: bool(r.settings.sys_has_mag) and not r.mag),
    Check(
        Part.GPS,
        lambda r: bool(r.settings.sys_has_gps) and not r.gps and r.settings.com_arm_wo_gps == 0,
        "Preflight Fail: GPS fix too low",
    ),
    Check(
        Part.GPS,
        lambda r: (
            bool(r.settings.sys_has_gps)
            and not r.gps
            and not r.armed
            and r.settings.com_arm_wo_gps == 1
        ),
        "Preflight: GPS fix too low",
        blocks=lambda _: False,
        severity=Severity.WARNING,
    ),
    _battery(BatteryWarning.LOW, "Low battery"),
    _battery(BatteryWarning.CRITICAL, "Critical battery"),
    _battery(BatteryWarning.EMERGENCY, "Emergency battery level"),
    Check(
        Part.BATTERY,
        lambda r: _supply_checked(r) and r.conditions.battery_unhealthy,
        "Preflight Fail: Battery unhealthy",
    ),
    Check(
        Part.BATTERY,
        lambda r: _supply_checked(r) and r.conditions.battery_low_remaining_time,
        "Remaining flight time low",
        said=False,
    ),
    Check(
        Part.ESTIMATOR,
        lambda r: not r.converged and not r.armed,
        "Preflight Fail: ekf2 missing data",
        said=False,
    ),
    Check(
        Part.ESTIMATOR,
        lambda r: not r.compass_agrees and not r.armed,
        "Preflight Fail: heading estimate not stable",
    ),
    Check(
        Part.ESTIMATOR,
        lambda r: (
            r.field_disturbed and not r.armed and r.settings.com_arm_mag_str == _FIELD_REQUIRED
        ),
        "Preflight Fail: Strong magnetic interference",
    ),
    Check(
        Part.ESTIMATOR,
        lambda r: _field_fails(r, _FIELD_WARNED),
        "Preflight: Strong magnetic interference",
        # Before the estimator has a heading, that field is what it waits for the end of.
        blocks=lambda r: not r.converged,
        severity=Severity.WARNING,
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.rolled,
        "Preflight Fail: Attitude failure (roll)",
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.pitched and not r.rolled,
        "Preflight Fail: Attitude failure (pitch)",
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.conditions.geofence.distance and r.settings.gf_action != 0,
        "Geofence violation: exceeding maximum distance to Home",
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.conditions.geofence.altitude and r.settings.gf_action != 0,
        "Geofence violation: exceeding maximum altitude above Home",
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.conditions.geofence.custom and r.settings.gf_action != 0,
        "Geofence violation: approaching or outside geofence",
    ),
    Check(
        Part.SYSTEM,
        lambda r: (
            r.settings.gf_action == _FENCE_RETURN
            and r.conditions.home_position_invalid
            and r.converged
        ),
        "Preflight Fail: Geofence RTL requires valid home",
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.conditions.mission_failure,
        "Mission cannot be completed",
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.conditions.flight_time_limit_exceeded,
        "Maximum flight time reached",
    ),
    Check(
        Part.LINK,
        lambda r: r.conditions.gcs_connection_lost and r.settings.nav_dll_act > 0,
        "Preflight Fail: No connection to the ground control station",
        severity=Severity.WARNING,
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.terminated,
        "Preflight Fail: Flight termination active",
    ),
    Check(
        Part.SYSTEM,
        lambda r: (
            r.settings.com_arm_wo_gps == _GLOBAL_REQUIRED
            and not r.armed
            and r.converged
            and r.conditions.global_position_invalid
        ),
        "Preflight Fail: Global position estimate required",
    ),
    Check(
        Part.SYSTEM,
        lambda r: (
            r.settings.com_arm_wo_gps == _GLOBAL_REQUIRED
            and not r.armed
            and r.converged
            and r.conditions.home_position_invalid
        ),
        "Preflight Fail: Home position required",
    ),
    # What a mode needs. PX4 tells it by events alone, and so do we until arming is refused.
    Check(
        Part.SYSTEM,
        lambda r: bool(NEEDS[r.mode] & Need.NOT_ARMING) and not r.terminated and not r.armed,
        "Preflight Fail: Mode not suitable for arming",
        said=False,
    ),
    Check(
        Part.ESTIMATOR,
        lambda r: r.conditions.attitude_invalid,
        "Preflight Fail: No valid attitude estimate",
        said=False,
        blocks=_lacks(Need.ATTITUDE),
    ),
    Check(
        Part.ESTIMATOR,
        lambda r: r.conditions.local_position_invalid,
        "Preflight Fail: No valid position estimate",
        said=False,
        blocks=_lacks(Need.LOCAL_POSITION | Need.LOCAL_POSITION_RELAXED),
    ),
    Check(
        Part.ESTIMATOR,
        lambda r: r.conditions.global_position_invalid and not r.conditions.local_position_invalid,
        "Preflight Fail: No valid global position estimate",
        said=False,
        blocks=_lacks(Need.GLOBAL_POSITION),
    ),
    Check(
        Part.ESTIMATOR,
        lambda r: r.conditions.local_altitude_invalid,
        "Preflight Fail: No valid altitude estimate",
        said=False,
        blocks=_lacks(Need.ALTITUDE),
    ),
    Check(
        Part.SYSTEM,
        lambda r: (
            r.conditions.auto_mission_missing
            and (bool(r.settings.com_arm_mis_req) or bool(NEEDS[r.mode] & Need.MISSION))
        ),
        "Preflight Fail: No valid mission available",
        said=False,
    ),
    Check(
        Part.SYSTEM,
        lambda r: (
            r.conditions.offboard_control_signal_lost and bool(NEEDS[r.mode] & Need.OFFBOARD_SIGNAL)
        ),
        "Preflight Fail: No offboard signal",
        said=False,
    ),
    Check(
        Part.SYSTEM,
        lambda r: r.conditions.home_position_invalid and bool(NEEDS[r.mode] & Need.HOME),
        "Preflight Fail: Home position not set",
        said=False,
    ),
    Check(
        Part.MANUAL_CONTROL,
        lambda r: (
            r.conditions.manual_control_signal_lost and bool(NEEDS[r.mode] & Need.MANUAL_CONTROL)
        ),
        "Preflight Fail: No manual control input",
        said=False,
    ),
)
"""In the order in which they are told."""


def failing(readiness: Readiness) -> tuple[Check, ...]:
    """Return the checks that fail."""
    return tuple(check for check in CHECKS if check.fails(readiness))


def blocking(checks: tuple[Check, ...], readiness: Readiness) -> tuple[Check, ...]:
    """Return those of the failing checks that keep the vehicle from arming in its mode."""
    return tuple(check for check in checks if check.blocks is None or check.blocks(readiness))


def can_arm(readiness: Readiness) -> tuple[Check, ...]:
    """Return the checks that keep the vehicle from arming in a mode; none = it may."""
    return blocking(failing(readiness), readiness)

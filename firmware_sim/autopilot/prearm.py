"""Pre-arm checks with their texts, one row per check, pure.

The rows also define component health for clients (SYS_STATUS). Source: PX4 1.16,
commander/HealthAndArmingChecks, without checks of components that this vehicle lacks.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag, auto
from functools import lru_cache
from typing import NamedTuple

from firmware_sim.autopilot.autopilot_state import Severity
from firmware_sim.autopilot.events import check_events as events
from firmware_sim.autopilot.events.check_events import CheckEvent
from firmware_sim.autopilot.events.definition import Level
from firmware_sim.autopilot.failsafes.failsafe_conditions import BatteryWarning, Conditions
from firmware_sim.autopilot.flight_modes import Mode, Need

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


class PrearmCheck(NamedTuple):
    """Pre-arm check."""

    part: HealthComponent
    fails: Callable[[Readiness], bool]
    event: CheckEvent
    """Event for ground stations."""
    told: str = ""
    """Text for the operator; "" = `prefix` and the event's message."""
    prefix: str = "Preflight Fail: "
    said: bool = True
    """True if PX4 reports the check as soon as it fails; False: only when arming is rejected."""
    blocks: Callable[[Readiness], bool] | None = None
    """Condition under which the check prevents arming; None = always."""
    severity: Severity = Severity.CRITICAL
    level: Callable[[Readiness], Level] | None = None
    """Level of the event; None = the definition's level."""
    shown: Callable[[Readiness], Need] | None = None
    """Requirements that select further modes in which ground stations show the check; None: only
    the blocked modes, or all modes if it blocks none."""
    of_present_mode: bool = False
    """True if the check is reported only while the current mode fails it."""

    @property
    def text(self) -> str:
        """Text for the operator."""
        return self.told or self.prefix + self.event.definition.message


def never(_readiness: Readiness) -> bool:
    """Return False: the check never prevents arming."""
    return False


def _needs(r: Readiness, need: Need) -> bool:
    return bool(r.mode.spec.needs & need)


# Before convergence, another check explains the missing position.
def _global_required(r: Readiness) -> bool:
    # Before convergence, another check explains the missing position.
    return r.settings.com_arm_wo_gps == _GLOBAL_REQUIRED and not r.armed and r.converged


def _estimate(
    name: str, event: CheckEvent, need: Need, fails: Callable[[Conditions], bool]
) -> PrearmCheck:
    return PrearmCheck(
        HealthComponent.ESTIMATOR,
        lambda r: fails(r.conditions),
        event,
        f"Preflight Fail: No valid {name} estimate",
        said=False,
        blocks=lambda r: _needs(r, need),
    )


def _fence(kind: str, event: CheckEvent) -> PrearmCheck:
    def breached(r: Readiness) -> bool:
        return getattr(r.conditions.geofence, kind) and r.settings.gf_action != 0

    return PrearmCheck(HealthComponent.SYSTEM, breached, event, prefix="")


def _sensor(
    part: HealthComponent, name: str, event: CheckEvent, fails: Callable[[Readiness], bool]
) -> PrearmCheck:
    return PrearmCheck(part, fails, event, f"Preflight Fail: No valid data from {name}")


def _field_fails(r: Readiness, as_asked: int) -> bool:
    return r.field_disturbed and not r.armed and r.settings.com_arm_mag_str == as_asked


def _battery(level: BatteryWarning, event: CheckEvent) -> PrearmCheck:
    return PrearmCheck(
        HealthComponent.BATTERY,
        lambda r: _supply_checked(r) and _battery_level(r) is level,
        event,
        prefix="",
        blocks=_battery_blocks,
        severity=Severity.EMERGENCY,
        level=_battery_urgency,
    )


def _supply_checked(r: Readiness) -> bool:
    return r.settings.cbrk_supply_chk != SUPPLY_CHECK_OFF


def _charge_required(r: Readiness) -> bool:
    return not r.armed and r.settings.com_arm_bat_min >= 0.0


def _battery_level(r: Readiness) -> BatteryWarning:
    """Return the warning; a charge below COM_ARM_BAT_MIN is at least LOW."""
    warning = r.conditions.battery_warning
    if _charge_required(r) and r.charge_short:
        return max(warning, BatteryWarning.LOW)
    return warning


def _battery_blocks(r: Readiness) -> bool:
    """Return whether the charge prevents arming: below COM_ARM_BAT_MIN, else critical."""
    # COM_ARM_BAT_MIN replaces PX4's fixed limit.
    if _charge_required(r):
        return r.charge_short
    return r.conditions.battery_warning >= BatteryWarning.CRITICAL


def _battery_urgency(r: Readiness) -> Level:
    critical = r.conditions.battery_warning >= BatteryWarning.CRITICAL or r.charge_short
    return Level.CRITICAL if critical else Level.WARNING


_FIELD_REQUIRED, _FIELD_WARNED = 1, 2
"""COM_ARM_MAG_STR: 1 rejects arming in a disturbed magnetic field, 2 warns, 0 is off."""
_GLOBAL_REQUIRED = 0
"""COM_ARM_WO_GPS: 0 rejects arming without a global position, 1 warns, 2 is off."""
_FENCE_RETURN = 3
_STICKS_DISABLED = 4
"""COM_RC_IN_MODE: 4 disables stick input."""
_POSITION = Need.LOCAL_POSITION | Need.LOCAL_POSITION_RELAXED | Need.GLOBAL_POSITION
_ANYTHING = Need.ANGULAR_VELOCITY | Need.MANUAL_CONTROL | Need.NOT_ARMING
"""Needs that together cover every mode."""


def _no_sticks_wanted(r: Readiness) -> bool:
    return r.settings.com_rc_in_mode == _STICKS_DISABLED


CHECKS: tuple[PrearmCheck, ...] = (
    _sensor(HealthComponent.ACCEL, "Accel 0", events.ACCEL_NO_DATA, lambda r: not r.accel),
    _sensor(HealthComponent.GYRO, "Gyro 0", events.GYRO_NO_DATA, lambda r: not r.gyro),
    _sensor(
        HealthComponent.BARO,
        "Baro 0",
        events.BARO_NO_DATA,
        lambda r: bool(r.settings.sys_has_baro) and not r.baro,
    ),
    _sensor(
        HealthComponent.MAG,
        "Compass 0",
        events.MAG_NO_DATA,
        lambda r: bool(r.settings.sys_has_mag) and not r.mag,
    ),
    PrearmCheck(
        HealthComponent.GPS,
        lambda r: bool(r.settings.sys_has_gps) and not r.gps and r.settings.com_arm_wo_gps == 0,
        events.GPS_FIX_TOO_LOW,
    ),
    PrearmCheck(
        HealthComponent.GPS,
        lambda r: (
            bool(r.settings.sys_has_gps)
            and not r.gps
            and not r.armed
            and r.settings.com_arm_wo_gps == 1
        ),
        events.GPS_FIX_TOO_LOW,
        prefix="Preflight: ",
        blocks=never,
        severity=Severity.WARNING,
        level=lambda _: Level.WARNING,
        shown=lambda _: _POSITION,
    ),
    PrearmCheck(
        HealthComponent.DISTANCE_SENSOR,
        lambda r: r.settings.sys_has_num_dist > 0 and r.distance is None,
        events.DISTANCE_SENSOR_MISSING,
        told="Preflight Fail: Distance Sensor 0 missing",
    ),
    PrearmCheck(
        HealthComponent.DISTANCE_SENSOR,
        lambda r: r.settings.sys_has_num_dist > 0 and r.distance is False,
        events.DISTANCE_SENSOR_INVALID,
        told="Preflight Fail: no valid data from distance sensor 0",
    ),
    _battery(BatteryWarning.LOW, events.BATTERY_LOW),
    _battery(BatteryWarning.CRITICAL, events.BATTERY_CRITICAL),
    _battery(BatteryWarning.EMERGENCY, events.BATTERY_EMERGENCY),
    PrearmCheck(
        HealthComponent.BATTERY,
        lambda r: _supply_checked(r) and r.conditions.battery_unhealthy,
        events.BATTERY_UNHEALTHY,
    ),
    PrearmCheck(
        HealthComponent.BATTERY,
        lambda r: _supply_checked(r) and r.conditions.battery_low_remaining_time,
        events.BATTERY_TIME_LOW,
        prefix="",
        said=False,
    ),
    PrearmCheck(
        HealthComponent.ESTIMATOR,
        lambda r: not r.converged and not r.armed,
        events.ESTIMATOR_MISSING,
        told="Preflight Fail: ekf2 missing data",
        said=False,
    ),
    PrearmCheck(
        HealthComponent.ESTIMATOR,
        lambda r: not r.compass_agrees and not r.armed,
        events.HEADING_UNSTABLE,
        told="Preflight Fail: heading estimate not stable",
    ),
    PrearmCheck(
        HealthComponent.ESTIMATOR,
        lambda r: _field_fails(r, _FIELD_REQUIRED),
        events.MAG_INTERFERENCE,
    ),
    PrearmCheck(
        HealthComponent.ESTIMATOR,
        lambda r: _field_fails(r, _FIELD_WARNED),
        events.MAG_INTERFERENCE,
        prefix="Preflight: ",
        # The estimator starts only after the disturbance has ended.
        blocks=lambda r: not r.converged,
        severity=Severity.WARNING,
    ),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: r.rolled,
        events.ROLLED,
        told="Preflight Fail: Attitude failure (roll)",
    ),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: r.pitched and not r.rolled,
        events.PITCHED,
        told="Preflight Fail: Attitude failure (pitch)",
    ),
    PrearmCheck(
        HealthComponent.SYSTEM, lambda r: r.conditions.fd_motor_failure, events.MOTOR_FAILED
    ),
    _fence("distance", events.FENCE_DISTANCE),
    _fence("altitude", events.FENCE_ALTITUDE),
    _fence("custom", events.FENCE_CUSTOM),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: (
            r.settings.gf_action == _FENCE_RETURN
            and r.conditions.home_position_invalid
            and r.converged
        ),
        events.FENCE_NO_HOME,
    ),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: r.conditions.mission_failure,
        events.MISSION_FAILURE,
        prefix="",
    ),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: r.conditions.flight_time_limit_exceeded,
        events.FLIGHT_TIME,
        prefix="",
    ),
    PrearmCheck(
        HealthComponent.LINK,
        lambda r: r.conditions.gcs_connection_lost and r.settings.nav_dll_act > 0,
        events.NO_GCS,
        severity=Severity.WARNING,
    ),
    PrearmCheck(
        HealthComponent.LINK,
        lambda r: r.conditions.gcs_connection_lost and r.settings.nav_dll_act <= 0,
        events.NO_GCS,
        prefix="",
        said=False,
        blocks=never,
        level=lambda _: Level.INFO,
    ),
    PrearmCheck(HealthComponent.SYSTEM, lambda r: r.terminated, events.TERMINATED),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: _global_required(r) and r.conditions.global_position_invalid,
        events.NO_GLOBAL_POSITION,
    ),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: _global_required(r) and r.conditions.home_position_invalid,
        events.NO_HOME,
    ),
    # Mode requirements. Like PX4, reported by events only until arming is rejected.
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: _needs(r, Need.NOT_ARMING) and not r.terminated and not r.armed,
        events.MODE_CANNOT_ARM,
        said=False,
        of_present_mode=True,
    ),
    _estimate("attitude", events.MODE_ATTITUDE, Need.ATTITUDE, lambda c: c.attitude_invalid),
    _estimate(
        "position",
        events.MODE_LOCAL_POSITION,
        Need.LOCAL_POSITION | Need.LOCAL_POSITION_RELAXED,
        lambda c: c.local_position_invalid,
    ),
    _estimate(
        "global position",
        events.MODE_GLOBAL_POSITION,
        Need.GLOBAL_POSITION,
        lambda c: c.global_position_invalid and not c.local_position_invalid,
    ),
    _estimate("altitude", events.MODE_ALTITUDE, Need.ALTITUDE, lambda c: c.local_altitude_invalid),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: (
            r.conditions.auto_mission_missing
            and (bool(r.settings.com_arm_mis_req) or _needs(r, Need.MISSION))
        ),
        events.MODE_MISSION,
        said=False,
    ),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: r.conditions.offboard_control_signal_lost and _needs(r, Need.OFFBOARD_SIGNAL),
        events.MODE_OFFBOARD,
        said=False,
    ),
    PrearmCheck(
        HealthComponent.SYSTEM,
        lambda r: r.conditions.home_position_invalid and _needs(r, Need.HOME),
        events.MODE_HOME,
        said=False,
    ),
    PrearmCheck(
        HealthComponent.MANUAL_CONTROL,
        lambda r: r.conditions.manual_control_signal_lost and _needs(r, Need.MANUAL_CONTROL),
        events.MODE_MANUAL,
        said=False,
        level=lambda r: Level.ERROR if _no_sticks_wanted(r) else Level.WARNING,
        shown=lambda r: Need.MANUAL_CONTROL if _no_sticks_wanted(r) else _ANYTHING,
    ),
)
"""Checks in reporting order."""


@lru_cache(maxsize=256)
def failing(readiness: Readiness) -> tuple[PrearmCheck, ...]:
    """Return the failing checks."""
    return tuple(check for check in CHECKS if check.fails(readiness))


def blocking(checks: tuple[PrearmCheck, ...], readiness: Readiness) -> tuple[PrearmCheck, ...]:
    """Return the failing checks that prevent arming in the mode."""
    return tuple(check for check in checks if check.blocks is None or check.blocks(readiness))


def can_arm(readiness: Readiness) -> tuple[PrearmCheck, ...]:
    """Return the checks that prevent arming in a mode; empty = armable."""
    return blocking(failing(readiness), readiness)

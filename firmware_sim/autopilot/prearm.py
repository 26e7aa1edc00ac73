"""Pre-arm checks with their texts, one row per check, pure.

The rows also define component health for clients (SYS_STATUS). Source: PX4 1.16 to 1.18,
commander/HealthAndArmingChecks, without checks of components that this vehicle lacks. Texts and
levels belong to the current release; `checks` takes any release.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, lru_cache, partial
from typing import Any, NamedTuple

from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName, px4_release
from firmware_sim.autopilot.autopilot_state import Severity
from firmware_sim.autopilot.events.definition import Component, Definition, Level, arguments
from firmware_sim.autopilot.failsafes.failsafe_conditions import BatteryWarning, Conditions
from firmware_sim.autopilot.flight_modes import Mode, Need

SUPPLY_CHECK_OFF = 894281
"""Value of CBRK_SUPPLY_CHK that disables the battery checks."""


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
    failed_motors: int = 0
    """Failed motors as bits."""
    offboard_lacks: str = ""
    """Estimate that the newest offboard setpoint needs and that is invalid."""
    terminated: bool = False
    armed: bool = False
    release: PX4ReleaseName = CURRENT


class PrearmCheck(NamedTuple):
    """Pre-arm check."""

    event: Definition
    """Event for ground stations; its first arguments are the affected modes and the component."""
    component: Component
    fails: Callable[[Readiness], bool]
    operator_text: str = ""
    """Text for the operator; "" = `prefix` and the event's message."""
    prefix: str = "Preflight Fail: "
    announced: bool = True
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
    values: tuple[float, ...] = ()
    """Additional arguments of the event."""

    @property
    def text(self) -> str:
        """Text for the operator."""
        return self.operator_text or self.prefix + self.event.message

    @property
    def is_health(self) -> bool:
        """True for a hardware fault, False for an unmet arming requirement."""
        return self.event.group == "health"


_ABOUT = arguments("navigation_mode_group_t modes, uint8_t health_component_index")
_INSTANCE = arguments("uint8_t instance")
_C, _L = Component, Level
_SYSTEM, _ESTIMATE = Component.SYSTEM, Component.LOCAL_POSITION_ESTIMATE


def never(_readiness: Readiness) -> bool:
    """Return False: the check never prevents arming."""
    return False


def _check(
    component: Component,
    name: str,
    message: str,
    fails: Callable[[Readiness], bool],
    event_level: Level = Level.ERROR,
    description: str = "",
    *,
    parameters: str = "",
    **rest: Any,
) -> PrearmCheck:
    """Return an arming requirement; `parameters` configure the check if given."""
    # PX4 documents such checks by the parameters that configure them.
    if parameters:
        named = " and ".join(f"<param>{each}</param>" for each in parameters.split())
        description = f"Configured by {named}."
    definition = Definition(
        f"check_{name}", message, _ABOUT, event_level, description=description, group="arming_check"
    )
    return PrearmCheck(definition, component, fails, **rest)


def _health(
    component: Component,
    name: str,
    message: str,
    fails: Callable[[Readiness], bool],
    *,
    number: int | None = None,
    event_level: Level = Level.ERROR,
    operator_text: str = "",
) -> PrearmCheck:
    """Return a check of hardware; `number`: the number of the part in the event."""
    extra = () if number is None else _INSTANCE
    event = Definition(f"check_{name}", message, _ABOUT + extra, event_level, group="health")
    values = () if number is None else (number,)
    return PrearmCheck(event, component, fails, operator_text, values=values)


def _no_data(
    component: Component,
    name: str,
    sensor: str,
    short: str,
    fails: Callable[[Readiness], bool],
) -> PrearmCheck:
    return _health(
        component,
        f"{name}_no_data",
        f"No valid data from {sensor} {{3}}",
        fails,
        number=0,
        operator_text=f"Preflight Fail: No valid data from {short} 0",
    )


def _needs(r: Readiness, need: Need) -> bool:
    return bool(r.mode.spec.needs & need)


def _needed(
    name: str,
    message: str,
    need: Need,
    fails: Callable[[Conditions], bool],
    *event: Any,
    component: Component = _SYSTEM,
    estimate: str = "",
    **rest: Any,
) -> PrearmCheck:
    """Return a requirement of the mode, reported by an event alone until arming is rejected.

    An `estimate` fails in every mode, and blocks the modes that need it.
    """
    operator_text = f"Preflight Fail: No valid {estimate} estimate" if estimate else ""
    # PX4 reports a missing estimate in every mode, but rejects only modes that need it.
    if estimate:
        rest["blocks"] = lambda r: _needs(r, need)
    return _check(
        component,
        f"modes_{name}",
        message,
        # Other requirements are reported only in modes that have them.
        lambda r: fails(r.conditions) and (bool(estimate) or _needs(r, need)),
        *event,
        operator_text=operator_text,
        announced=False,
        **rest,
    )


# Before convergence, another check explains the missing position.
def _global_required(r: Readiness) -> bool:
    return r.settings.com_arm_wo_gps == _GLOBAL_REQUIRED and not r.armed and r.converged


def _fence(kind: str, name: str, message: str, parameters: str) -> PrearmCheck:
    return _check(
        _SYSTEM,
        f"gf_violation_{name}",
        f"Geofence violation: {message}",
        lambda r: getattr(r.conditions.geofence, kind) and r.settings.gf_action != 0,
        parameters=parameters,
        operator_text=f"Geofence: {message}",
    )


def _offboard(reason: str, message: str, lacks: str = "") -> PrearmCheck:
    """Return a requirement of an offboard signal with its reason, as since PX4 1.18."""
    return _check(
        _SYSTEM,
        f"modes_offboard_{reason}",
        message,
        lambda r: (
            _needs(r, Need.OFFBOARD_SIGNAL)
            and r.conditions.offboard_control_signal_lost
            and r.offboard_lacks == lacks
        ),
        announced=False,
    )


def _undercurrent(motor: int) -> PrearmCheck:
    return _health(
        _C.MOTORS_ESCS,
        "motor_undercurrent",
        "Motor {3} undercurrent detected",
        lambda r: bool(r.failed_motors >> (motor - 1) & 1),
        number=motor,
        event_level=Level.CRITICAL,
        operator_text=f"Motor failure: Motor {motor} undercurrent detected",
    )


def _battery(
    warning: BatteryWarning, name: str, message: str, level: Level, threshold: str
) -> PrearmCheck:
    return _check(
        _C.BATTERY,
        name,
        message,
        lambda r: _supply_checked(r) and _battery_level(r) is warning,
        level,
        f"The charge is below <param>{threshold}</param>.",
        prefix="",
        blocks=_battery_blocks,
        severity=level,
    )


def _supply_checked(r: Readiness) -> bool:
    return r.settings.cbrk_supply_chk != SUPPLY_CHECK_OFF


def _charge_required(r: Readiness) -> bool:
    # A negative value disables the requirement; in flight only the warnings count.
    return not r.armed and r.settings.com_arm_bat_min >= 0.0


def _battery_level(r: Readiness) -> BatteryWarning:
    """Return the warning; a charge below COM_ARM_BAT_MIN is at least LOW."""
    warning = r.conditions.battery_warning
    # COM_ARM_BAT_MIN may be above the warning threshold: the check must still have a text.
    return max(warning, BatteryWarning.LOW) if _charge_required(r) and r.charge_short else warning


def _battery_blocks(r: Readiness) -> bool:
    """Return whether the charge prevents arming: below COM_ARM_BAT_MIN, else critical."""
    # COM_ARM_BAT_MIN replaces PX4's fixed limit.
    if _charge_required(r):
        return r.charge_short
    return r.conditions.battery_warning >= BatteryWarning.CRITICAL


def _battery_urgency(r: Readiness) -> Level:
    critical = r.conditions.battery_warning >= BatteryWarning.CRITICAL or r.charge_short
    return Level.CRITICAL if critical else Level.WARNING


def _no_sticks_wanted(r: Readiness) -> bool:
    return r.settings.com_rc_in_mode == _STICKS_DISABLED


def _field_fails(r: Readiness, as_asked: int) -> bool:
    return r.field_disturbed and not r.armed and r.settings.com_arm_mag_str == as_asked


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
_NOT_ENOUGH = "The available positioning data is not enough for the mode."

_gps_fix = partial(
    _check, _C.GPS, "estimator_gps_fix_too_low", "GPS fix too low", parameters="COM_ARM_WO_GPS"
)
_no_gcs = partial(
    _check,
    _C.COMMUNICATION_LINKS,
    "rc_dl_no_dllink",
    "No connection to the ground control station",
    parameters="NAV_DLL_ACT",
)
_mag_interference = partial(
    PrearmCheck,
    Definition(
        "check_estimator_mag_interference",
        "Strong magnetic interference",
        _ABOUT
        + arguments("float strength, float strength_ref, float inclination, float inclination_ref"),
        Level.WARNING,
        description="Configured by <param>COM_ARM_MAG_STR</param>.",
        group="arming_check",
    ),
    _ESTIMATE,
    # Field strength [gauss] and inclination [deg], measured and expected: not available here.
    values=(float("nan"),) * 4,
)

CHECKS: tuple[PrearmCheck, ...] = (
    _no_data(_C.ACCEL, "accel", "Accelerometer", "Accel", lambda r: not r.accel),
    _no_data(_C.GYRO, "gyro", "Gyro", "Gyro", lambda r: not r.gyro),
    _no_data(
        _C.ABSOLUTE_PRESSURE,
        "baro",
        "barometer",
        "Baro",
        lambda r: bool(r.settings.sys_has_baro) and not r.baro,
    ),
    _no_data(
        _C.MAGNETOMETER,
        "mag",
        "Compass",
        "Compass",
        lambda r: bool(r.settings.sys_has_mag) and not r.mag,
    ),
    _gps_fix(
        lambda r: bool(r.settings.sys_has_gps) and not r.gps and r.settings.com_arm_wo_gps == 0
    ),
    _gps_fix(
        lambda r: (
            bool(r.settings.sys_has_gps)
            and not r.gps
            and not r.armed
            and r.settings.com_arm_wo_gps == 1
        ),
        prefix="Preflight: ",
        blocks=never,
        severity=Severity.WARNING,
        level=lambda _: Level.WARNING,
        shown=lambda _: _POSITION,
    ),
    _health(
        _C.DISTANCE_SENSOR,
        "distance_sensor_missing",
        "Distance sensor {3} missing",
        lambda r: r.settings.sys_has_num_dist > 0 and r.distance is None,
        number=0,
        operator_text="Preflight Fail: Distance Sensor 0 missing",
    ),
    _health(
        _C.DISTANCE_SENSOR,
        "distance_sensor_invalid",
        "No valid data from distance sensor {3}",
        lambda r: r.settings.sys_has_num_dist > 0 and r.distance is False,
        number=0,
        operator_text="Preflight Fail: No valid distance sensor 0 data",
    ),
    _battery(BatteryWarning.LOW, "battery_low", "Low battery", _L.CRITICAL, "BAT_LOW_THR"),
    _battery(
        BatteryWarning.CRITICAL, "battery_critical", "Critical battery", _L.CRITICAL, "BAT_CRIT_THR"
    ),
    _battery(
        BatteryWarning.EMERGENCY,
        "battery_emergency",
        "Emergency battery level",
        _L.EMERGENCY,
        "BAT_EMERGEN_THR",
    ),
    _check(
        _C.BATTERY,
        "battery_rem_flight_time_low",
        "Remaining flight time low",
        lambda r: _supply_checked(r) and r.conditions.battery_low_remaining_time,
        prefix="",
        announced=False,
    ),
    _check(
        _ESTIMATE,
        "estimator_missing_data",
        "Waiting for estimator to initialize",
        # In flight, failsafes handle a lost estimate.
        lambda r: not r.converged and not r.armed,
        _L.INFO,
        operator_text="Preflight Fail: ekf2 missing data",
        announced=False,
        blocks=lambda r: _needs(r, Need.ATTITUDE),
    ),
    _check(
        _ESTIMATE,
        "estimator_heading_not_stable",
        "Heading estimate not stable",
        # The check concerns arming only.
        lambda r: not r.compass_agrees and not r.armed,
        operator_text="Preflight Fail: heading estimate not stable",
        blocks=lambda r: _needs(r, Need.ATTITUDE),
    ),
    _mag_interference(lambda r: _field_fails(r, _FIELD_REQUIRED)),
    _mag_interference(
        lambda r: _field_fails(r, _FIELD_WARNED),
        prefix="Preflight: ",
        # The estimator starts only after the disturbance has ended.
        blocks=lambda r: not r.converged,
        severity=Severity.WARNING,
    ),
    _check(
        _SYSTEM,
        "failure_detector_roll",
        "Attitude failure detected",
        lambda r: r.rolled,
        _L.CRITICAL,
        "Roll exceeds <param>FD_FAIL_R</param>.",
        operator_text="Preflight Fail: Attitude failure (roll)",
    ),
    _check(
        _SYSTEM,
        "failure_detector_pitch",
        "Attitude failure detected",
        # PX4 reports one attitude failure at a time, roll first.
        lambda r: r.pitched and not r.rolled,
        _L.CRITICAL,
        "Pitch exceeds <param>FD_FAIL_P</param>.",
        operator_text="Preflight Fail: Attitude failure (pitch)",
    ),
    _health(
        _C.MOTORS_ESCS,
        "failure_detector_motor",
        "Motor failure detected",
        lambda r: bool(r.failed_motors),
        event_level=_L.CRITICAL,
    ),
    *map(_undercurrent, range(1, 5)),
    _fence(
        "distance",
        "max_hor_dist",
        "exceeding maximum distance to Home",
        "GF_ACTION GF_MAX_HOR_DIST",
    ),
    _fence(
        "altitude", "max_alt", "exceeding maximum altitude above Home", "GF_ACTION GF_MAX_VER_DIST"
    ),
    _fence("custom", "custom_gf", "approaching or outside geofence", "GF_ACTION"),
    _check(
        _SYSTEM,
        "gf_no_home",
        "Geofence RTL requires valid home",
        lambda r: (
            r.settings.gf_action == _FENCE_RETURN
            and r.conditions.home_position_invalid
            and r.converged
        ),
    ),
    _check(
        _SYSTEM,
        "flight_time_limit",
        "Maximum flight time reached",
        lambda r: r.conditions.flight_time_limit_exceeded,
        parameters="COM_FLT_TIME_MAX",
        prefix="",
    ),
    _no_gcs(
        lambda r: r.conditions.gcs_connection_lost and r.settings.nav_dll_act > 0,
        operator_text="Preflight Fail: No connection to the GCS",
        severity=Severity.WARNING,
    ),
    _no_gcs(
        lambda r: r.conditions.gcs_connection_lost and r.settings.nav_dll_act <= 0,
        prefix="",
        announced=False,
        blocks=never,
        level=lambda _: Level.INFO,
    ),
    _check(
        _SYSTEM,
        "system_flight_term_active",
        "Flight termination active",
        lambda r: r.terminated,
        _L.CRITICAL,
    ),
    _check(
        _SYSTEM,
        "system_no_global_pos",
        "Global position estimate required",
        lambda r: _global_required(r) and r.conditions.global_position_invalid,
        parameters="COM_ARM_WO_GPS",
    ),
    _check(
        _SYSTEM,
        "system_no_home_pos",
        "Home position required",
        lambda r: _global_required(r) and r.conditions.home_position_invalid,
        parameters="COM_ARM_WO_GPS",
    ),
    # Mode requirements. Like PX4, reported by events only until arming is rejected.
    _check(
        _SYSTEM,
        "modes_cannot_takeoff",
        "Mode not suitable for arming",
        lambda r: _needs(r, Need.NOT_ARMING) and not r.terminated and not r.armed,
        _L.INFO,
        "Switch to another mode first.",
        announced=False,
        of_present_mode=True,
    ),
    _needed(
        "attitude",
        "No valid attitude estimate",
        Need.ATTITUDE,
        lambda c: c.attitude_invalid,
        _L.CRITICAL,
        "Wait until the estimator has initialized.",
        component=_C.ATTITUDE_ESTIMATE,
        estimate="attitude",
    ),
    _needed(
        "local_pos",
        "Navigation error: No valid position estimate",
        Need.LOCAL_POSITION | Need.LOCAL_POSITION_RELAXED,
        lambda c: c.local_position_invalid,
        _L.ERROR,
        _NOT_ENOUGH,
        component=_ESTIMATE,
        estimate="position",
    ),
    _needed(
        "global_pos",
        "Navigation error: No valid global position estimate",
        Need.GLOBAL_POSITION,
        # Without a local position, that check explains the failure already.
        lambda c: c.global_position_invalid and not c.local_position_invalid,
        _L.ERROR,
        _NOT_ENOUGH,
        component=_C.GLOBAL_POSITION_ESTIMATE,
        estimate="global position",
    ),
    _needed(
        "local_alt",
        "Navigation error: No valid altitude estimate",
        Need.ALTITUDE,
        lambda c: c.local_altitude_invalid,
        _L.CRITICAL,
        _NOT_ENOUGH,
        estimate="altitude",
    ),
    _check(
        _SYSTEM,
        "modes_mission",
        "No valid mission available",
        lambda r: (
            r.conditions.auto_mission_missing
            and (bool(r.settings.com_arm_mis_req) or _needs(r, Need.MISSION))
        ),
        _L.INFO,
        "Upload a mission first.",
        announced=False,
    ),
    _needed(
        "offboard_signal",
        "No offboard signal",
        Need.OFFBOARD_SIGNAL,
        lambda c: c.offboard_control_signal_lost,
        _L.ERROR,
        "Setpoints are not sent, or the commanded quantity is not estimated.",
    ),
    _offboard("no_local_position", "Offboard requires local position", "position"),
    _offboard("no_local_velocity", "Offboard requires local velocity", "velocity"),
    _offboard("signal_lost", "No offboard signal"),
    _needed(
        "home_position",
        "Home position not set",
        Need.HOME,
        lambda c: c.home_position_invalid,
        _L.INFO,
    ),
    _needed(
        "manual_control",
        "No manual control input",
        Need.MANUAL_CONTROL,
        lambda c: c.manual_control_signal_lost,
        _L.WARNING,
        "Connect sticks, or choose a mode that needs none.",
        component=_C.REMOTE_CONTROL,
        level=lambda r: Level.ERROR if _no_sticks_wanted(r) else Level.WARNING,
        shown=lambda r: Need.MANUAL_CONTROL if _no_sticks_wanted(r) else _ANYTHING,
    ),
)
"""Checks of all releases in reporting order."""


@cache
def checks(release: PX4ReleaseName) -> tuple[PrearmCheck, ...]:
    """Return the checks of a release in reporting order."""
    found = px4_release(release)
    return tuple(
        _of_release(check, found.events.get(check.event.name, {}))
        for check in CHECKS
        if check.event.name not in found.unknown_events
    )


def _of_release(check: PrearmCheck, change: Mapping[str, str]) -> PrearmCheck:
    """Return a check with the event, text, severity and modes of another release."""
    if "text" in change:
        check = check._replace(operator_text=change["text"])
    if "severity" in change:
        check = check._replace(severity=Level[change["severity"]])
    if "grades" in change:
        check = check._replace(level=_battery_urgency)
    if "needs" in change:
        needs = [Need[name] for name in change["needs"].split()]
        check = check._replace(blocks=lambda r: any(_needs(r, need) for need in needs))
    return check._replace(event=check.event.of_release(change))


@lru_cache(maxsize=256)
def failing(readiness: Readiness) -> tuple[PrearmCheck, ...]:
    """Return the failing checks."""
    # Cached: the commander asks several times per second, and readiness rarely changes.
    return tuple(check for check in checks(readiness.release) if check.fails(readiness))


def blocking(checks: tuple[PrearmCheck, ...], readiness: Readiness) -> tuple[PrearmCheck, ...]:
    """Return the failing checks that prevent arming in the mode."""
    return tuple(check for check in checks if check.blocks is None or check.blocks(readiness))


def can_arm(readiness: Readiness) -> tuple[PrearmCheck, ...]:
    """Return the checks that prevent arming in a mode; empty = armable."""
    return blocking(failing(readiness), readiness)

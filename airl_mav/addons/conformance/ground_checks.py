"""Checks on the ground: identity, message streams, rejected commands, arming."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from airl_mav.addons.conformance import checklist
from airl_mav.addons.conformance.telemetry import Fields
from airl_mav.addons.conformance.vehicle import Method, VehicleConnection
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.profiles.px4_release import version_name

FIRST_MESSAGE_S = 5.0  # Timeout of a message that every vehicle sends [wall s]
COUNT_S = 5.0  # Duration of message counting [s]
# Rate tolerance: a share of the expected rate, or a number of messages.
RATE_SHARE, RATE_MESSAGES = 0.10, 1.5
READY_S = 120.0  # Timeout until ready to arm [s]; ArduPilot takes some 40 s from its start
# Minimum time ready, because one report may precede a reboot [s].
READY_SETTLE_S = 1.0
TEXT_S = 1.0  # Maximum delay of a STATUSTEXT that belongs to an answer [s]
ARM_S = 20.0  # Timeout of arming retries [s]
AUTOPILOT_VERSION_ID = 148
NEEDED_CAPABILITIES = {128: "SET_POSITION_TARGET_LOCAL_NED", 8192: "MAVLINK2"}

ASKED_HZ: Mapping[str, tuple[int, float]] = {
    "ATTITUDE": (30, 100.0),
    "LOCAL_POSITION_NED": (32, 100.0),
    "EXTENDED_SYS_STATE": (245, 10.0),
    "SYS_STATUS": (1, 5.0),
}
"""Requested messages: message id, rate [Hz]."""

UNKNOWN_MAIN_MODE = 99


def heartbeat(vehicle: VehicleConnection) -> str:
    """Wait for a heartbeat, and expect its autopilot's behaviour in later checks."""
    beat = _first(vehicle, "HEARTBEAT")
    vehicle.expect_autopilot(beat["autopilot"])
    who = f"{vehicle.autopilot.title}, MAV_TYPE {beat['type']}"
    checklist.require(not vehicle.armed, f"{who}: it is armed already: disarm it first")
    return f"{who}, {vehicle.mode_name}, disarmed"


def require_answer(
    vehicle: VehicleConnection, result: int, expected: checklist.ExpectedAnswer, since: int
) -> str:
    """Return the finding of the expected MAV_RESULT. Raises CheckFailedError for others."""
    name = checklist.name_of(checklist.MavResult, result)
    checklist.require(result == expected.result, f"{name}, not {expected.result.name}")
    if not expected.text:
        return name
    heard = vehicle.wait_for(lambda: vehicle.telemetry.find_text(expected.text, since), TEXT_S)
    checklist.require(heard, f'{name} without "{expected.text}"')
    return f'{name}, "{heard.text}"'


def version(vehicle: VehicleConnection) -> str:
    """Request AUTOPILOT_VERSION; expect the needed capabilities."""
    # MAVSDK requests it when it connects.
    if vehicle.telemetry.latest("AUTOPILOT_VERSION") is None:
        vehicle.command(
            checklist.MavCommand.REQUEST_MESSAGE, AUTOPILOT_VERSION_ID, note="AUTOPILOT_VERSION"
        )
    fields = _first(vehicle, "AUTOPILOT_VERSION")
    capabilities = fields["capabilities"]
    name = version_name(fields["flight_sw_version"])
    finding = f"version {name}, capabilities {capabilities:#x}"
    missing = [name for bit, name in NEEDED_CAPABILITIES.items() if not capabilities & bit]
    checklist.require(not missing, f"{finding}: without {', '.join(missing)}")
    return finding


def _clock(vehicle: VehicleConnection) -> str:
    method = vehicle.clock.choose_method()
    if method is Method.TELEMETRY:
        raise checklist.NotApplicableError(
            "neither TIMESYNC nor SYSTEM_TIME is answered: times are coarse"
        )
    return f"read from {method.value}"


def _unasked_streams(vehicle: VehicleConnection) -> str:
    counts, elapsed_s = vehicle.count_messages(COUNT_S)
    rates = {name: number / elapsed_s for name, number in counts.most_common()}
    listed = ", ".join(f"{name} {rate:.3g}" for name, rate in rates.items())
    vehicle.transcript.add("note", f"unasked [Hz]: {listed or 'nothing'}")
    total = f"{sum(rates.values()):.0f} messages a second unasked"
    if vehicle.url.startswith("serial"):
        raise checklist.NotApplicableError(
            f"{total}; what a serial link carries is a setting of its port"
        )
    _require_rates(counts, elapsed_s, vehicle.unasked_hz, f"{total}: ")
    return f"{total}, as stored"


def _ask_streams(vehicle: VehicleConnection) -> str:
    for name, (number, rate_hz) in ASKED_HZ.items():
        period_us = round(US_PER_S / rate_hz)
        note = f"{name} {rate_hz:g} Hz"
        result = vehicle.command(
            checklist.MavCommand.SET_MESSAGE_INTERVAL, number, period_us, note=note
        )
        checklist.require(
            result == 0,
            f"{name} at {rate_hz:g} Hz: {checklist.name_of(checklist.MavResult, result)}",
        )
    return ", ".join(f"{name} {rate:g} Hz" for name, (_, rate) in ASKED_HZ.items()) + " accepted"


def _ready(vehicle: VehicleConnection) -> str:
    stopwatch, ready_us = WallClock(vehicle.speed), None
    telemetry = vehicle.telemetry
    while True:
        now_us = stopwatch.time_us()
        status = telemetry.latest("SYS_STATUS") or {}
        ready = status.get("onboard_control_sensors_health", 0) & checklist.PREARM_CHECK
        if not ready or telemetry.latest("LOCAL_POSITION_NED") is None:
            ready_us = None
        elif ready_us is None:
            ready_us = now_us
        elif now_us - ready_us > READY_SETTLE_S * US_PER_S:
            return f"after {ready_us / US_PER_S:.1f} s"
        if now_us > READY_S * US_PER_S:
            text = telemetry.texts[-1].text if telemetry.texts else "none"
            raise checklist.CheckFailedError(
                f"not ready to arm after {READY_S:g} s; last STATUSTEXT: {text}"
            )
        vehicle.poll()


def _asked_streams(vehicle: VehicleConnection) -> str:
    counts, elapsed_s = vehicle.count_messages(COUNT_S)
    _require_rates(counts, elapsed_s, {name: rate for name, (_, rate) in ASKED_HZ.items()})
    return ", ".join(f"{name} {counts[name] / elapsed_s:.3g}" for name in ASKED_HZ) + " Hz"


def _unknown_command(vehicle: VehicleConnection) -> str:
    result = vehicle.command(checklist.UNKNOWN_COMMAND)
    return require_answer(
        vehicle, result, checklist.ExpectedAnswer(checklist.MavResult.UNSUPPORTED), 0
    )


def _unknown_mode(vehicle: VehicleConnection) -> str:
    mode, since = vehicle.mode, len(vehicle.telemetry.texts)
    result = vehicle.command(
        checklist.MavCommand.DO_SET_MODE, checklist.CUSTOM_MODE_FLAG, UNKNOWN_MAIN_MODE
    )
    vehicle.wait(TEXT_S)
    finding = require_answer(vehicle, result, vehicle.autopilot.unknown_mode, since)
    checklist.require(vehicle.mode == mode, f"{finding}, and the mode changed")
    return f"{finding}, no change of mode"


def _offboard_without_setpoint(vehicle: VehicleConnection) -> str:
    local = vehicle.call("offboard.start()", vehicle.offboard.start)
    checklist.require(
        local == "NO_SETPOINT_SET", f"MAVSDK: {local or 'SUCCESS'}, not NO_SETPOINT_SET"
    )
    autopilot, since = vehicle.autopilot, len(vehicle.telemetry.texts)
    result = vehicle.set_mode(autopilot.offboard, "no setpoint")
    answer = require_answer(vehicle, result, autopilot.offboard_on_ground, since)
    finding = f"MAVSDK: {local}; DO_SET_MODE: {answer}"
    if autopilot.arms_without_setpoint:
        return finding
    refused = vehicle.call("action.arm()", vehicle.action.arm)
    vehicle.set_mode(autopilot.hold, "back")
    vehicle.reaches_mode(*autopilot.hold_modes)
    finding += f"; arming then: {refused or 'SUCCESS'}"
    return checklist.require(refused == "COMMAND_DENIED", finding)


def _arm(vehicle: VehicleConnection) -> str:
    stopwatch, attempts = WallClock(vehicle.speed), 1
    vehicle.may_be_armed = True
    while reason := vehicle.call("action.arm()", vehicle.action.arm):
        checklist.require(stopwatch.time_us() < ARM_S * US_PER_S, f"{reason}, {attempts} times")
        attempts += 1
        vehicle.wait(1.0)
    armed = vehicle.wait_for(lambda: vehicle.armed, 3.0)
    checklist.require(armed, "accepted, but the heartbeat says disarmed")
    return "ACCEPTED, armed" + (f" at attempt {attempts}" if attempts > 1 else "")


def _first(vehicle: VehicleConnection, name: str) -> Fields:
    """Return the newest message of a name. Raises CheckFailedError on timeout."""
    stopwatch = WallClock()
    while (fields := vehicle.telemetry.latest(name)) is None:
        checklist.require(stopwatch.time_us() < FIRST_MESSAGE_S * US_PER_S, f"no {name}")
        vehicle.poll()
    return fields


def _require_rates(
    counts: Counter[str], elapsed_s: float, expected_hz: Mapping[str, float], finding: str = ""
) -> None:
    """Raise CheckFailedError unless messages arrive at the expected rates."""
    wrong = [
        f"{name} {counts[name] / elapsed_s:.3g} Hz, not {rate_hz:g}"
        for name, rate_hz in expected_hz.items()
        if abs(counts[name] - rate_hz * elapsed_s)
        > max(RATE_SHARE * rate_hz * elapsed_s, RATE_MESSAGES)
    ]
    checklist.require(not wrong, finding + "; ".join(wrong))


GROUND_CHECKS = (
    checklist.CheckDefinition("clock", _clock, for_steps=True),
    checklist.CheckDefinition("streams unasked", _unasked_streams),
    checklist.CheckDefinition("streams asked for", _ask_streams, essential=True, for_steps=True),
    checklist.CheckDefinition("ready to arm", _ready, essential=True, for_steps=True),
    checklist.CheckDefinition("stream rates", _asked_streams, for_steps=True),
    checklist.CheckDefinition("unknown command", _unknown_command),
    checklist.CheckDefinition("unknown mode", _unknown_mode),
    checklist.CheckDefinition(
        "offboard without setpoint, on the ground", _offboard_without_setpoint
    ),
    checklist.CheckDefinition("arm", _arm, essential=True, for_steps=True),
)
"""Ground checks, executed in this order after the heartbeat."""

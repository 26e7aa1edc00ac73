"""Checks on the ground: who it is, what it says unasked and asked, what it refuses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from airl_mav.conformance.checks import FailedError, NotApplicableError, require
from airl_mav.conformance.family import Answer
from airl_mav.conformance.inbox import Fields
from airl_mav.conformance.session import Session
from airl_mav.conformance.vehicle_clock import Method
from airl_mav.conformance.words import (
    CUSTOM_MODE_FLAG,
    DO_SET_MODE,
    PREARM_CHECK,
    REQUEST_MESSAGE,
    SET_MESSAGE_INTERVAL,
    UNKNOWN_COMMAND,
    UNSUPPORTED,
    VEHICLES,
    result_name,
    version_name,
)
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S

FIRST_WORDS_S = 5.0
"""How long a message that surely comes is waited for [wall s]."""

FRESH_S = 5.0
"""A fresh connection is listened to for so long [s]."""

RATE_S = 5.0
"""Rates that were asked for are counted for so long [s]."""

RATE_SHARE = 0.10
"""A rate may be so far off, of the one stored or asked for..."""

RATE_MESSAGES = 1.5
"""...or so many messages, in the time they are counted."""

READY_S = 120.0
"""Longest wait until it may be armed [s]; ArduPilot takes some 40 s from its start."""

READY_SETTLE_S = 1.0
"""It must have said so for so long: a report from before a reboot may still be good news [s]."""

TEXT_S = 1.0
"""A STATUSTEXT belongs to an answer when it comes within [s]."""

AUTOPILOT_VERSION_ID = 148
NEEDED_CAPABILITIES = {128: "SET_POSITION_TARGET_LOCAL_NED", 8192: "MAVLINK2"}

ASKED_HZ: Mapping[str, tuple[int, float]] = {
    "ATTITUDE": (30, 100.0),
    "LOCAL_POSITION_NED": (32, 100.0),
    "EXTENDED_SYS_STATE": (245, 10.0),
    "SYS_STATUS": (1, 5.0),
}
"""Streams that are asked for: message id, rate [Hz]."""

UNKNOWN_MAIN_MODE = 99


def heartbeat(session: Session) -> str:
    """Wait for a heartbeat, and expect the ways of the autopilot that it names."""
    beat = _hear(session, "HEARTBEAT")
    session.choose_family(beat["autopilot"])
    vehicle = VEHICLES.get(beat["type"], "vehicle")
    who = f"{session.family.title} (autopilot {beat['autopilot']}), {vehicle} (type {beat['type']})"
    require(not session.armed, f"{who}: it is armed already: disarm it first")
    return f"{who}, {session.inbox.mode_name(beat['custom_mode'])}, disarmed"


def version(session: Session) -> str:
    """Read AUTOPILOT_VERSION, which MAVSDK asks for when it connects."""
    if session.inbox.latest("AUTOPILOT_VERSION") is None:
        session.command(REQUEST_MESSAGE, AUTOPILOT_VERSION_ID, note="AUTOPILOT_VERSION")
    fields = _hear(session, "AUTOPILOT_VERSION")
    capabilities = fields["capabilities"]
    finding = f"version {version_name(fields['flight_sw_version'])}, capabilities {capabilities:#x}"
    missing = [name for bit, name in NEEDED_CAPABILITIES.items() if not capabilities & bit]
    require(not missing, f"{finding}: without {', '.join(missing)}")
    return finding


def fresh_streams(session: Session, expected_hz: Mapping[str, float]) -> str:
    """Count what comes unasked."""
    counts, elapsed_s = _count(session, FRESH_S)
    rates = {name: number / elapsed_s for name, number in counts.most_common()}
    heard = ", ".join(f"{name} {rate:.3g}" for name, rate in rates.items())
    session.transcript.say("note", f"unasked [Hz]: {heard or 'nothing'}")
    total = f"{sum(rates.values()):.0f} messages a second unasked"
    if session.url.startswith("serial"):
        raise NotApplicableError(f"{total}; what a serial link carries is a setting of its port")
    off = _off(counts, elapsed_s, expected_hz)
    require(not off, f"{total}: {'; '.join(off)}")
    return f"{total}, as stored"


def ask_streams(session: Session) -> str:
    """Ask for the rates that the rest is measured at."""
    for name, (number, rate_hz) in ASKED_HZ.items():
        result = session.command(
            SET_MESSAGE_INTERVAL, number, round(US_PER_S / rate_hz), note=f"{name} {rate_hz:g} Hz"
        )
        require(result == 0, f"{name} at {rate_hz:g} Hz: {result_name(result)}")
    return ", ".join(f"{name} {rate:g} Hz" for name, (_, rate) in ASKED_HZ.items()) + " accepted"


def asked_streams(session: Session) -> str:
    """Count what was asked for, by the vehicle's clock."""
    counts, elapsed_s = _count(session, RATE_S)
    off = _off(counts, elapsed_s, {name: rate for name, (_, rate) in ASKED_HZ.items()})
    found = ", ".join(f"{name} {counts[name] / elapsed_s:.3g}" for name in ASKED_HZ)
    require(not off, "; ".join(off))
    return f"{found} Hz"


def ready(session: Session) -> str:
    """Wait until it says that it may be armed, and knows where it is."""
    stopwatch, good_us = WallClock(session.speed), None
    while True:
        now_us = stopwatch.time_us()
        status = session.inbox.latest("SYS_STATUS")
        good = (
            status is not None
            and bool(status["onboard_control_sensors_health"] & PREARM_CHECK)
            and session.inbox.latest("LOCAL_POSITION_NED") is not None
        )
        if not good:
            good_us = None
        elif good_us is None:
            good_us = now_us
        elif now_us - good_us > READY_SETTLE_S * US_PER_S:
            return f"after {good_us / US_PER_S:.1f} s"
        if now_us > READY_S * US_PER_S:
            said = session.inbox.texts[-1].text if session.inbox.texts else "nothing"
            raise FailedError(f"not ready to arm after {READY_S:g} s; it said last: {said}")
        session.pause()


def clock(session: Session) -> str:
    """Find out how it tells the time at which something was sent to it."""
    method = session.vehicle_clock.choose()
    if method is Method.TELEMETRY:
        raise NotApplicableError("neither TIMESYNC nor SYSTEM_TIME is answered: times are coarse")
    return f"told by {method.value}"


def unknown_command(session: Session) -> str:
    """Send a command that nobody knows."""
    result = session.command(UNKNOWN_COMMAND)
    require(result == UNSUPPORTED, f"{result_name(result)}, not UNSUPPORTED")
    return "UNSUPPORTED"


def unknown_mode(session: Session) -> str:
    """Ask for a mode that nobody knows."""
    mode = session.mode
    expected, since = session.family.unknown_mode, len(session.inbox.texts)
    result = session.command(DO_SET_MODE, CUSTOM_MODE_FLAG, UNKNOWN_MAIN_MODE)
    session.let(TEXT_S)
    finding = expect(session, result, expected, since)
    require(session.mode == mode, f"{finding}, and the mode changed")
    return f"{finding}, no change of mode"


def offboard_without_setpoint(session: Session) -> str:
    """Ask for flight by setpoints on the ground, without any; then try to arm, and go back."""
    local = session.call("offboard.start()", session.offboard.start)
    require(local == "NO_SETPOINT_SET", f"MAVSDK: {local or 'SUCCESS'}, not NO_SETPOINT_SET")
    family, since = session.family, len(session.inbox.texts)
    result = session.set_mode(family.offboard, "no setpoint")
    finding = f"MAVSDK: {local}; DO_SET_MODE: " + expect(
        session, result, family.offboard_on_ground, since
    )
    if family.arms_without_setpoint:
        return finding
    refused = session.call("action.arm()", session.action.arm)
    session.set_mode(family.hold, "back")
    session.wait(lambda: session.mode in family.hold_modes, 3.0)
    require(refused == "COMMAND_DENIED", f"{finding}; arming then: {refused or 'SUCCESS'}")
    return f"{finding}; arming then: {refused}"


def arm(session: Session) -> str:
    """Arm, again while it refuses, for a while."""
    stopwatch = WallClock(session.speed)
    tries = 1
    session.arming = True
    while reason := session.call("action.arm()", session.action.arm):
        if stopwatch.time_us() > 20.0 * US_PER_S:
            raise FailedError(f"{reason}, {tries} times")
        tries += 1
        session.let(1.0)
    require(session.wait(lambda: session.armed, 3.0), "accepted, but the heartbeat says disarmed")
    return "ACCEPTED, armed" + (f" at attempt {tries}" if tries > 1 else "")


def expect(session: Session, result: int, expected: Answer, since: int) -> str:
    """Return an answer in words. Raises FailedError unless it is the expected one.

    Args:
        session: The link.
        result: MAV_RESULT that came.
        expected: What should have come.
        since: How many texts there were before it was asked.
    """
    name = result_name(result)
    require(result == expected.result, f"{name}, not {result_name(expected.result)}")
    if not expected.text:
        return name
    said = session.wait(lambda: session.inbox.said(expected.text, since), TEXT_S)
    require(bool(said), f'{name} without "{expected.text}"')
    return f'{name}, "{said.text}"'


def _hear(session: Session, name: str) -> Fields:
    """Return a message that surely comes. Raises FailedError when it does not."""
    stopwatch = WallClock()
    while (fields := session.inbox.latest(name)) is None:
        require(stopwatch.time_us() < FIRST_WORDS_S * US_PER_S, f"no {name}")
        session.pause()
    return fields


def _count(session: Session, seconds: float) -> tuple[Counter[str], float]:
    """Count messages for so long; return their numbers and the time that it was [s].

    By the vehicle's clock, or by the one of this side where that is not told.
    """
    stopwatch, start_s = WallClock(session.speed), session.vehicle_clock.now()
    counts: Counter[str] = Counter()
    session.inbox.counts = counts
    with session.counting():
        stopwatch.sleep_until(int(seconds * US_PER_S))
        elapsed_s = session.vehicle_clock.now() - start_s or stopwatch.time_us() / US_PER_S
    session.inbox.counts = None
    return counts, elapsed_s


def _off(counts: Counter[str], elapsed_s: float, expected_hz: Mapping[str, float]) -> list[str]:
    """Return which streams do not come as often as expected, in words."""
    found = []
    for name, rate_hz in expected_hz.items():
        expected = rate_hz * elapsed_s
        if abs(counts[name] - expected) > max(RATE_SHARE * expected, RATE_MESSAGES):
            found.append(f"{name} {counts[name] / elapsed_s:.3g} Hz, not {rate_hz:g}")
    return found

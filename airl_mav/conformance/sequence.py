"""The checks in their order. Whatever fails, the vehicle is brought down."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field

from airl_mav.conformance import air, ground
from airl_mav.conformance.checks import Checklist
from airl_mav.conformance.frames import check_frames
from airl_mav.conformance.loss import check_loss
from airl_mav.conformance.reference import Reference, load_reference
from airl_mav.conformance.session import Session
from airl_mav.conformance.stepping import FlownStep, fly_steps, judge_steps
from airl_mav.conformance.steps import STEP_NAMES, StepName
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from companion.interfaces import LinkError

RESCUE_S = 300.0
"""Longest landing after something went wrong [s]."""

HEARTBEAT_S = 1.5
"""A heartbeat comes within [s]."""

RESCUE_RETRY_S = 2.0
"""From one request to land to the next, while it is not answered [s]."""


@dataclass(frozen=True)
class Examination:
    """What is to be examined."""

    reference: str
    altitude_m: float
    steps: tuple[StepName, ...] = STEP_NAMES
    """Steps to fly; none: ()."""
    repeat: int = 1
    behaviour: bool = True
    """Whether refusals, frames, loss and hold are checked, and not the steps alone."""


@dataclass
class Findings:
    """What came out so far."""

    checklist: Checklist
    reference: Reference | None = None
    flown: dict[StepName, FlownStep] = field(default_factory=dict)
    interrupted: bool = False
    """Whether Ctrl-C ended it."""
    down: bool = True
    """Whether it is known to be disarmed at the end."""


def examine(session: Session, asked: Examination, findings: Findings) -> None:
    """Make all checks, as far as one leads to the next.

    Args:
        session: A connection on which the vehicle is heard.
        asked: What to examine.
        findings: Where everything goes; complete as far as it came, also when this raises.

    Raises:
        UsageError: Its autopilot or the stored column is not known: nothing has been commanded.
    """
    checklist = findings.checklist
    perform = checklist.perform
    try:
        if not perform("heartbeat", lambda: ground.heartbeat(session)):
            return
        beat = session.inbox.latest("HEARTBEAT") or {}
        reference = load_reference(asked.reference, beat["autopilot"])
        findings.reference = reference
        try:
            if _on_ground(session, asked, reference, checklist):
                _in_air(session, asked, findings)
        finally:
            _bring_down(session, findings)
    except LinkError:
        pass  # Noted with the check that met it.
    except KeyboardInterrupt:
        findings.interrupted = True
    if findings.flown and findings.reference is not None:
        judge_steps(checklist, asked.steps, findings.flown, findings.reference)


def _on_ground(
    session: Session, asked: Examination, reference: Reference, checklist: Checklist
) -> bool:
    """Make the checks on the ground; return whether it may fly."""
    perform, expected_hz = checklist.perform, reference.streams_hz
    perform("version", lambda: ground.version(session))
    perform("clock", lambda: ground.clock(session))
    if asked.behaviour:
        perform("streams unasked", lambda: ground.fresh_streams(session, expected_hz))
    if not perform("streams asked for", lambda: ground.ask_streams(session)):
        return False
    if not perform("ready to arm", lambda: ground.ready(session)):
        return False
    perform("stream rates", lambda: ground.asked_streams(session))
    if asked.behaviour:
        perform("unknown command", lambda: ground.unknown_command(session))
        perform("unknown mode", lambda: ground.unknown_mode(session))
        perform(
            "offboard without setpoint, on the ground",
            lambda: ground.offboard_without_setpoint(session),
        )
    return perform("arm", lambda: ground.arm(session))


def _in_air(session: Session, asked: Examination, findings: Findings) -> None:
    """Make the checks in the air; the vehicle is armed."""
    checklist = findings.checklist
    perform = checklist.perform
    perform("takeoff", lambda: air.takeoff(session, asked.altitude_m))
    if air.height(session) < asked.altitude_m / 2.0:
        return
    if asked.behaviour:
        perform(
            "offboard without setpoint, in the air",
            lambda: air.offboard_without_setpoint(session),
        )
        perform("disarming in the air", lambda: air.disarm_refused(session))
        perform("offboard NED", lambda: air.offboard_ned(session))
        perform("offboard body", lambda: air.offboard_body(session))
        session.call("offboard.stop()", session.offboard.stop)
        check_frames(session, checklist)
    if asked.steps:
        perform(
            "step responses",
            lambda: fly_steps(session, asked.steps, asked.repeat, findings.flown),
        )
        session.call("offboard.stop()", session.offboard.stop)
    if asked.behaviour:
        check_loss(session, checklist)
        perform("hold", lambda: air.hold(session))
    if perform("land", lambda: air.land(session)):
        perform("auto-disarm", lambda: air.auto_disarm(session))


def _bring_down(session: Session, findings: Findings) -> None:
    """Land when it is still armed, and ask again until it answers. Ctrl-C gives it up."""
    if not session.arming:
        return
    with suppress(LinkError):
        # The heartbeat, once a second, may not have told it yet.
        session.wait(lambda: session.armed, HEARTBEAT_S)
    if not session.armed and session.inbox.silence_s < HEARTBEAT_S:
        return
    session.transcript.say("note", "still armed: landing")
    findings.down = False
    stopwatch = WallClock(session.speed)
    asked = False
    try:
        while stopwatch.time_us() < RESCUE_S * US_PER_S:
            try:
                if not asked:
                    asked = not session.call("action.land()", session.action.land)
                if session.wait(lambda: not session.armed, RESCUE_RETRY_S):
                    findings.down = True
                    session.transcript.say("note", "landed and disarmed")
                    return
            except LinkError as error:
                # It may be heard again.
                session.transcript.say("note", f"{error}: trying to land")
                asked = False
                stopwatch_us = stopwatch.time_us() + int(RESCUE_RETRY_S * US_PER_S)
                stopwatch.sleep_until(stopwatch_us)
    finally:
        if not findings.down:
            session.transcript.say("note", "NOT known to be down: take over")

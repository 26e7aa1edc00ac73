"""What happens when setpoints stop while heartbeats go on, and when they come again."""

from __future__ import annotations

import numpy as np

from airl_mav.conformance.air import FLY_S, MODE_S, STANDING_M_S, STOP_S
from airl_mav.conformance.checks import Checklist, FailedError, require
from airl_mav.conformance.frames import begin_raw
from airl_mav.conformance.raw import RawSetpoint, raw_stream
from airl_mav.conformance.session import Session

CRUISE_M_S = 1.0
BRAKING = 0.9
"""Share of the speed below which it has begun to brake."""

DESCENT_M_S = (0.3, 1.2)
"""It comes down so fast where it comes down; PX4: MPC_LAND_SPEED, 0.7 m/s [m/s]."""

GRAIN_S = 0.02
"""A STATUSTEXT has no time: it is that of the telemetry before it, two messages at most [s]."""

LONGER_S = 2.0
"""A reaction is waited for so much longer than it may take [s]."""

NORTH = RawSetpoint(vx=CRUISE_M_S)


def check_loss(session: Session, checklist: Checklist) -> None:
    """Stop the setpoints in flight, then send some again."""
    if checklist.perform("offboard loss", lambda: lose(session)):
        checklist.perform("setpoints resume", lambda: resume(session))
    else:
        checklist.skip("setpoints resume", "not reached")


def lose(session: Session) -> str:
    """Fly north, and send no setpoint any more."""
    with raw_stream(session, NORTH) as stream:
        session.let(FLY_S / 4)
        begin_raw(session)
        session.let(2.0 * FLY_S)
        cruise = float(session.inbox.recent(1.0).motion[:, 4].mean())
        require(abs(cruise - CRUISE_M_S) < 0.25, f"{cruise:.2f} m/s before it, not {CRUISE_M_S:g}")
        stream.stop()
        newest_s, since = session.inbox.boot_s, len(session.inbox.texts)
        fix = session.vehicle_clock.fix()
        last_s, _ = session.vehicle_clock.sending(fix, newest_s, session.speed)
        stream.fly(NORTH)
    session.transcript.say("sent", "the last setpoint")
    loss = session.family.loss
    latest_s = loss.starts_s[1] + LONGER_S
    if loss.text:
        said = session.wait(lambda: session.inbox.said(loss.text, since), latest_s)
        if not said:
            raise FailedError(f'no "{loss.text}" in {latest_s:g} s')
        reacted_s, how = said.boot_s - last_s, f'"{said.text}"'
    else:
        session.let(latest_s)
        motion = session.inbox.recent(latest_s + 1.0).motion
        motion = motion[motion[:, 0] >= last_s]
        slow = np.flatnonzero(motion[:, 4] < BRAKING * cruise)
        if not slow.size:
            raise FailedError(f"flies on at {motion[-1, 4]:.2f} m/s after {latest_s:g} s")
        reacted_s, how = float(motion[slow[0], 0]) - last_s, "brakes"
    finding = f"{how} {reacted_s:.2f} s after the last setpoint"
    named = session.wait(lambda: session.mode == loss.mode, MODE_S)
    finding += f", {session.inbox.mode_name(session.mode)}"
    finding += f", {_after(session, cruise)}"
    earliest_s, latest_s = loss.starts_s
    require(
        bool(named) and earliest_s - GRAIN_S <= reacted_s <= latest_s + GRAIN_S,
        f"{finding}; expected: {earliest_s:g} to {latest_s:g} s, "
        f"{session.inbox.mode_name(loss.mode)}",
    )
    return finding


def resume(session: Session) -> str:
    """Send setpoints again: flight by setpoints goes on, without asking for the mode."""
    mode = session.family.offboard_mode
    with raw_stream(session, NORTH):
        session.transcript.say("sent", "setpoints again")
        named = session.wait(lambda: session.mode == mode, MODE_S)
        session.let(FLY_S)
        north = float(session.inbox.recent(0.5).motion[:, 4].mean())
    finding = f"{session.inbox.mode_name(session.mode)}, {north:.2f} m/s"
    require(bool(named) and abs(north - CRUISE_M_S) < 0.25, finding)
    return finding


def _after(session: Session, cruise: float) -> str:
    """Wait for what becomes of the motion, and return it in words. Raises FailedError."""
    if not session.family.loss.descends:
        require(
            bool(session.wait(lambda: _level(session) < STANDING_M_S, STOP_S)),
            f"still moves at {_level(session):.2f} m/s",
        )
        return "stands"
    session.let(FLY_S)
    down = float(session.inbox.recent(1.0).motion[:, 6].mean())
    finding = f"{_level(session):.2f} m/s level and {down:.2f} m/s down after {FLY_S:g} s"
    slowest, fastest = DESCENT_M_S
    require(slowest < down < fastest and _level(session) < BRAKING * cruise, finding)
    return finding


def _level(session: Session) -> float:
    """Horizontal speed [m/s]."""
    fields = session.inbox.latest("LOCAL_POSITION_NED") or {}
    return float(np.hypot(fields.get("vx") or 0.0, fields.get("vy") or 0.0))

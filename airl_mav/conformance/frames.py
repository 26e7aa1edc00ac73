"""Which coordinate frames and type masks it flies, refuses or ignores."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from airl_mav.conformance.air import FACING_EAST_DEG, FLY_S, MODE_S, STANDING_M_S
from airl_mav.conformance.checks import Checklist, require
from airl_mav.conformance.family import Reaction
from airl_mav.conformance.raw import (
    IGNORE_ALL,
    VELOCITY,
    VELOCITY_FORCE_BIT,
    RawSetpoint,
    RawStream,
    raw_stream,
)
from airl_mav.conformance.session import Session
from airl_mav.conformance.words import FRAMES, LOCAL_NED, LOCAL_OFFSET_NED

ASKED_S = 0.8
"""A setpoint that may be refused is sent for so long: less than PX4's offboard-loss time [s]."""

SEEN_S = 1.8
"""From its beginning its effect is looked for so long [s]."""

BACK_S = 2.0
"""Then it stands still for so long [s]."""

MOVED_M_S = 0.25
"""A setpoint of 1 m/s is flown when the velocity changes by so much [m/s]."""

STILL_EAST = RawSetpoint(yaw_rad=math.radians(FACING_EAST_DEG))


class Probe(NamedTuple):
    """A setpoint of 1 m/s, and what is to become of it."""

    name: str
    setpoint: RawSetpoint
    axis: int
    """0: north is asked for, 1: east."""
    expected: Reaction


def check_frames(session: Session, checklist: Checklist) -> None:
    """Try frames and masks, facing east, so that forward is not north."""
    with raw_stream(session, STILL_EAST) as stream:
        if not checklist.perform("raw setpoints", lambda: _begin(session)):
            return
        for probe in _probes(session):
            checklist.perform(probe.name, _trial(session, stream, probe))
        checklist.perform("NaN velocity", lambda: _nan(session, stream))


def begin_raw(session: Session) -> None:
    """Enter flight by setpoints, which a stream is sending already. Raises FailedError."""
    result = session.set_mode(session.family.offboard, "raw setpoints")
    mode = session.family.offboard_mode
    require(result == 0, "refused")
    require(bool(session.wait(lambda: session.mode == mode, MODE_S)), "no change of mode")


def _begin(session: Session) -> str:
    session.let(FLY_S / 4)
    begin_raw(session)
    session.let(FLY_S)
    return f"{session.inbox.mode_name(session.mode)} with SET_POSITION_TARGET_LOCAL_NED"


def _probes(session: Session) -> list[Probe]:
    family = session.family
    probes = [
        Probe(
            f"frame {number} {name}",
            RawSetpoint(number, VELOCITY, vx=1.0),
            0 if number in (LOCAL_NED, LOCAL_OFFSET_NED) else 1,
            family.frames[number],
        )
        for number, name in FRAMES.items()
    ]
    masks = ((VELOCITY_FORCE_BIT, Reaction.FLOWN), (IGNORE_ALL, family.ignore_all))
    return probes + [
        Probe(f"mask {mask:#x}", RawSetpoint(LOCAL_NED, mask, vx=1.0), 0, expected)
        for mask, expected in masks
    ]


def _trial(session: Session, stream: RawStream, probe: Probe) -> Callable[[], str]:
    def check() -> str:
        start_s, since = session.inbox.boot_s, len(session.inbox.texts)
        setpoint = probe.setpoint
        session.transcript.say(
            "sent",
            f"SET_POSITION_TARGET_LOCAL_NED frame {setpoint.frame} mask {setpoint.mask:#x} "
            f"vx 1 for {ASKED_S:g} s",
        )
        stream.fly(setpoint)
        session.let(ASKED_S)
        stream.fly(STILL_EAST)
        session.let(SEEN_S - ASKED_S)
        track = session.inbox.recent(SEEN_S + 1.0).between(start_s, session.inbox.boot_s)
        change = track.motion[:, 4:6] - track.motion[0, 4:6]
        moved = change[:, probe.axis].max()
        across = np.abs(change[:, 1 - probe.axis]).max()
        said = session.inbox.said("SET_POSITION_TARGET_LOCAL_NED", since)
        session.let(BACK_S)
        way = ("north", "east")[probe.axis]
        if moved > MOVED_M_S > across:
            reaction, finding = Reaction.FLOWN, f"flown, {moved:.2f} m/s {way}"
        elif said is not None:
            reaction, finding = Reaction.REFUSED, f'refused, "{said.text}"'
        else:
            reaction, finding = Reaction.IGNORED, f"ignored, {moved:.2f} m/s {way}"
        require(
            (reaction is Reaction.FLOWN) == (moved > MOVED_M_S),
            f"{finding}: {moved:.2f} m/s {way}, {across:.2f} m/s across",
        )
        require(reaction is probe.expected, f"{finding}; expected: {probe.expected.value}")
        return finding

    return check


def _nan(session: Session, stream: RawStream) -> str:
    """A velocity of NaN: neither flown nor taken for a lost signal.

    Judged by the way of the last second: ArduCopter starts its mode anew with each such setpoint,
    and swings about its place with up to 0.6 m/s.
    """
    stream.fly(RawSetpoint(LOCAL_NED, VELOCITY, vx=None))
    session.transcript.say("sent", "SET_POSITION_TARGET_LOCAL_NED vx NaN for 2 s")
    session.let(BACK_S)
    mode, motion = session.mode, session.inbox.recent(BACK_S / 2).motion
    require(len(motion) > 1, "no LOCAL_POSITION_NED")
    north, east, down = (motion[-1, 1:4] - motion[0, 1:4]) / (motion[-1, 0] - motion[0, 0])
    stream.fly(STILL_EAST)
    session.let(BACK_S / 2)
    finding = f"{session.inbox.mode_name(mode)}, ({north:.2f}, {east:.2f}, {down:.2f}) m/s"
    still = math.hypot(north, east, down) < STANDING_M_S
    require(mode == session.family.offboard_mode and still, finding)
    return finding

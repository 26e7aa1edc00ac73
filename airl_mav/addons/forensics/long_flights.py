"""Causes of timeouts and long flights: swings, circles, missed goals, detours."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena import geometry, placement
from airl_mav.core import constants, frames
from airl_mav.flight.episode_record import EpisodeRecord, path_excess
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.report.policy_view import PolicyCamera
from airl_mav.report.run_report import Cause

MIN_TURNS = 6
"""Minimum number of sign changes of a limit cycle; fewer are an evasive manoeuvre."""

MAX_APART = 4
"""Maximum number of decisions between sign changes of one limit cycle."""

STILL_COMMAND = 0.02
"""Dead band of a command's sign [m/s, rad/s]."""

SPOT_M = 2.0
"""Maximum distance from the end position in a limit cycle on the spot [m]."""

_SIDES = {"yaw": 3, "side": 1}
"""Setpoint column by kind of limit cycle."""


@dataclass(frozen=True)
class LimitCycle:
    """Sequence of decisions with repeated sign changes of a command."""

    kind: str
    """Alternating command: `yaw` for the yaw rate, `side` for the sideways speed."""
    turns: int
    start_us: int
    end_us: int
    on_the_spot: bool
    """True if the vehicle stayed within `SPOT_M` of its end position."""

    @property
    def time_s(self) -> float:
        """Duration [s]."""
        return (self.end_us - self.start_us) / constants.US_PER_S


def swinging_stretches(command: NDArray[np.floating[Any]]) -> list[NDArray[np.int64]]:
    """Return the limit cycles of a command (n,) as arrays of decisions with a sign change."""
    sided = np.flatnonzero(np.abs(command) > STILL_COMMAND)
    turns = sided[1:][np.sign(command[sided[1:]]) != np.sign(command[sided[:-1]])]
    runs = np.split(turns, np.flatnonzero(np.diff(turns) > MAX_APART) + 1)
    return [run for run in runs if len(run) >= MIN_TURNS]


def longest_limit_cycle(
    stamps: Mapping[str, NDArray[Any]], path: Trajectory, ended_us: int
) -> LimitCycle | None:
    """Return the longest limit cycle, preferably on the spot; None without any."""
    if "setpoint" not in stamps or "sent_us" not in stamps or not len(path):
        return None
    sent = stamps["sent_us"]
    flown = (sent != NO_STAMP) & (sent <= ended_us)
    times, setpoints = sent[flown], stamps["setpoint"][flown]
    swings = []
    for kind, column in _SIDES.items():
        for turns in swinging_stretches(setpoints[:, column]):
            # The last command holds until the next command or the end.
            end = int(turns[-1]) + 1
            end_us = int(times[end]) if end < len(times) else ended_us
            swings += _swings(kind, times[turns], end_us, path)
    return max(swings, key=lambda swing: (swing.on_the_spot, swing.time_s), default=None)


def _swings(
    kind: str, turns_us: NDArray[np.int64], end_us: int, path: Trajectory
) -> list[LimitCycle]:
    """Return the complete limit cycle and, if any, its part on the spot."""
    start_us = int(turns_us[0])
    swings = [LimitCycle(kind, len(turns_us), start_us, end_us, on_the_spot=False)]
    part = path.between(start_us, end_us)
    if len(part):
        away = np.linalg.norm(part.position - part.position[-1], axis=1) > SPOT_M
        stays_us = int(part.time_us[np.flatnonzero(away)[-1]]) if away.any() else start_us
        still = turns_us[turns_us >= stays_us]
        if len(still) >= MIN_TURNS:
            swings.append(LimitCycle(kind, len(still), int(still[0]), end_us, on_the_spot=True))
    return swings


CIRCLES = 3.0
"""Minimum number of full turns in one direction for the cause "circled"."""

NEAR_MISS = 2.0
"""Maximum distance of a missed goal, in goal radii."""

MISS_M = 1.0
"""Minimum increase of the goal distance after a missed goal [m]."""

DETOUR_EXCESS = 0.25
"""Minimum excess over the straight line for a detour, as a fraction."""


def cause_of_long_flight(flight: Evidence) -> Cause:
    """Return the cause of a long flight or of a missed goal."""
    record, path = flight.record, flight.path
    start_us = record.zero_us
    part = path.between(start_us, record.ended_us)
    if len(part) < 2:
        return Cause(NO_CAUSE, ())
    swing = longest_limit_cycle(flight.stamps, part, record.ended_us)
    failed = record.outcome is not Outcome.SUCCESS
    findings = [
        _swinging(swing, start_us),
        _circling(part),
        _passed_goal(record, part, start_us),
        None if failed else _detour(flight),
    ]
    found = [finding for finding in findings if finding is not None]
    sentences = [sentence for cause in found for sentence in cause.sentences]
    if failed:
        sentences.insert(0, _approach(record, part, start_us))
    return Cause(found[0].kind if found else NO_CAUSE, tuple(sentences))


def _goal_distance(record: EpisodeRecord, part: Trajectory) -> NDArray[np.float64]:
    return np.array([frames.goal_distance_m(record.goal, here) for here in part.position])


def _approach(record: EpisodeRecord, part: Trajectory, start_us: int) -> str:
    away = _goal_distance(record, part)
    best = int(away.argmin())
    after = (part.time_us[best] - start_us) / constants.US_PER_S
    return (
        f"Closest to the goal after {after:.1f} s: {away[best]:.1f} m (radius "
        f"{record.goal_radius_m:g} m, {away[0]:.1f} m at the start); {away[-1]:.1f} m at the end."
    )


def _swinging(swing: LimitCycle | None, start_us: int) -> Cause | None:
    if swing is None or not swing.on_the_spot:
        return None
    side = "turned left and right" if swing.kind == "yaw" else "moved left and right"
    begin = (swing.start_us - start_us) / constants.US_PER_S
    sentence = (
        f"From {begin:.1f} s on the commands {side} {swing.turns} times in {swing.time_s:.1f} s "
        f"({swing.time_s / swing.turns:.1f} s to a side), and the vehicle stayed within "
        f"{SPOT_M:g} m."
    )
    return Cause("swung left and right on the spot", (sentence,))


def _circling(part: Trajectory) -> Cause | None:
    heading = np.unwrap(frames.quats_to_euler(part.quaternion)[2])
    turns = float(heading[-1] - heading[0]) / (2.0 * math.pi)
    if abs(turns) < CIRCLES:
        return None
    way = "right" if turns > 0.0 else "left"
    return Cause("circled", (f"It turned {abs(turns):.1f} times round to the {way}.",))


def _passed_goal(record: EpisodeRecord, part: Trajectory, start_us: int) -> Cause | None:
    away = _goal_distance(record, part)
    # Maximum distance still to come: a pass is a minimum with a clear increase after it.
    later = np.maximum.accumulate(away[::-1])[::-1]
    near = (away < NEAR_MISS * record.goal_radius_m) & (later > away + MISS_M)
    if not near.any():
        return None
    first = int(np.flatnonzero(near)[0])
    nearest = np.minimum.accumulate(away[first:])
    left = int(np.argmax(away[first:] > nearest + MISS_M))
    best = first + int(away[first : first + left].argmin())
    after = (part.time_us[best] - start_us) / constants.US_PER_S
    return Cause(
        "passed the goal",
        (f"After {after:.1f} s it passed the goal at {away[best]:.1f} m and left again.",),
    )


def _detour(flight: Evidence) -> Cause | None:
    excess = path_excess(flight.record)
    if flight.arena is None or excess is None or excess < DETOUR_EXCESS:
        return None
    boxes = placement.bounding_boxes(flight.arena.obstacles).grown(HALF_WIDTH_M)
    free = bool(placement.segments_clear(np.zeros(2), np.array([flight.record.goal[:2]]), boxes)[0])
    way = f"{1.0 + excess:.2f} times the straight way"
    if free:
        return Cause("a detour without need", (f"{way}, on which nothing stood at the start.",))
    return Cause("a detour round obstacles", (f"{way}, which obstacles barred.",))


HALF_WIDTH_M = 0.3
"""Half-width of a vehicle [m]."""

NO_CAUSE = "no cause found in the data"


@dataclass(frozen=True)
class Evidence:
    """Available data of one flight."""

    record: EpisodeRecord
    path: Trajectory
    """Path up to the verdict; empty if not recorded."""
    stamps: Mapping[str, NDArray[Any]]
    """Decisions by column; empty without decisions."""
    arena: geometry.Arena | None = None
    camera: PolicyCamera | None = None
    braking_m: Callable[[float], float] | None = None
    """Function of the vehicle's stopping distance [m] from a speed [m/s]."""

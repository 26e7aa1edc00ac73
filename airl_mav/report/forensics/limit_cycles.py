"""Limit cycles of a policy: setpoints that swing left and right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stamps import NO_STAMP

MIN_TURNS = 6
"""Changes of side in a stretch of swinging: fewer are an evasion."""

MAX_APART = 4
"""Greatest number of decisions between two changes of side of one stretch."""

STILL_COMMAND = 0.02
"""A command smaller than this [m/s, rad/s] has no side."""

SPOT_M = 2.0
"""A limit cycle is on the spot while the vehicle stays this close to where it ends."""

_SIDES = {"yaw": 3, "side": 1}
"""Column of the setpoint."""


@dataclass(frozen=True)
class LimitCycle:
    """A stretch of decisions whose side changes over and over."""

    kind: str
    """`yaw`: of the yaw rate; `side`: of the sideways speed."""
    turns: int
    """Changes of side."""
    start_us: int
    end_us: int
    on_the_spot: bool
    """Led nowhere: the vehicle stayed within `SPOT_M` of where it ended."""

    @property
    def time_s(self) -> float:
        """Return how long it took [s]."""
        return (self.end_us - self.start_us) / US_PER_S


def swinging_stretches(command: NDArray[np.floating[Any]]) -> list[NDArray[np.int64]]:
    """Return the stretches in which a command (n,) swings: the decisions that change its side."""
    sided = np.flatnonzero(np.abs(command) > STILL_COMMAND)
    turns = sided[1:][np.sign(command[sided[1:]]) != np.sign(command[sided[:-1]])]
    runs = np.split(turns, np.flatnonzero(np.diff(turns) > MAX_APART) + 1)
    return [run for run in runs if len(run) >= MIN_TURNS]


def longest_limit_cycle(
    stamps: Mapping[str, NDArray[Any]], path: Trajectory, ended_us: int
) -> LimitCycle | None:
    """Return the longest limit cycle on the spot, or else the longest one; None without any.

    Args:
        stamps: The decisions: `sent_us` (n,) [µs] and `setpoint` (n, 4), velocity forward, right,
            down [m/s] and yaw rate [rad/s].
        path: The flight.
        ended_us: Its end [µs].
    """
    if "setpoint" not in stamps or "sent_us" not in stamps or not len(path):
        return None
    sent = stamps["sent_us"]
    flown = (sent != NO_STAMP) & (sent <= ended_us)
    times, setpoints = sent[flown], stamps["setpoint"][flown]
    swings = []
    for kind, column in _SIDES.items():
        for turns in swinging_stretches(setpoints[:, column]):
            # The last command flies until the next one, or to the end.
            end = int(turns[-1]) + 1
            end_us = int(times[end]) if end < len(times) else ended_us
            swings += _swings(kind, times[turns], end_us, path)
    return max(swings, key=lambda swing: (swing.on_the_spot, swing.time_s), default=None)


def _swings(
    kind: str, turns_us: NDArray[np.int64], end_us: int, path: Trajectory
) -> list[LimitCycle]:
    """Return a stretch as a whole, and the part of it on the spot if there is one.

    Args:
        kind: As in `LimitCycle`.
        turns_us: (k,) times of the changes of side [µs].
        end_us: Its end [µs].
        path: The flight.
    """
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

"""Faults of wind, camera and uplink in the vectorized simulator.

Flights start when the policy takes over, in phase `offboard`, at time 0. A fault is the same for
all vehicles; its random part uses the seed of each episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.faults import FOREVER_US, Fault, Part, gust_share, window_us

BEGINS = {"offboard": 0}
"""Start times of phases that have begun at the start of a flight [µs]."""

BEFORE_US = -FOREVER_US
"""Start time of faults active since before the flight."""


class GymFault(NamedTuple):
    """Fault with its active times in a flight of the vectorized simulator."""

    number: int
    """Index of the fault in the episode, from 0."""
    fault: Fault
    from_us: int
    """Start [µs]; `BEFORE_US` = active since before the flight."""
    to_us: int

    def at(self, time_us: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return True where the fault is active at these times [µs]."""
        acts: NDArray[np.bool_] = (time_us >= self.from_us) & (time_us < self.to_us)
        return acts


def gym_faults(faults: Sequence[Fault], *parts: Part) -> list[GymFault]:
    """Return the faults of these parts that level gym supports, in the episode's order."""
    found = []
    for number, fault in enumerate(faults):
        if fault.part not in parts:
            continue
        from_us, to_us = window_us(fault, BEGINS) or (0, FOREVER_US)
        found.append(GymFault(number, fault, BEFORE_US if fault.phase is None else from_us, to_us))
    return found


def gusts(faults: Sequence[GymFault], first_tick: int, ticks: int) -> Vector:
    """Return the wind (ticks, 3) NED [m/s] of faults, starting with tick number `first_tick`."""
    time_us = TICK_US * np.arange(first_tick, first_tick + ticks)
    more = np.zeros((ticks, 3))
    for each in faults:
        share = each.at(time_us).astype(float)
        if each.fault.kind == "gust":
            # Only gusts have a time profile.
            whole_s = (each.to_us - each.from_us) / US_PER_S
            elapsed_s = (time_us - each.from_us) / US_PER_S
            share *= [gust_share(elapsed, whole_s) for elapsed in elapsed_s.tolist()]
        more += share[:, None] * np.array(each.fault.value)
    return more


def lasting(faults: Sequence[GymFault]) -> Vector:
    """Return the wind (3,) NED [m/s] of faults active since before the flight."""
    since = [each.fault.value for each in faults if each.from_us == BEFORE_US]
    total: Vector = np.sum(np.array(since).reshape(-1, 3), axis=0)
    return total


def later_us(faults: Sequence[GymFault], time_us: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the additional delay of messages sent at these times, for faults `delay`."""
    more = np.zeros_like(time_us)
    for each in faults:
        more += np.where(each.at(time_us), round(each.fault.amount * US_PER_S), 0)
    return more


def delays_of(faults: Sequence[GymFault]) -> NDArray[np.int64]:
    """Return faults `delay` for kernels: (k, 3) start, end and delay, all [µs]."""
    rows = [(each.from_us, each.to_us, round(each.fault.amount * US_PER_S)) for each in faults]
    return np.array(rows, np.int64).reshape(-1, 3)


@kernel
def later_in(delays: NDArray[np.int64], time_us: int) -> int:
    """Return the additional delay of a message sent at a time [µs]; `delays` as in `delays_of`."""
    more = 0
    for k in range(len(delays)):
        if delays[k, 0] <= time_us < delays[k, 1]:
            more += delays[k, 2]
    return more


def acted(faults: Sequence[Fault], ended_us: int) -> list[tuple[str, int, int]]:
    """Return the faults active in a flight until its end [µs]: text, start and end of each."""
    told = []
    for fault in faults:
        (each,) = gym_faults([fault], fault.part)
        from_us = max(each.from_us, 0)
        if from_us <= ended_us:
            told.append((str(fault), from_us, min(each.to_us, ended_us)))
    return sorted(told, key=lambda span: span[1])

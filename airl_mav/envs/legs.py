"""Flights of a few legs in one go: what happens between two of them.

A decision has three: until its setpoint arrives, until the next frame is taken, until the next
decision begins. Flown in one call each vehicle's state is loaded once, and not three times.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel
from airl_mav.envs.fleet import Fleet
from airl_mav.envs.lanes import ATTITUDE, POSITION, YAW_RATE, State


class Legs(NamedTuple):
    """A flight of n vehicles in three legs, with what happens between them."""

    ticks: NDArray[np.int64]  # (n, 3) how long each one is
    setpoint: NDArray[np.float64]  # (n, 4) velocities taken at the end of the first
    # Kept at the end of the second, or where the flight ends before it:
    seen_us: NDArray[np.int64]  # (n,) the time
    seen_position: NDArray[np.float64]  # (n, 3) NED [m]
    seen_quaternion: NDArray[np.float64]  # (n, 4) body -> NED


_LAST: Final = 2


@kernel
def next_leg(
    legs: Legs, fleet: Fleet, i: int, state: State, j: int, leg: int, over: bool
) -> tuple[int, int]:
    """End a leg of vehicle i, in lane j, or where its flight is over, all of them.

    Returns:
        The next leg that takes time, and its ticks; 0: there is none.
    """
    left = 0
    while (over or left == 0) and leg != _LAST:
        if leg == 0:
            for axis in range(4):
                fleet.setpoint[i, axis] = legs.setpoint[i, axis]
            state[YAW_RATE, j], fleet.repeat_us[i] = fleet.setpoint[i, 3], fleet.time_us[i]
        else:
            legs.seen_us[i] = fleet.time_us[i]
            for axis in range(3):
                legs.seen_position[i, axis] = state[POSITION + axis, j]
            for axis in range(4):
                legs.seen_quaternion[i, axis] = state[ATTITUDE + axis, j]
        leg += 1
        left = 0 if over else legs.ticks[i, leg]
    return leg, left

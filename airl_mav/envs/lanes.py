"""Vehicles side by side: the state of a few of them in columns, as their ticks are computed.

A compiler turns a loop over columns into vector instructions where nothing in its body branches
into a call: then `LANES` vehicles take little longer than one. Which vehicle flies in which lane
makes no difference to it, to the last bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.memory import MEMORY_SIZE
from airl_mav.core.constants import TICK_S
from airl_mav.core.kernels import kernel
from airl_mav.envs.fleet import Fleet
from airl_mav.vehicle.airframe import Airframe, airframe_of
from airl_mav.vehicle.rotation import Quat, Vec
from airl_mav.vehicle.rotor import lag

LANES = 4
"""How many vehicles fly a tick together: as many doubles as AVX2 has in a register. With eight, a
thousand vehicles fly 2 to 4 % faster and a single one takes 1.5 times as long."""

State = NDArray[np.float64]
"""(ROWS, LANES): a column is a vehicle."""

# Rows that are the vehicle's between two ticks; see `Fleet`.
POSITION, VELOCITY, ATTITUDE, RATES, ROTOR, FELT = 0, 3, 6, 10, 13, 17
WANTED, YAW_RATE = 20, 23  # the setpoint: velocity NED [m/s], yaw rate [rad/s]
ENERGY, BATTERY, DISTANCE = 24, 25, 26
ROTOR_LEFT = 27  # what remains of a rotor's speed error after a tick
# Rows that hold from one loop of a tick to the next.
WIND, MOVED = 28, 31  # NED [m/s]; the way of the tick [m]
FIRST = 32  # 1: the filters were settled in this tick
PUBLISHED, PUBLISHED_YAW_RATE, PUBLISHED_THRUST = 33, 37, 38  # what the attitude loop flies
REDUCED, HALF_TURN = 39, 43  # of the attitude loop
TORQUE, COLLECTIVE, MOTORS = 44, 47, 48  # of the rate loop
FITS = 52  # 1: no motor command is out of range
BY_RATES = 53  # 1: `WANTED` holds body rates [rad/s], and `YAW_RATE` the thrust
AIRFRAME = 54
AIRFRAME_SIZE = len(Airframe._fields)
MEMORY = AIRFRAME + AIRFRAME_SIZE
ROWS = MEMORY + MEMORY_SIZE


@kernel
def vec(state: State, row: int, j: int) -> Vec:
    """Return three rows of a column."""
    return state[row, j], state[row + 1, j], state[row + 2, j]


@kernel
def quat(state: State, row: int, j: int) -> Quat:
    """Return four rows of a column."""
    return state[row, j], state[row + 1, j], state[row + 2, j], state[row + 3, j]


@kernel
def load(fleet: Fleet, i: int, state: State, j: int) -> None:
    """Put vehicle i into lane j."""
    for axis in range(3):
        state[POSITION + axis, j] = fleet.position[i, axis]
        state[VELOCITY + axis, j] = fleet.velocity[i, axis]
        state[RATES + axis, j] = fleet.omega[i, axis]
        state[FELT + axis, j] = fleet.felt[i, axis]
        by_rates = fleet.by_rates[i]
        state[WANTED + axis, j] = (
            fleet.setpoint[i, axis] if by_rates else fleet.velocity_ned[i, axis]
        )
    for k in range(4):
        state[ATTITUDE + k, j] = fleet.quaternion[i, k]
        state[ROTOR + k, j] = fleet.rotor[i, k]
    state[YAW_RATE, j], state[BY_RATES, j] = fleet.setpoint[i, 3], fleet.by_rates[i]
    state[ENERGY, j] = fleet.energy[i]
    state[BATTERY, j] = fleet.battery[i]
    state[DISTANCE, j] = fleet.distance[i]
    state[ROTOR_LEFT, j] = lag(airframe_of(fleet.airframe[i]), TICK_S)
    for k in range(AIRFRAME_SIZE):
        state[AIRFRAME + k, j] = fleet.airframe[i, k]
    for k in range(MEMORY_SIZE):
        state[MEMORY + k, j] = fleet.memory[i, k]


@kernel
def unload(fleet: Fleet, i: int, state: State, j: int) -> None:
    """Write lane j back to vehicle i."""
    for axis in range(3):
        fleet.position[i, axis] = state[POSITION + axis, j]
        fleet.velocity[i, axis] = state[VELOCITY + axis, j]
        fleet.omega[i, axis] = state[RATES + axis, j]
        fleet.felt[i, axis] = state[FELT + axis, j]
    for k in range(4):
        fleet.quaternion[i, k] = state[ATTITUDE + k, j]
        fleet.rotor[i, k] = state[ROTOR + k, j]
    fleet.energy[i] = state[ENERGY, j]
    fleet.battery[i] = state[BATTERY, j]
    fleet.distance[i] = state[DISTANCE, j]
    for k in range(MEMORY_SIZE):
        fleet.memory[i, k] = state[MEMORY + k, j]

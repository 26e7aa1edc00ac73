"""What the cascade remembers of a vehicle between two ticks: a row of `MEMORY_SIZE` floats.

N vehicles are an (N, MEMORY_SIZE) array, and the flight controller holds a single row.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.gains import Gains
from airl_mav.control.low_pass import Biquad, settled
from airl_mav.control.mixer import PITCH, ROLL, Motors
from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec

Memory = NDArray[np.float64]

HANDOVER_TICKS = 2
"""From the tick of the position loop to that whose motor commands reflect it: attitude, rates."""

# Layout of a memory row.
VEL_INT, VEL_LP, VEL_DOT, RATE_INT, SAT = 0, 3, 6, 9, 12
GYRO, GYRO_NEWER, GYRO_OLDER, DGYRO = 15, 18, 21, 24
YAW_TORQUE, PRIMED, WAIT = 27, 28, 29
# What the position loop published: velocity and attitude setpoint, yaw rate, collective.
VELOCITY_SP, ATTITUDE_SP, YAW_RATE_SP, THRUST_SP = 30, 33, 37, 38
# What the attitude loop published: rates and, passed on, collective.
RATES_SP, THRUST_ON = 39, 42
MEMORY_SIZE = 43


def ticks_to_motors(memory: Memory) -> int:
    """Return after how many more ticks the motors reflect what is demanded in the next one."""
    return int(memory[WAIT]) + HANDOVER_TICKS if memory[PRIMED] else 0


def new_memory(n: int | None = None) -> Memory:
    """Return the memory of one vehicle (MEMORY_SIZE,), or of n (n, MEMORY_SIZE), at rest."""
    return np.zeros(MEMORY_SIZE if n is None else (n, MEMORY_SIZE))


def trim_for_hover(
    memory: Memory, command: float, gains: Gains, north: float = 0.0, east: float = 0.0
) -> None:
    """Set the integrals of the velocity to their steady values in a hover at a collective 0..1.

    `north` and `east` are the acceleration that the vehicle leans for, against the wind [m/s²].
    """
    # thrust_from_acceleration, solved for the acceleration that gives the command.
    upright = GRAVITY_M_S2 / math.hypot(GRAVITY_M_S2, north, east)
    memory[VEL_INT], memory[VEL_INT + 1] = north, east
    memory[VEL_INT + 2] = (
        (gains.hover_thrust - upright * command) * GRAVITY_M_S2 / gains.hover_thrust
    )


def trim_against_torque(memory: Memory, motors: Motors, gains: Gains) -> None:
    """Set the integrals of roll and pitch to their steady values in a hover.

    `motors` are the commands 0..1 of that hover. Equal ones need no torque.
    """
    axes = (
        (ROLL, gains.mix_roll, gains.rate_int_max_roll),
        (PITCH, gains.mix_pitch, gains.rate_int_max_pitch),
    )
    for i, (direction, mixed, most) in enumerate(axes):
        torque = math.fsum(d * m for d, m in zip(direction, motors, strict=True)) / (4.0 * mixed)
        memory[RATE_INT + i] = min(max(torque, -most), most)


@kernel
def reset_integrals(memory: Memory) -> None:
    """Reset the integrators, which wind up on the ground, and the setpoints of all loops."""
    for i in range(3):
        memory[VEL_INT + i] = 0.0
        memory[RATE_INT + i] = 0.0
        memory[SAT + i] = 0.0
    memory[PRIMED] = 0.0


@kernel
def settle_gyro_filter(memory: Memory, gyro: Biquad) -> None:
    """Bring the delay elements of the gyro's filter to the steady state of its newest output."""
    for i in range(3):
        held = settled(gyro, memory[GYRO + i])
        memory[GYRO_NEWER + i], memory[GYRO_OLDER + i] = held, held


@kernel
def three(memory: Memory, start: int) -> Vec:
    """Return three consecutive numbers of a memory row."""
    return memory[start], memory[start + 1], memory[start + 2]

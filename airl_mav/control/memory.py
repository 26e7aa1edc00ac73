"""State of the cascade between two ticks: a row of `MEMORY_SIZE` floats per vehicle.

N vehicles are an (N, MEMORY_SIZE) array, and the flight controller uses a single row. The low-pass
filters are PX4's AlphaFilter and LowPassFilter2p of its control loops.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.demand import Gains
from airl_mav.control.loops import PITCH, ROLL, Motors
from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec


class Biquad(NamedTuple):
    """Coefficients of a second-order filter in direct form II."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


LEAST_CUTOFF = 0.001
"""Minimum cut-off of a second-order filter, as a share of the sample rate, as in PX4's
LowPassFilter2p: below it, the filter's coefficients cancel to rounding noise."""


@kernel
def weight(cutoff_hz: float, dt: float) -> float:
    """Return the weight of a new sample in a first-order low-pass; cut-off 0 = no filter."""
    if cutoff_hz <= 0.0:
        return 1.0
    return dt / (dt + 1.0 / (2.0 * math.pi * cutoff_hz))


@kernel
def butterworth(cutoff_hz: float, dt: float) -> Biquad:
    """Return a second-order Butterworth low-pass; a cut-off of 0 or above Nyquist's = no filter."""
    if cutoff_hz <= 0.0 or cutoff_hz >= 0.5 / dt:
        return Biquad(1.0, 0.0, 0.0, 0.0, 0.0)
    # Bilinear transform with the cut-off prewarped.
    ohm = math.tan(math.pi * max(cutoff_hz, LEAST_CUTOFF / dt) * dt)
    damping = 2.0 * math.cos(math.pi / 4.0) * ohm
    c = 1.0 + damping + ohm * ohm
    b = ohm * ohm / c
    return Biquad(b, 2.0 * b, b, 2.0 * (ohm * ohm - 1.0) / c, (1.0 - damping + ohm * ohm) / c)


@kernel
def settled(f: Biquad, sample: float) -> float:
    """Return the value of both delay elements in the steady state of a constant `sample`."""
    return sample / (1.0 + f.a1 + f.a2)


@kernel
def filtered(f: Biquad, sample: float, newer: float, older: float) -> tuple[float, float]:
    """Return the output and the next value of the newer delay element; the older takes `newer`."""
    now = sample - f.a1 * newer - f.a2 * older
    return f.b0 * now + f.b1 * newer + f.b2 * older, now


Memory = NDArray[np.float64]

HANDOVER_TICKS = 2
"""Ticks from the position loop to the motor commands that reflect it: attitude, rates."""

# Layout of a memory row.
VEL_INT, VEL_LP, VEL_DOT, RATE_INT, SAT = 0, 3, 6, 9, 12
GYRO, GYRO_NEWER, GYRO_OLDER, DGYRO = 15, 18, 21, 24
YAW_TORQUE, PRIMED, WAIT = 27, 28, 29
# Output of the position loop: velocity and attitude setpoint, yaw rate, collective.
VELOCITY_SP, ATTITUDE_SP, YAW_RATE_SP, THRUST_SP = 30, 33, 37, 38
# Output of the attitude loop: rates and, passed on, collective.
RATES_SP, THRUST_ON = 39, 42
# Reference model of the attitude: correction rate, and 1 while it follows setpoints.
CORRECTION, FOLLOWS = 43, 46
MEMORY_SIZE = 47


def ticks_to_motors(memory: Memory) -> int:
    """Return the ticks until the motors reflect the demand of the next tick."""
    return int(memory[WAIT]) + HANDOVER_TICKS if memory[PRIMED] else 0


def new_memory(n: int | None = None) -> Memory:
    """Return the memory of one vehicle (MEMORY_SIZE,), or of n (n, MEMORY_SIZE), at rest."""
    return np.zeros(MEMORY_SIZE if n is None else (n, MEMORY_SIZE))


def trim_for_hover(
    memory: Memory, command: float, gains: Gains, north: float = 0.0, east: float = 0.0
) -> None:
    """Set the integrals of the velocity to their steady values in a hover at a collective 0..1.

    `north` and `east` are the acceleration of the lean against the wind [m/s²].
    """
    # thrust_from_acceleration, solved for the acceleration that gives the command.
    upright = GRAVITY_M_S2 / math.hypot(GRAVITY_M_S2, north, east)
    memory[VEL_INT], memory[VEL_INT + 1] = north, east
    # Down is positive, so a command above hover thrust needs a negative integral.
    memory[VEL_INT + 2] = (
        (gains.hover_thrust - upright * command) * GRAVITY_M_S2 / gains.hover_thrust
    )


def trim_against_torque(memory: Memory, motors: Motors, gains: Gains) -> None:
    """Set the integrals of roll and pitch to their steady values in a hover at commands 0..1."""
    axes = (
        (ROLL, gains.mix_roll, gains.rate_int_max_roll),
        (PITCH, gains.mix_pitch, gains.rate_int_max_pitch),
    )
    for i, (direction, mixed, most) in enumerate(axes):
        # Torque of the commands, in the units of the rate loop.
        torque = math.fsum(d * m for d, m in zip(direction, motors, strict=True)) / (4.0 * mixed)
        memory[RATE_INT + i] = min(max(torque, -most), most)


@kernel
def reset_integrals(memory: Memory) -> None:
    """Reset the integrators, which wind up on the ground, and the setpoints of all loops."""
    for i in range(3):
        memory[VEL_INT + i] = 0.0
        memory[RATE_INT + i] = 0.0
        memory[SAT + i] = 0.0
    # The next tick initialises the filters and runs all loops.
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

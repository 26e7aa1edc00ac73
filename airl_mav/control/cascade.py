"""The whole cascade, one tick: state and setpoint -> motor commands.

One vehicle's memory is a row of `MEMORY_SIZE` floats, so that N vehicles are an (N, MEMORY_SIZE)
array and the flight controller holds a single row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.constants import GRAVITY_M_S2
from airl_mav.control.attitude import attitude_towards, heading_of, rate_setpoint
from airl_mav.control.gains import Gains
from airl_mav.control.mixer import Motors, mix
from airl_mav.control.rate import rate_control
from airl_mav.control.velocity import velocity_control, velocity_setpoint
from airl_mav.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec

Memory = NDArray[np.float64]

# Layout of a memory row.
_VEL_INT, _VEL_LP, _VEL_DOT, _RATE_INT, _GYRO, _DGYRO, _SAT = 0, 3, 6, 9, 12, 15, 18
_YAW_TORQUE, _PRIMED = 21, 22
MEMORY_SIZE = 23


class Demand(NamedTuple):
    """What to fly; NaN = not commanded."""

    position: Vec
    """NED [m]."""
    velocity: Vec
    """NED [m/s]."""
    yaw: float
    """Heading [rad]; NaN with a yaw rate = the heading of the moment."""
    yaw_rate: float
    """[rad/s] about the world's down axis."""


class Output(NamedTuple):
    """What the cascade decided."""

    motors: Motors
    thrust: float
    """Collective 0..1."""
    attitude: Quat
    """Attitude setpoint."""
    rates: Vec
    """Rate setpoint FRD [rad/s]."""
    velocity: Vec
    """Velocity setpoint after limits NED [m/s]."""


def new_memory(n: int | None = None) -> Memory:
    """Return the memory of one vehicle (MEMORY_SIZE,), or of n (n, MEMORY_SIZE), at rest."""
    return np.zeros(MEMORY_SIZE if n is None else (n, MEMORY_SIZE))


def trim_for_hover(memory: Memory, command: float, gains: Gains) -> None:
    """Set the vertical integral to what it settles at in a hover.

    Args:
        memory: Of one vehicle (MEMORY_SIZE,), updated.
        command: Collective command 0..1 that the vehicle hovers at.
        gains: Holds the hover thrust that the controller counts on.
    """
    # thrust_from_acceleration, solved for the acceleration that gives the command.
    memory[_VEL_INT + 2] = (gains.hover_thrust - command) * GRAVITY_M_S2 / gains.hover_thrust


@kernel
def reset_integrals(memory: Memory) -> None:
    """Forget what the integrators learned: on the ground they wind up against the floor."""
    for i in range(3):
        memory[_VEL_INT + i] = 0.0
        memory[_RATE_INT + i] = 0.0
        memory[_SAT + i] = 0.0


@kernel
def _weight(cutoff_hz: float, dt: float) -> float:
    """Return the weight of a new sample in a first-order low-pass; cut-off 0 = no filter."""
    if cutoff_hz <= 0.0:
        return 1.0
    return 1.0 - math.exp(-2.0 * math.pi * cutoff_hz * dt)


class Filters(NamedTuple):
    """Weight of a new sample in each low-pass of the cascade, for a fixed tick."""

    velocity: float
    gyro: float
    angular_acceleration: float
    yaw_torque: float


@kernel
def filters(gains: Gains, dt: float) -> Filters:
    """Return the weights for a tick of dt [s]."""
    return Filters(
        _weight(gains.vel_d_cutoff_hz, dt),
        _weight(gains.gyro_cutoff_hz, dt),
        _weight(gains.dgyro_cutoff_hz, dt),
        _weight(gains.yaw_torque_cutoff_hz, dt),
    )


@kernel
def cascade(
    position: Vec,
    velocity: Vec,
    q: Quat,
    omega: Vec,
    demand: Demand,
    memory: Memory,
    gains: Gains,
    dt: float,
) -> Output:
    """Run one tick of the cascade; updates `memory` in place. Arguments as of `cascade_tick`."""
    return cascade_tick(position, velocity, q, omega, demand, memory, gains, filters(gains, dt), dt)


@kernel
def cascade_tick(
    position: Vec,
    velocity: Vec,
    q: Quat,
    omega: Vec,
    demand: Demand,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> Output:
    """Run one tick of the cascade with filters computed before; updates `memory` in place.

    Args:
        position: NED [m].
        velocity: NED [m/s].
        q: Attitude body -> NED.
        omega: Body rates FRD [rad/s].
        demand: What to fly.
        memory: Row of this vehicle.
        gains: Gains and limits.
        weights: `filters(gains, dt)`: the same at every tick.
        dt: Tick [s].
    """
    velocities = (velocity[0], velocity[1], velocity[2])
    rates_now = (omega[0], omega[1], omega[2])
    if memory[_PRIMED] == 0.0:
        memory[_PRIMED] = 1.0
        for i in range(3):
            memory[_VEL_LP + i] = velocities[i]
            memory[_GYRO + i] = rates_now[i]
    for i in range(3):
        before = memory[_VEL_LP + i]
        memory[_VEL_LP + i] = before + weights.velocity * (velocities[i] - before)
        memory[_VEL_DOT + i] = (memory[_VEL_LP + i] - before) / dt
        before = memory[_GYRO + i]
        memory[_GYRO + i] = before + weights.gyro * (rates_now[i] - before)
        slope = (memory[_GYRO + i] - before) / dt
        memory[_DGYRO + i] += weights.angular_acceleration * (slope - memory[_DGYRO + i])

    velocity_sp = velocity_setpoint(position, demand.position, demand.velocity, gains)
    thrust, integral = velocity_control(
        velocity,
        (memory[_VEL_DOT], memory[_VEL_DOT + 1], memory[_VEL_DOT + 2]),
        velocity_sp,
        (memory[_VEL_INT], memory[_VEL_INT + 1], memory[_VEL_INT + 2]),
        gains,
        dt,
    )
    if math.isnan(demand.yaw):
        cos_yaw, sin_yaw = heading_of(q)
    else:
        cos_yaw, sin_yaw = math.cos(demand.yaw), math.sin(demand.yaw)
    yaw_rate = 0.0 if math.isnan(demand.yaw_rate) else demand.yaw_rate
    q_sp = attitude_towards(thrust, cos_yaw, sin_yaw)
    rates_sp = rate_setpoint(q, q_sp, yaw_rate, gains)
    torque, rate_integral = rate_control(
        (memory[_GYRO], memory[_GYRO + 1], memory[_GYRO + 2]),
        (memory[_DGYRO], memory[_DGYRO + 1], memory[_DGYRO + 2]),
        rates_sp,
        (memory[_RATE_INT], memory[_RATE_INT + 1], memory[_RATE_INT + 2]),
        (memory[_SAT], memory[_SAT + 1], memory[_SAT + 2]),
        gains,
        dt,
    )
    memory[_YAW_TORQUE] += weights.yaw_torque * (torque[2] - memory[_YAW_TORQUE])
    collective = math.sqrt(thrust[0] ** 2 + thrust[1] ** 2 + thrust[2] ** 2)
    motors, missing = mix(collective, (torque[0], torque[1], memory[_YAW_TORQUE]))
    for i in range(3):
        memory[_VEL_INT + i] = integral[i]
        memory[_RATE_INT + i] = rate_integral[i]
        memory[_SAT + i] = missing[i]
    return Output(motors, collective, q_sp, rates_sp, velocity_sp)

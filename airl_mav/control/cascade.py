"""The whole cascade, one tick: state and setpoint -> motor commands.

The loops hand over to each other as PX4's do in lockstep. The position loop runs whenever its
estimator publishes a position, at every second sample of the IMU; each loop flies the setpoint
that the loop above it published at an earlier sample, as the inner ones are scheduled first. From
a new position to the motors that takes two ticks.

One vehicle's memory is a row of `MEMORY_SIZE` floats, so that N vehicles are an (N, MEMORY_SIZE)
array and the flight controller holds a single row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.attitude import attitude_setpoint, heading_of, rate_setpoint
from airl_mav.control.gains import Gains
from airl_mav.control.low_pass import Biquad, butterworth, filtered, settled, weight
from airl_mav.control.mixer import PITCH, ROLL, Motors, mix
from airl_mav.control.rate import rate_control
from airl_mav.control.velocity import velocity_control, velocity_setpoint
from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec

Memory = NDArray[np.float64]

HANDOVER_TICKS = 2
"""From the tick of the position loop to that whose motor commands reflect it: attitude, rates."""

POSITION_TICKS = 2
"""PX4's EKF (EKF2_PREDICT_US = 10 ms) publishes positions at every second 4 ms sample, measured."""

# Layout of a memory row.
_VEL_INT, _VEL_LP, _VEL_DOT, _RATE_INT, _SAT = 0, 3, 6, 9, 12
_GYRO, _GYRO_NEWER, _GYRO_OLDER, _DGYRO = 15, 18, 21, 24
_YAW_TORQUE, _PRIMED, _WAIT = 27, 28, 29
# What the position loop published: velocity and attitude setpoint, yaw rate, collective.
_VELOCITY_SP, _ATTITUDE_SP, _YAW_RATE_SP, _THRUST_SP = 30, 33, 37, 38
# What the attitude loop published: rates and, passed on, collective.
_RATES_SP, _THRUST_ON = 39, 42
MEMORY_SIZE = 43


class Demand(NamedTuple):
    """The setpoint of the cascade; NaN = not commanded."""

    position: Vec
    """NED [m]."""
    velocity: Vec
    """NED [m/s]."""
    yaw: float
    """Heading [rad]; NaN with a yaw rate = the heading of the moment."""
    yaw_rate: float
    """[rad/s] about the world's down axis."""


class Output(NamedTuple):
    """Output of the cascade."""

    motors: Motors
    thrust: float
    """Collective 0..1 in the motor commands."""
    attitude: Quat
    """Newest attitude setpoint."""
    rates: Vec
    """Newest rate setpoint FRD [rad/s]."""
    velocity: Vec
    """Newest velocity setpoint after limits NED [m/s]."""


def ticks_to_motors(memory: Memory) -> int:
    """Return after how many more ticks the motors reflect what is demanded in the next one."""
    return int(memory[_WAIT]) + HANDOVER_TICKS if memory[_PRIMED] else 0


def new_memory(n: int | None = None) -> Memory:
    """Return the memory of one vehicle (MEMORY_SIZE,), or of n (n, MEMORY_SIZE), at rest."""
    return np.zeros(MEMORY_SIZE if n is None else (n, MEMORY_SIZE))


def trim_for_hover(
    memory: Memory, command: float, gains: Gains, north: float = 0.0, east: float = 0.0
) -> None:
    """Set the integrals of the velocity to what they settle at in a hover.

    Args:
        memory: Of one vehicle (MEMORY_SIZE,), updated.
        command: Collective 0..1.
        gains: Hold the hover thrust.
        north: Acceleration that the vehicle leans for, against the wind [m/s²].
        east: The same towards east.
    """
    # thrust_from_acceleration, solved for the acceleration that gives the command.
    upright = GRAVITY_M_S2 / math.hypot(GRAVITY_M_S2, north, east)
    memory[_VEL_INT], memory[_VEL_INT + 1] = north, east
    memory[_VEL_INT + 2] = (
        (gains.hover_thrust - upright * command) * GRAVITY_M_S2 / gains.hover_thrust
    )


def trim_against_torque(memory: Memory, motors: Motors, gains: Gains) -> None:
    """Set the integrals of roll and pitch to what they settle at with these commands in a hover.

    Args:
        memory: Of one vehicle (MEMORY_SIZE,), updated.
        motors: Commands 0..1; equal ones need no torque.
        gains: Hold the limits of the integrals, and how torque becomes commands.
    """
    axes = (
        (ROLL, gains.mix_roll, gains.rate_int_max_roll),
        (PITCH, gains.mix_pitch, gains.rate_int_max_pitch),
    )
    for i, (direction, mixed, most) in enumerate(axes):
        torque = math.fsum(d * m for d, m in zip(direction, motors, strict=True)) / (4.0 * mixed)
        memory[_RATE_INT + i] = min(max(torque, -most), most)


@kernel
def reset_integrals(memory: Memory) -> None:
    """Reset the integrators, which wind up on the ground, and the setpoints of all loops."""
    for i in range(3):
        memory[_VEL_INT + i] = 0.0
        memory[_RATE_INT + i] = 0.0
        memory[_SAT + i] = 0.0
    memory[_PRIMED] = 0.0


class Filters(NamedTuple):
    """The low-passes of the cascade, for a fixed tick."""

    velocity: float
    """Weight of a new sample, as of the others below."""
    gyro: Biquad
    angular_acceleration: float
    yaw_torque: float


@kernel
def filters(gains: Gains, dt: float) -> Filters:
    """Return the filters for a tick of dt [s]."""
    return Filters(
        weight(gains.vel_d_cutoff_hz, POSITION_TICKS * dt),
        butterworth(gains.gyro_cutoff_hz, dt),
        weight(gains.dgyro_cutoff_hz, dt),
        weight(gains.yaw_torque_cutoff_hz, dt),
    )


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
    """Run one tick of the cascade; updates `memory` in place.

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
    first = memory[_PRIMED] == 0.0
    if first:
        _prime(velocity, omega, memory, weights)
    # Setpoints published by an outer loop take effect at the next tick, except at the very first.
    q_sp, yaw_rate, thrust_sp = _attitude_sp(memory)
    if memory[_WAIT] == 0.0:
        _position_loop(position, velocity, q, demand, memory, gains, weights, dt)
        memory[_WAIT] = POSITION_TICKS
        if first:
            q_sp, yaw_rate, thrust_sp = _attitude_sp(memory)
    memory[_WAIT] -= 1.0
    wanted = rate_setpoint(q, q_sp, yaw_rate, gains)
    rates_sp, collective = wanted, thrust_sp
    if not first:
        rates_sp = _three(memory, _RATES_SP)
        collective = memory[_THRUST_ON]
    memory[_THRUST_ON] = thrust_sp
    for i in range(3):
        memory[_RATES_SP + i] = wanted[i]
    motors = _rate_loop(omega, rates_sp, collective, memory, gains, weights, dt)
    newest_sp = _attitude_sp(memory)[0]
    return Output(motors, collective, newest_sp, wanted, _three(memory, _VELOCITY_SP))


@kernel
def settle_gyro_filter(memory: Memory, gyro: Biquad) -> None:
    """Bring the delay elements of the gyro's filter to the steady state of its newest output."""
    for i in range(3):
        held = settled(gyro, memory[_GYRO + i])
        memory[_GYRO_NEWER + i], memory[_GYRO_OLDER + i] = held, held


@kernel
def _prime(velocity: Vec, omega: Vec, memory: Memory, weights: Filters) -> None:
    """Start: the filters are settled at the first sample, the position loop is due."""
    memory[_PRIMED] = 1.0
    memory[_WAIT] = 0.0
    for i in range(3):
        memory[_VEL_LP + i] = velocity[i]
        memory[_GYRO + i] = omega[i]
    settle_gyro_filter(memory, weights.gyro)


@kernel
def _three(memory: Memory, start: int) -> Vec:
    return memory[start], memory[start + 1], memory[start + 2]


@kernel
def _attitude_sp(memory: Memory) -> tuple[Quat, float, float]:
    """Return attitude setpoint, yaw rate and collective as the position loop published them."""
    a = _ATTITUDE_SP
    q_sp = (memory[a], memory[a + 1], memory[a + 2], memory[a + 3])
    return q_sp, memory[_YAW_RATE_SP], memory[_THRUST_SP]


@kernel
def _position_loop(
    position: Vec,
    velocity: Vec,
    q: Quat,
    demand: Demand,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> None:
    """Publish the attitude and thrust that fly the demand."""
    period = POSITION_TICKS * dt
    velocities = (velocity[0], velocity[1], velocity[2])
    for i in range(3):
        before = memory[_VEL_LP + i]
        memory[_VEL_LP + i] = before + weights.velocity * (velocities[i] - before)
        memory[_VEL_DOT + i] = (memory[_VEL_LP + i] - before) / period
    velocity_sp = velocity_setpoint(position, demand.position, demand.velocity, gains)
    thrust, integral = velocity_control(
        velocity,
        _three(memory, _VEL_DOT),
        velocity_sp,
        _three(memory, _VEL_INT),
        gains,
        period,
    )
    if math.isnan(demand.yaw):
        cos_yaw, sin_yaw = heading_of(q)
    else:
        cos_yaw, sin_yaw = math.cos(demand.yaw), math.sin(demand.yaw)
    q_sp = attitude_setpoint(thrust, cos_yaw, sin_yaw)
    for i in range(3):
        memory[_VEL_INT + i] = integral[i]
        memory[_VELOCITY_SP + i] = velocity_sp[i]
    for i in range(4):
        memory[_ATTITUDE_SP + i] = q_sp[i]
    memory[_YAW_RATE_SP] = 0.0 if math.isnan(demand.yaw_rate) else demand.yaw_rate
    memory[_THRUST_SP] = math.sqrt(thrust[0] ** 2 + thrust[1] ** 2 + thrust[2] ** 2)


@kernel
def _rate_loop(
    omega: Vec,
    rates_sp: Vec,
    collective: float,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> Motors:
    """Return the motor commands that turn as wanted, with a collective 0..1."""
    rates_now = (omega[0], omega[1], omega[2])
    for i in range(3):
        before, newer = memory[_GYRO + i], memory[_GYRO_NEWER + i]
        rate, held = filtered(weights.gyro, rates_now[i], newer, memory[_GYRO_OLDER + i])
        memory[_GYRO + i], memory[_GYRO_NEWER + i], memory[_GYRO_OLDER + i] = rate, held, newer
        slope = (rate - before) / dt
        memory[_DGYRO + i] += weights.angular_acceleration * (slope - memory[_DGYRO + i])
    torque, integral = rate_control(
        _three(memory, _GYRO),
        _three(memory, _DGYRO),
        rates_sp,
        _three(memory, _RATE_INT),
        _three(memory, _SAT),
        gains,
        dt,
    )
    memory[_YAW_TORQUE] += weights.yaw_torque * (torque[2] - memory[_YAW_TORQUE])
    motors, missing = mix(collective, (torque[0], torque[1], memory[_YAW_TORQUE]), gains)
    for i in range(3):
        memory[_RATE_INT + i] = integral[i]
        memory[_SAT + i] = missing[i]
    return motors

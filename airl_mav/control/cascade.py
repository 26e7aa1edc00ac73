"""One tick of the cascade: state and setpoint -> motor commands.

The loops pass setpoints as PX4's do in lockstep. The position loop runs whenever its estimator
publishes a position, at every second IMU sample. Each loop uses the setpoint that the loop above
published at an earlier sample, because inner loops are scheduled first. A new position reaches the
motors after two ticks.

`demand` defines the inputs, `memory` the state between two ticks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from airl_mav.control import loops
from airl_mav.control.demand import AttitudeDemand, Demand, Gains, RateDemand, TrajectoryDemand
from airl_mav.control.memory import (
    ATTITUDE_SP,
    CORRECTION,
    DGYRO,
    FOLLOWS,
    GYRO,
    GYRO_NEWER,
    GYRO_OLDER,
    PRIMED,
    RATE_INT,
    RATES_SP,
    SAT,
    THRUST_ON,
    THRUST_SP,
    VEL_DOT,
    VEL_INT,
    VEL_LP,
    VELOCITY_SP,
    WAIT,
    YAW_RATE_SP,
    YAW_TORQUE,
    Biquad,
    Memory,
    butterworth,
    filtered,
    settle_gyro_filter,
    three,
    weight,
)
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec

POSITION_TICKS = 2
"""Ticks between positions of PX4's EKF (EKF2_PREDICT_US = 10 ms): every second 4 ms sample,
measured."""


class Output(NamedTuple):
    """Output of the cascade."""

    motors: loops.Motors
    thrust: float
    """Collective 0..1 in the motor commands."""
    attitude: Quat
    """Newest attitude setpoint."""
    rates: Vec
    """Newest rate setpoint FRD [rad/s]."""
    velocity: Vec
    """Newest velocity setpoint after limits NED [m/s]."""


Published = tuple[Quat, float, float]
"""Output of the position loop: attitude setpoint, yaw rate [rad/s], collective 0..1."""


class Filters(NamedTuple):
    """Low-pass filters of the cascade, for a fixed tick."""

    velocity: float
    """Weight of a new sample, as for the others below."""
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
    """Run one tick of dt [s] of the cascade; updates `memory`, a vehicle's row, in place.

    Position [m] and velocity [m/s] are NED, q is body -> NED, omega the body rates FRD [rad/s];
    `weights` are `filters(gains, dt)`.
    """
    first = start(velocity, omega, memory, weights)
    # Setpoints of an outer loop take effect at the next tick, except at the first.
    published = attitude_sp(memory)
    # The position loop runs at every second tick, see POSITION_TICKS.
    if memory[WAIT] == 0.0:
        position_loop(position, velocity, q, demand, memory, gains, weights, dt)
        memory[WAIT] = POSITION_TICKS
        if first:
            published = attitude_sp(memory)
    memory[WAIT] -= 1.0
    return _inner_loops(q, omega, published, first, memory, gains, weights, dt)


@kernel
def trajectory_tick(
    position: Vec,
    velocity: Vec,
    q: Quat,
    omega: Vec,
    demand: TrajectoryDemand,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> Output:
    """Run one tick as `cascade_tick` does, for a demand with an acceleration."""
    first = start(velocity, omega, memory, weights)
    published = attitude_sp(memory)
    if memory[WAIT] == 0.0:
        _trajectory_loop(position, velocity, q, demand, memory, gains, weights, dt)
        memory[WAIT] = POSITION_TICKS
        if first:
            published = attitude_sp(memory)
    memory[WAIT] -= 1.0
    return _inner_loops(q, omega, published, first, memory, gains, weights, dt)


@kernel
def attitude_tick(
    velocity: Vec,
    q: Quat,
    omega: Vec,
    demand: AttitudeDemand,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> Output:
    """Run only the attitude and the rate loop. The position loop is due at its next use.

    The velocity setpoint of the output is NaN.
    """
    first = start(velocity, omega, memory, weights)
    _skip_position_loop(velocity, memory, weights, dt)
    memory[YAW_RATE_SP], memory[THRUST_SP] = demand.yaw_rate, demand.thrust
    _follow(demand.attitude, memory, gains, dt)
    return _inner_loops(q, omega, attitude_sp(memory), first, memory, gains, weights, dt)


@kernel
def rate_tick(
    velocity: Vec,
    q: Quat,
    omega: Vec,
    demand: RateDemand,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> Output:
    """Run only the rate loop; the others are due at their next use.

    The attitude setpoint of the output is the current attitude, its velocity setpoint NaN.
    """
    start(velocity, omega, memory, weights)
    _skip_position_loop(velocity, memory, weights, dt)
    for i in range(4):
        memory[ATTITUDE_SP + i] = q[i]
    for i in range(3):
        memory[RATES_SP + i] = demand.rates[i]
    # The rate demand bypasses the attitude loop: the present attitude is the setpoint.
    memory[YAW_RATE_SP], memory[THRUST_SP] = 0.0, demand.thrust
    memory[THRUST_ON], memory[FOLLOWS] = demand.thrust, 0.0
    motors = _rate_loop(omega, demand.rates, demand.thrust, memory, gains, weights, dt)
    return Output(motors, demand.thrust, q, demand.rates, three(memory, VELOCITY_SP))


@kernel
def start(velocity: Vec, omega: Vec, memory: Memory, weights: Filters) -> bool:
    """Initialise the filters at the first tick; return True for the first tick."""
    first: bool = memory[PRIMED] == 0.0
    if first:
        _prime(velocity, omega, memory, weights)
    return first


@kernel
def _inner_loops(
    q: Quat,
    omega: Vec,
    published: Published,
    first: bool,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> Output:
    """Fly the position loop's output: attitude setpoint, yaw rate, collective."""
    q_sp, yaw_rate, thrust_sp = published
    wanted = loops.rate_setpoint(q, q_sp, yaw_rate, gains)
    rates_sp, collective = hand_over(wanted, thrust_sp, first, memory)
    motors = _rate_loop(omega, rates_sp, collective, memory, gains, weights, dt)
    newest_sp = attitude_sp(memory)[0]
    return Output(motors, collective, newest_sp, wanted, three(memory, VELOCITY_SP))


@kernel
def hand_over(wanted: Vec, thrust_sp: float, first: bool, memory: Memory) -> tuple[Vec, float]:
    """Publish rates and collective; return the rates and collective to fly in this tick."""
    # Except at the first tick, the rate loop uses the values published a tick ago.
    rates_sp, collective = wanted, thrust_sp
    if not first:
        rates_sp = three(memory, RATES_SP)
        collective = memory[THRUST_ON]
    memory[THRUST_ON] = thrust_sp
    for i in range(3):
        memory[RATES_SP + i] = wanted[i]
    return rates_sp, collective


@kernel
def _skip_position_loop(velocity: Vec, memory: Memory, weights: Filters, dt: float) -> None:
    """Update the velocity's filter while no position is flown."""
    # The derivative continues, so that the position loop can resume at any tick.
    if memory[WAIT] == 0.0:
        differentiate(velocity, memory, weights, POSITION_TICKS * dt)
        memory[WAIT] = POSITION_TICKS
    memory[WAIT] -= 1.0
    for i in range(3):
        memory[VELOCITY_SP + i] = math.nan


@kernel
def _prime(velocity: Vec, omega: Vec, memory: Memory, weights: Filters) -> None:
    """Start: the filters are settled at the first sample, the position loop is due."""
    memory[PRIMED] = 1.0
    memory[WAIT], memory[FOLLOWS] = 0.0, 0.0
    for i in range(3):
        memory[VEL_LP + i] = velocity[i]
        memory[GYRO + i] = omega[i]
    settle_gyro_filter(memory, weights.gyro)


@kernel
def attitude_sp(memory: Memory) -> Published:
    """Return attitude setpoint, yaw rate and collective as published by the position loop."""
    a = ATTITUDE_SP
    q_sp = (memory[a], memory[a + 1], memory[a + 2], memory[a + 3])
    return q_sp, memory[YAW_RATE_SP], memory[THRUST_SP]


@kernel
def position_loop(
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
    differentiate(velocity, memory, weights, period)
    velocity_sp = loops.velocity_setpoint(position, demand.position, demand.velocity, gains)
    thrust, integral = loops.velocity_control(
        velocity,
        three(memory, VEL_DOT),
        velocity_sp,
        three(memory, VEL_INT),
        gains,
        period,
    )
    _publish(velocity_sp, thrust, integral, demand.yaw, demand.yaw_rate, q, memory, gains, period)


@kernel
def _trajectory_loop(
    position: Vec,
    velocity: Vec,
    q: Quat,
    demand: TrajectoryDemand,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> None:
    """Run the position loop, as `position_loop`, with an acceleration."""
    period = POSITION_TICKS * dt
    differentiate(velocity, memory, weights, period)
    north, east, down = loops.velocity_setpoint(position, demand.position, demand.velocity, gains)
    # Without position and velocity the down axis is left to the acceleration.
    if math.isnan(demand.position[2]) and math.isnan(demand.velocity[2]):
        down = math.nan
    velocity_sp = (north, east, down)
    thrust, integral = loops.acceleration_control(
        velocity,
        three(memory, VEL_DOT),
        velocity_sp,
        demand.acceleration,
        three(memory, VEL_INT),
        gains,
        period,
    )
    _publish(velocity_sp, thrust, integral, demand.yaw, demand.yaw_rate, q, memory, gains, period)


@kernel
def differentiate(velocity: Vec, memory: Memory, weights: Filters, period: float) -> None:
    """Advance the filtered derivative of the velocity."""
    velocities = (velocity[0], velocity[1], velocity[2])
    for i in range(3):
        before = memory[VEL_LP + i]
        memory[VEL_LP + i] = before + weights.velocity * (velocities[i] - before)
        memory[VEL_DOT + i] = (memory[VEL_LP + i] - before) / period


@kernel
def _publish(
    velocity_sp: Vec,
    thrust: Vec,
    integral: Vec,
    yaw: float,
    yaw_rate: float,
    q: Quat,
    memory: Memory,
    gains: Gains,
    period: float,
) -> None:
    """Store the position loop's output: attitude, yaw rate and collective."""
    if math.isnan(yaw):
        # An uncommanded heading keeps the present one.
        cos_yaw, sin_yaw = loops.heading_of(q)
    else:
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    q_sp = loops.attitude_setpoint(thrust, cos_yaw, sin_yaw)
    for i in range(3):
        memory[VEL_INT + i] = integral[i]
        memory[VELOCITY_SP + i] = velocity_sp[i]
    memory[YAW_RATE_SP] = 0.0 if math.isnan(yaw_rate) else yaw_rate
    _follow(q_sp, memory, gains, period)
    # The collective is the length of the thrust vector, which is already normalised.
    memory[THRUST_SP] = math.sqrt(thrust[0] ** 2 + thrust[1] ** 2 + thrust[2] ** 2)


@kernel
def _follow(q_sp: Quat, memory: Memory, gains: Gains, period: float) -> None:
    """Store an attitude setpoint, through the reference model if the release has one."""
    q_ref, correction = q_sp, (0.0, 0.0, 0.0)
    if gains.ref_w_n > 0.0 and memory[FOLLOWS] != 0.0:
        a = ATTITUDE_SP
        before = (memory[a], memory[a + 1], memory[a + 2], memory[a + 3])
        q_ref, correction = loops.reference_model(
            before, three(memory, CORRECTION), q_sp, memory[YAW_RATE_SP], gains.ref_w_n, period
        )
    memory[FOLLOWS] = 1.0
    for i in range(4):
        memory[ATTITUDE_SP + i] = q_ref[i]
    for i in range(3):
        memory[CORRECTION + i] = correction[i]


@kernel
def _rate_loop(
    omega: Vec,
    rates_sp: Vec,
    collective: float,
    memory: Memory,
    gains: Gains,
    weights: Filters,
    dt: float,
) -> loops.Motors:
    """Return the motor commands for the body rates, with a collective 0..1."""
    torque = torque_setpoint(omega, rates_sp, memory, gains, weights, dt)
    motors, missing = loops.mix(collective, torque, gains)
    for i in range(3):
        memory[SAT + i] = missing[i]
    return motors


@kernel
def torque_setpoint(
    omega: Vec, rates_sp: Vec, memory: Memory, gains: Gains, weights: Filters, dt: float
) -> Vec:
    """Return the torque -1..1 per axis for the body rates, and advance the loop's filters.

    Rates are FRD [rad/s]; the `SAT` of `memory` comes from the mixer's last tick.
    """
    rates_now = (omega[0], omega[1], omega[2])
    # Gyro low-pass (IMU_GYRO_CUTOFF), then the filtered derivative (IMU_DGYRO_CUTOFF).
    for i in range(3):
        before, newer = memory[GYRO + i], memory[GYRO_NEWER + i]
        rate, held = filtered(weights.gyro, rates_now[i], newer, memory[GYRO_OLDER + i])
        memory[GYRO + i], memory[GYRO_NEWER + i], memory[GYRO_OLDER + i] = rate, held, newer
        slope = (rate - before) / dt
        memory[DGYRO + i] += weights.angular_acceleration * (slope - memory[DGYRO + i])
    torque, integral = loops.rate_control(
        three(memory, GYRO),
        three(memory, DGYRO),
        rates_sp,
        three(memory, RATE_INT),
        three(memory, SAT),
        gains,
        dt,
    )
    # PX4 filters the yaw torque alone (MC_YAW_TQ_CUTOFF).
    memory[YAW_TORQUE] += weights.yaw_torque * (torque[2] - memory[YAW_TORQUE])
    for i in range(3):
        memory[RATE_INT + i] = integral[i]
    return torque[0], torque[1], memory[YAW_TORQUE]

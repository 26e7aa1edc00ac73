"""The cascade of one vehicle that is flown from Python, tick by tick.

Passing forty gains to compiled code one by one costs more than the control law: only arrays and
flat tuples are passed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.cascade import (
    Output,
    attitude_tick,
    cascade_tick,
    filters,
    rate_tick,
    trajectory_tick,
)
from airl_mav.control.demand import (
    AnyDemand,
    AttitudeDemand,
    Demand,
    RateDemand,
    TrajectoryDemand,
)
from airl_mav.control.gains import Gains, pack, unpack
from airl_mav.control.low_pass import butterworth
from airl_mav.control.memory import (
    Memory,
    new_memory,
    reset_integrals,
    settle_gyro_filter,
    ticks_to_motors,
)
from airl_mav.control.mixer import Motors
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec

Row = NDArray[np.float64]

# Layout of the output row.
_ATTITUDE, _RATES, _VELOCITY, _THRUST = 0, 4, 7, 10
_SIZE = 11

_TRAJECTORY, _ATTITUDE_ONLY, _RATES_ONLY = 0, 1, 2
_WANTED_SIZE = 11
"""Numbers in the largest demand."""


class ControlSetpoints(NamedTuple):
    """The setpoints of the cascade's loops."""

    attitude: Row
    """(4,) body -> NED."""
    rates: Row
    """(3,) FRD [rad/s]."""
    velocity: Row
    """(3,) after limits, NED [m/s]."""
    thrust: float
    """Collective 0..1."""


@kernel
def _fly(
    state: Row,
    position: Vec,
    velocity: Vec,
    yaw: float,
    yaw_rate: float,
    memory: Memory,
    gains: Row,
    dt: float,
    output: Row,
) -> Motors:
    """Run one tick of the cascade; updates `memory` and `output`, returns the motor commands."""
    known = unpack(gains)
    out = cascade_tick(
        (state[0], state[1], state[2]),
        (state[3], state[4], state[5]),
        (state[6], state[7], state[8], state[9]),
        (state[10], state[11], state[12]),
        Demand(position, velocity, yaw, yaw_rate),
        memory,
        known,
        filters(known, dt),
        dt,
    )
    return _stored(out, output)


@kernel
def _fly_other(
    state: Row, kind: int, wanted: Row, memory: Memory, gains: Row, dt: float, output: Row
) -> Motors:
    """As `_fly`, for the other demands: `wanted` is the fields of the one that `kind` names."""
    known = unpack(gains)
    weights = filters(known, dt)
    position, velocity = (state[0], state[1], state[2]), (state[3], state[4], state[5])
    q = (state[6], state[7], state[8], state[9])
    omega = (state[10], state[11], state[12])
    if kind == _TRAJECTORY:
        trajectory = TrajectoryDemand(
            (wanted[0], wanted[1], wanted[2]),
            (wanted[3], wanted[4], wanted[5]),
            (wanted[6], wanted[7], wanted[8]),
            wanted[9],
            wanted[10],
        )
        out = trajectory_tick(position, velocity, q, omega, trajectory, memory, known, weights, dt)
    elif kind == _ATTITUDE_ONLY:
        attitude = AttitudeDemand(
            (wanted[0], wanted[1], wanted[2], wanted[3]), wanted[4], wanted[5]
        )
        out = attitude_tick(velocity, q, omega, attitude, memory, known, weights, dt)
    else:
        rates = RateDemand((wanted[0], wanted[1], wanted[2]), wanted[3])
        out = rate_tick(velocity, q, omega, rates, memory, known, weights, dt)
    return _stored(out, output)


@kernel
def _stored(out: Output, output: Row) -> Motors:
    """Write the setpoints to the output row; return the motor commands."""
    for i in range(4):
        output[_ATTITUDE + i] = out.attitude[i]
    for i in range(3):
        output[_RATES + i] = out.rates[i]
        output[_VELOCITY + i] = out.velocity[i]
    output[_THRUST] = out.thrust
    return out.motors


class Controller:
    """Gains, memory and newest output of one vehicle's cascade."""

    def __init__(self, gains: Gains, dt: float) -> None:
        """Start at rest; `dt` is the time between two calls of `fly` [s]."""
        self._gains = pack(gains)
        self._gyro_cutoff_hz = gains.gyro_cutoff_hz
        self._dt = dt
        self._memory = new_memory()
        self._output = np.zeros(_SIZE)
        self._wanted = np.zeros(_WANTED_SIZE)
        self.rest()

    def set_gains(self, gains: Gains) -> None:
        """Change the gains in flight."""
        cutoff_hz = gains.gyro_cutoff_hz
        if cutoff_hz != self._gyro_cutoff_hz:
            # The delay elements are scaled by the cut-off: left as they are, a much higher one
            # would multiply the measured rates.
            settle_gyro_filter(self._memory, butterworth(cutoff_hz, self._dt))
            self._gyro_cutoff_hz = cutoff_hz
        self._gains = pack(gains)

    def fly(self, state: Row, demand: AnyDemand) -> Motors:
        """Run one tick; return the motor commands 0..1.

        `state` begins with position NED [m], velocity NED [m/s], attitude body -> NED and body
        rates FRD [rad/s]: 13 floats.
        """
        if not isinstance(demand, Demand):
            return self._fly_other(state, demand)
        position, velocity, yaw, yaw_rate = demand
        motors: Motors = _fly(
            state,
            position,
            velocity,
            yaw,
            yaw_rate,
            self._memory,
            self._gains,
            self._dt,
            self._output,
        )
        return motors

    def _fly_other(
        self, state: Row, demand: TrajectoryDemand | AttitudeDemand | RateDemand
    ) -> Motors:
        wanted = self._wanted
        if isinstance(demand, TrajectoryDemand):
            kind = _TRAJECTORY
            position, velocity, acceleration, yaw, yaw_rate = demand
            wanted[:] = (*position, *velocity, *acceleration, yaw, yaw_rate)
        elif isinstance(demand, AttitudeDemand):
            kind = _ATTITUDE_ONLY
            wanted[:6] = (*demand.attitude, demand.yaw_rate, demand.thrust)
        else:
            kind = _RATES_ONLY
            wanted[:4] = (*demand.rates, demand.thrust)
        motors: Motors = _fly_other(
            state, kind, wanted, self._memory, self._gains, self._dt, self._output
        )
        return motors

    def rest(self) -> None:
        """Reset while the motors are stopped: no integrator may wind up, and there is no output."""
        reset_integrals(self._memory)
        self._output[:] = 0.0
        self._output[_ATTITUDE] = 1.0

    @property
    def ticks_to_motors(self) -> int:
        """After how many more ticks the motors reflect what is demanded in the next one."""
        return ticks_to_motors(self._memory)

    @property
    def thrust(self) -> float:
        """Collective that is commanded, 0..1."""
        return self._output.item(_THRUST)

    @property
    def descending(self) -> bool:
        """Whether the velocity setpoint points down, or nothing controls the velocity."""
        return not self._output.item(_VELOCITY + 2) <= 0.0

    def setpoints(self) -> ControlSetpoints:
        """Return a copy of the setpoints of the newest tick."""
        row = self._output.copy()
        return ControlSetpoints(
            row[_ATTITUDE:_RATES], row[_RATES:_VELOCITY], row[_VELOCITY:_THRUST], row.item(_THRUST)
        )

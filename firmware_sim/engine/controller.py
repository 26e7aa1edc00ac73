"""Control loops on a flight controller's record."""

from __future__ import annotations

from typing import NamedTuple

from airl_mav.control import loops, memory
from airl_mav.control.cascade import filters
from airl_mav.control.demand import AnyDemand, AttitudeDemand, Demand, Gains, TrajectoryDemand
from airl_mav.core import constants, frames
from firmware_sim.engine.record import (
    ATTITUDE,
    IDLE,
    POSITION,
    RATES,
    TRAJECTORY,
    Record,
    new_controller,
)
from firmware_sim.engine.ticks import control_record

_ATTITUDE, _RATES, _VELOCITY, _THRUST = 0, 4, 7, 10
"""Offsets of the setpoints in `output`."""


class ControlSetpoints(NamedTuple):
    """Setpoints of the cascade's loops."""

    attitude: frames.Vector
    """(4,) body -> NED."""
    rates: frames.Vector
    """(3,) FRD [rad/s]."""
    velocity: frames.Vector
    """(3,) after limits, NED [m/s]."""
    thrust: float
    """Collective 0..1."""


class Controller:
    """Gains, demand and setpoints of the cascade in a flight controller's record."""

    def __init__(self, gains: Gains, record: Record | None = None) -> None:
        """Start at rest, on a flight controller's record; None = on a new record."""
        self._record = record = new_controller() if record is None else record
        self._demand: AnyDemand | None = None
        self._wanted, self._output = record["demand"][0], record["output"][0]
        self._memory, self._motors = record["memory"][0], record["motors"][0]
        self._gyro_cutoff_hz = gains.gyro_cutoff_hz
        self._keep(gains)
        self.rest()

    def set_gains(self, gains: Gains) -> None:
        """Change the gains in flight."""
        cutoff_hz = gains.gyro_cutoff_hz
        if cutoff_hz != self._gyro_cutoff_hz:
            # Filter states scale with the cutoff: unchanged states would multiply the measured
            # rates at a much higher cutoff.
            memory.settle_gyro_filter(self._memory, filters(gains, constants.TICK_S).gyro)
            self._gyro_cutoff_hz = cutoff_hz
        self._keep(gains)

    def _keep(self, gains: Gains) -> None:
        velocity, gyro, dgyro, yaw = filters(gains, constants.TICK_S)
        self._record["gains"], self._record["filters"] = tuple(gains), (velocity, *gyro, dgyro, yaw)

    def command(self, demand: AnyDemand | None) -> None:
        """Set the demand of the coming ticks; None = stop the motors."""
        # The same object means the same demand: nothing to write.
        if demand is self._demand:
            return
        self._demand, record, wanted = demand, self._record, self._wanted
        if demand is None:
            record["demand_kind"] = IDLE
            self._motors[:] = 0.0
            # Integrators must not wind up while the motors are stopped.
            self.rest()
        elif isinstance(demand, Demand):
            record["demand_kind"] = POSITION
            wanted[:3], wanted[3:6], wanted[6], wanted[7] = demand
        elif isinstance(demand, TrajectoryDemand):
            record["demand_kind"] = TRAJECTORY
            wanted[:3], wanted[3:6], wanted[6:9], wanted[9], wanted[10] = demand
        elif isinstance(demand, AttitudeDemand):
            record["demand_kind"] = ATTITUDE
            wanted[:4], wanted[4], wanted[5] = demand
        else:
            record["demand_kind"] = RATES
            wanted[:3], wanted[3] = demand

    def fly(self, state: frames.Vector, demand: AnyDemand) -> loops.Motors:
        """Run one tick; return the motor commands 0..1.

        `state` begins with position NED [m], velocity NED [m/s], attitude body -> NED and body
        rates FRD [rad/s]: 13 floats.
        """
        self._record["state"][0, :13] = state[:13]
        self.command(demand)
        control_record(self._record)
        return self.motors

    def rest(self) -> None:
        """Reset while the motors are stopped: no integrator windup, zero output."""
        memory.reset_integrals(self._memory)
        self._output[:] = 0.0
        self._output[_ATTITUDE] = 1.0

    @property
    def motors(self) -> loops.Motors:
        """Newest motor commands 0..1."""
        a, b, c, d = self._motors.tolist()
        return a, b, c, d

    @property
    def thrust(self) -> float:
        """Commanded collective 0..1."""
        return self._output.item(_THRUST)

    def setpoints(self) -> ControlSetpoints:
        """Return a copy of the setpoints of the newest tick."""
        row = self._output.copy()
        return ControlSetpoints(
            row[_ATTITUDE:_RATES], row[_RATES:_VELOCITY], row[_VELOCITY:_THRUST], row.item(_THRUST)
        )

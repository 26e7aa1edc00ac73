"""Offboard mode: flies the setpoints of a companion computer."""

from __future__ import annotations

import math

from airl_mav.control.demand import (
    KIND_US,
    AnyDemand,
    AttitudeDemand,
    Demand,
    RateDemand,
    TrajectoryDemand,
)
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Setpoint
from firmware_sim.autopilot.error_state import RATES
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes import automatic, interface

CLIMBS_M_S = 0.1
"""Minimum climb rate of a setpoint that lifts a standing vehicle [m/s]."""

HOVER = Demand(interface.FREE, (0.0, 0.0, 0.0), interface.NAN, interface.NAN)
"""PX4's fallback for a setpoint with an uncommanded axis (PositionControl::inputValid)."""


class Offboard(interface.FlightMode, modes=(Mode.OFFBOARD,)):
    """Offboard mode: flies the newest setpoint; holds position before the first."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._waiting = automatic.Hold(context)
        self._setpoint: interface.OffboardSetpoint | None = None
        self._flown: AnyDemand | None = None
        self._kind: type = Setpoint
        """Type of the active setpoint."""
        self._kind_us = 0
        """Time of the next check of the type [µs]."""

    @property
    def lifts(self) -> bool:
        """True if the setpoint is above the ground, climbs, or commands thrust."""
        demand = self._demand_of(self._context.setpoint)
        if demand is None:
            return False
        if isinstance(demand, AttitudeDemand | RateDemand):
            return True
        above = self._context.home[2] - automatic.ABOVE_HOME_M
        if isinstance(demand, TrajectoryDemand) and demand.acceleration[2] < -CLIMBS_M_S:
            return True
        return demand.velocity[2] < -CLIMBS_M_S or demand.position[2] < above

    @property
    def is_steady(self) -> bool:
        """True if the setpoint determines the whole demand and no type change is pending."""
        newest = self._context.setpoint
        if newest is None or type(newest) is not self._kind:
            return False
        return not isinstance(newest, RateDemand) or not math.isnan(newest.rates[2])

    def enter(self, state: Vector, _request: interface.ModeRequest | None, /) -> None:
        """Start the mode."""
        self._waiting.enter(state, None)
        self._kind_us = 0

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return the demand of the setpoint."""
        newest = self._context.setpoint
        if newest is not None and time_us >= self._kind_us:
            self._kind_us, self._kind = time_us + KIND_US, type(newest)
        demand = self._demand_of(self._context.setpoints.get(self._kind))
        if demand is None:
            return self._waiting.demand(state, time_us)
        if isinstance(demand, RateDemand) and math.isnan(demand.rates[2]):
            # Without a commanded yaw rate, the current rate is kept.
            roll, pitch, _ = demand.rates
            return RateDemand((roll, pitch, state.item(RATES + 2)), demand.thrust)
        return demand

    def _demand_of(self, setpoint: interface.OffboardSetpoint | None) -> AnyDemand | None:
        """Return a setpoint as a demand, cached while the setpoint is unchanged."""
        if setpoint is None:
            return None
        if setpoint is not self._setpoint:
            self._setpoint = setpoint
            self._flown = demand_of(setpoint) if isinstance(setpoint, Setpoint) else setpoint
        return self._flown


def demand_of(setpoint: Setpoint) -> Demand | TrajectoryDemand:
    """Return the controller demand of a position and motion setpoint; NaN = not commanded.

    Each axis needs a position, velocity or acceleration, and north and east must come in pairs. If
    not, the vehicle hovers. Source: PX4 1.16, PositionControl::inputValid.
    """
    isnan, position = math.isnan, tuple(setpoint.position.tolist())
    velocity, acceleration = (
        tuple(setpoint.velocity.tolist()),
        tuple(setpoint.acceleration.tolist()),
    )
    if not _is_valid(position, velocity, acceleration):
        return HOVER._replace(yaw=setpoint.yaw, yaw_rate=setpoint.yaw_rate)
    if all(map(isnan, acceleration)):
        # An uncommanded velocity adds nothing to a position.
        vn, ve, vd = velocity
        rest = 0.0 if isnan(vn) else vn, 0.0 if isnan(ve) else ve, 0.0 if isnan(vd) else vd
        return Demand(position, rest, setpoint.yaw, setpoint.yaw_rate)
    return TrajectoryDemand(position, velocity, acceleration, setpoint.yaw, setpoint.yaw_rate)


def _is_valid(position: Vec, velocity: Vec, acceleration: Vec) -> bool:
    isnan = math.isnan
    for kind in (position, velocity, acceleration):
        if isnan(kind[0]) != isnan(kind[1]):
            return False
    for p, v, a in zip(position, velocity, acceleration, strict=True):
        if isnan(p) and isnan(v) and isnan(a):
            return False
    return True

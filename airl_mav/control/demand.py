"""Inputs of the cascade: one kind of demand for each entry point.

NaN = not commanded.
"""

from __future__ import annotations

from typing import NamedTuple

from airl_mav.vehicle.rotation import Quat, Vec


class Demand(NamedTuple):
    """Setpoint of the cascade; NaN = not commanded."""

    position: Vec
    """NED [m]."""
    velocity: Vec
    """NED [m/s]."""
    yaw: float
    """Heading [rad]; NaN with a yaw rate = the current heading."""
    yaw_rate: float
    """[rad/s] about the world's down axis."""


class TrajectoryDemand(NamedTuple):
    """Demand with an acceleration: PX4's trajectory setpoint, any mixture of axes."""

    position: Vec
    """NED [m]."""
    velocity: Vec
    """NED [m/s]: alone, or fed forward to the position's correction."""
    acceleration: Vec
    """NED [m/s²]: alone, or fed forward to the velocity's correction."""
    yaw: float
    """Heading [rad]; NaN with a yaw rate = the current heading."""
    yaw_rate: float
    """[rad/s] about the world's down axis."""


class AttitudeDemand(NamedTuple):
    """Input of the attitude loop, without velocity control."""

    attitude: Quat
    """Body -> NED."""
    yaw_rate: float
    """Fed forward, about the world's down axis [rad/s]."""
    thrust: float
    """Collective 0..1."""


class RateDemand(NamedTuple):
    """Input of the rate loop, without attitude control."""

    rates: Vec
    """Body rates FRD [rad/s]."""
    thrust: float
    """Collective 0..1."""


KIND_US = 500_000
"""Interval of changes between kinds of offboard setpoint [µs]: PX4 accepts another kind when it
publishes its control mode, twice a second, counted from its last status change, such as the switch
to Offboard. Until then it flies the last setpoint of the previous kind. Source: PX4 1.16,
Commander::run (vehicle_control_mode); measured: from velocities to body rates it took 0.5 s."""

AnyDemand = Demand | TrajectoryDemand | AttitudeDemand | RateDemand
"""Inputs of `Controller.fly`."""

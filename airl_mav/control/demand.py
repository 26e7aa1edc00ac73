"""What the cascade can be asked for: one kind of demand for each loop where it can be entered.

NaN = not commanded.
"""

from __future__ import annotations

from typing import NamedTuple

from airl_mav.vehicle.rotation import Quat, Vec


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


class TrajectoryDemand(NamedTuple):
    """As `Demand`, with an acceleration: PX4's trajectory setpoint, any mixture of axes."""

    position: Vec
    """NED [m]."""
    velocity: Vec
    """NED [m/s]: alone, or fed forward to the position's correction."""
    acceleration: Vec
    """NED [m/s²]: alone, or fed forward to the velocity's correction."""
    yaw: float
    """Heading [rad]; NaN with a yaw rate = the heading of the moment."""
    yaw_rate: float
    """[rad/s] about the world's down axis."""


class AttitudeDemand(NamedTuple):
    """What the attitude loop is given; nothing controls the velocity."""

    attitude: Quat
    """Body -> NED."""
    yaw_rate: float
    """Fed forward, about the world's down axis [rad/s]."""
    thrust: float
    """Collective 0..1."""


class RateDemand(NamedTuple):
    """What the rate loop is given; nothing controls the attitude."""

    rates: Vec
    """Body rates FRD [rad/s]."""
    thrust: float
    """Collective 0..1."""


KIND_US = 500_000
"""PX4 follows another kind of offboard setpoint at the next publication of its control mode: twice
a second, counted from the last change of its status, as the switch to Offboard is one [µs]. Until
then it flies the last of the kind before. Source: PX4 1.16, Commander::run (vehicle_control_mode);
measured: from velocities to body rates it took 0.5 s."""

AnyDemand = Demand | TrajectoryDemand | AttitudeDemand | RateDemand
"""What `Controller.fly` takes."""

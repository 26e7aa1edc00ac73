"""Vehicles of the vectorized simulator: their state as arrays, and shared constants.

`fleet_step.advance` simulates them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.demand import Gains
from airl_mav.control.loops import attitude_setpoint
from airl_mav.control.memory import MEMORY_SIZE, new_memory, trim_against_torque, trim_for_hover
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.envs.arena_batch import NOTHING
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import (
    N_ROTORS,
    Airframe,
    airframe_of,
    command_for,
    drag_force,
    hover_speeds,
    lag,
)
from airl_mav.vehicle.power import PowerModel
from airl_mav.vehicle.rotation import Quat, Vec


class FlightStatus(IntEnum):
    """Status of a flight: flying, or the reason of its end; `flight.judge.Outcome` for arrays."""

    FLYING = 0
    SUCCESS = 1
    COLLISION = 2
    BATTERY = 3
    TIMEOUT = 4
    ABORTED = 5


class Rules(NamedTuple):
    """End conditions of a flight besides collision and battery; as `flight.judge.Task`."""

    goal_radius: float
    """Maximum distance to the goal for success [m]; horizontal if the goal has no height."""
    time_limit_us: int
    """Maximum flight time [µs]."""


class Fleet(NamedTuple):
    """State of n vehicles; rows are updated in place."""

    time_us: NDArray[np.int64]  # (n,) since the flight's start
    position: NDArray[np.float64]  # (n, 3) NED [m]
    velocity: NDArray[np.float64]  # (n, 3) NED [m/s]
    quaternion: NDArray[np.float64]  # (n, 4) body -> NED
    omega: NDArray[np.float64]  # (n, 3) FRD [rad/s]
    rotor: NDArray[np.float64]  # (n, 4) speeds, fraction of full
    felt: NDArray[np.float64]  # (n, 3) acceleration NED for the power model [m/s²]
    memory: NDArray[np.float64]  # (n, MEMORY_SIZE) state of the cascade
    setpoint: NDArray[np.float64]  # (n, 4) forward, right, down [m/s], yaw rate [rad/s]; or, ...
    by_rates: NDArray[np.bool_]  # (n,) ... body rates FRD [rad/s] and thrust 0..1
    velocity_ned: NDArray[np.float64]  # (n, 3) the setpoint as stored by PX4
    repeat_us: NDArray[np.int64]  # (n,) time of the next repeat
    distance: NDArray[np.float64]  # (n,) path length since the start [m]
    energy: NDArray[np.float64]  # (n,) used since the start, without the computer [J]
    battery: NDArray[np.float64]  # (n,) state of charge, 1 full to 0 empty
    room: NDArray[np.float64]  # (n,) lower bound of the combined motion to a contact; 0 = check [m]
    touched: NDArray[np.int64]  # (n,) first contact: obstacle, FLOOR, ..., or NOTHING
    verdict: NDArray[np.int64]  # (n,) FlightStatus
    airframe: NDArray[np.float64]  # (n, fields of Airframe) parameters of each vehicle


class FramePoses(NamedTuple):
    """Time and pose of the newest frames of n vehicles; rows are updated in place."""

    time_us: NDArray[np.int64]  # (n,) in each episode
    position: NDArray[np.float64]  # (n, 3) NED [m]
    quaternion: NDArray[np.float64]  # (n, 4) body -> NED
    velocity: NDArray[np.float64]  # (n, 3) NED [m/s]
    omega: NDArray[np.float64]  # (n, 3) FRD [rad/s]


class FlightArrays(NamedTuple):
    """Status of n flights; arrays (n,)."""

    verdict: NDArray[np.int64]
    """`FlightStatus` of each flight."""
    touched: NDArray[np.int64]
    """Index of the touched obstacle, or `arena_batch.FLOOR`, `CEILING`, `WALL`, `NOTHING`."""
    time_s: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    """Path length so far [m]."""
    energy_j: NDArray[np.float64]
    goal_distance_m: NDArray[np.float64]
    """True distance [m]; horizontal if the goal has no height."""
    speed_m_s: NDArray[np.float64]
    """True speed in three dimensions."""
    battery: NDArray[np.float64]
    """Remaining charge, 1 to 0."""


class Pack(NamedTuple):
    """Constants of the battery."""

    empty_v: float
    """Open-circuit voltage of the empty pack [V]."""
    full_v: float
    resistance_ohm: float
    capacity_mah: float


class FleetConstants(NamedTuple):
    """Constants shared by all vehicles of a fleet."""

    airframe: Airframe
    """Nominal airframe; default of `hover`."""
    gains: Gains
    power: PowerModel
    pack: Pack
    computer_w: float
    """Power of the onboard computer from the pack [W]."""
    radius: float
    """Radius of the collision disc [m]."""
    half_height: float


def vehicle_of(
    profile: VehicleProfile, parameter: Callable[[str], float], computer_w: float = 0.0
) -> FleetConstants:
    """Return the constants of a vehicle profile.

    Args:
        profile: The vehicle.
        parameter: Lookup of PX4-named parameters, the same as in the flight controller.
        computer_w: Power of the onboard computer from the pack [W].
    """
    b = profile.battery
    return FleetConstants(
        airframe=Airframe.from_profile(profile),
        gains=Gains.from_parameters(parameter),
        power=PowerModel.from_profile(profile),
        pack=Pack(
            b.cells * b.cell_empty_v, b.cells * b.cell_full_v, b.resistance_ohm, b.capacity_mah
        ),
        computer_w=computer_w,
        radius=0.5 * profile.body.width_m,
        half_height=0.5 * profile.body.height_m,
    )


def new_fleet(n: int) -> Fleet:
    """Return n vehicles at rest at the origin."""
    quaternion = np.zeros((n, 4))
    quaternion[:, 0] = 1.0
    return Fleet(
        time_us=np.zeros(n, np.int64),
        position=np.zeros((n, 3)),
        velocity=np.zeros((n, 3)),
        quaternion=quaternion,
        omega=np.zeros((n, 3)),
        rotor=np.zeros((n, 4)),
        felt=np.zeros((n, 3)),
        memory=new_memory(n),
        setpoint=np.zeros((n, 4)),
        by_rates=np.zeros(n, np.bool_),
        velocity_ned=np.zeros((n, 3)),
        repeat_us=np.zeros(n, np.int64),
        distance=np.zeros(n),
        energy=np.zeros(n),
        battery=np.ones(n),
        room=np.zeros(n),
        touched=np.full(n, NOTHING, np.int64),
        verdict=np.full(n, int(FlightStatus.FLYING), np.int64),
        airframe=np.zeros((n, len(Airframe._fields))),
    )


def put_vehicle(fleet: Fleet, i: int, of: Fleet, j: int) -> None:
    """Copy the state of vehicle j of another fleet to vehicle i."""
    for array, theirs in zip(fleet, of, strict=True):
        array[i] = theirs[j]


STILL: Vec = (0.0, 0.0, 0.0)
"""Velocity of a vehicle at rest, and of calm air, NED [m/s]."""


def hover(
    fleet: Fleet,
    i: int,
    altitude_m: float,
    vehicle: FleetConstants,
    airframe: Airframe | None = None,
    battery: float = 1.0,
    wind: Vec = STILL,
) -> None:
    """Set vehicle i to a hover above the origin, heading north, all counters at zero.

    In wind the vehicle starts at the steady-state tilt, so no settling time is needed.

    Args:
        fleet: Fleet that contains vehicle i.
        i: Row.
        altitude_m: Height above the floor [m].
        vehicle: Constants shared by all vehicles.
        airframe: Airframe of this vehicle; None = nominal.
        battery: State of charge at the start, 1 full to 0 empty.
        wind: Steady wind NED [m/s].
    """
    # Clear every counter, then set the fields that are not 0.
    for array in fleet:
        array[i] = 0
    a = vehicle.airframe if airframe is None else airframe
    fleet.airframe[i] = a
    fleet.position[i, 2] = -altitude_m
    fleet.quaternion[i, 0] = 1.0
    speeds, north, east = hover_speeds(a), 0.0, 0.0
    # Thrust must balance weight and drag: tilt the vehicle into the wind.
    if wind != STILL:
        push, weight = drag_force(STILL, wind, a), a.mass * GRAVITY_M_S2
        thrust = (-push[0], -push[1], -push[2] - weight)
        fleet.quaternion[i] = attitude_setpoint(thrust, 1.0, 0.0)
        north, east = (GRAVITY_M_S2 * thrust[axis] / -thrust[2] for axis in (0, 1))
        # Thrust grows with the square of the rotor speed.
        more = math.sqrt(math.hypot(*thrust) / weight)
        s0, s1, s2, s3 = (min(1.0, more * speed) for speed in speeds)
        speeds = s0, s1, s2, s3
    fleet.rotor[i] = speeds
    # Invert the thrust curve: the commands that give these speeds.
    c0, c1, c2, c3 = (command_for(speed * speed, a.thrust_curve) for speed in speeds)
    collective = math.fsum((c0, c1, c2, c3)) / N_ROTORS
    # The integrals start at their steady state of a hover.
    trim_for_hover(fleet.memory[i], collective, vehicle.gains, north, east)
    trim_against_torque(fleet.memory[i], (c0, c1, c2, c3), vehicle.gains)
    fleet.battery[i] = battery
    fleet.touched[i] = NOTHING
    fleet.verdict[i] = FlightStatus.FLYING


LANES = 4
"""Number of vehicles simulated together: the doubles in an AVX2 register. With eight, a thousand
vehicles are 2 to 4 % faster and a single one takes 1.5 times as long."""

State = NDArray[np.float64]
"""(ROWS, LANES): one column per vehicle."""

# Rows that persist between two ticks; see `Fleet`.
POSITION, VELOCITY, ATTITUDE, RATES, ROTOR, FELT = 0, 3, 6, 10, 13, 17
WANTED, YAW_RATE = 20, 23  # the setpoint: velocity NED [m/s], yaw rate [rad/s]
ENERGY, BATTERY, DISTANCE = 24, 25, 26
ROTOR_LEFT = 27  # remaining share of a rotor's speed error after a tick
# Rows that pass values between the loops of a tick.
WIND, MOVED = 28, 31  # NED [m/s]; path length of the tick [m]
FIRST = 32  # 1 = the filters were initialized in this tick
PUBLISHED, PUBLISHED_YAW_RATE, PUBLISHED_THRUST = 33, 37, 38  # setpoint of the attitude loop
REDUCED, HALF_TURN = 39, 43  # of the attitude loop
TORQUE, COLLECTIVE, MOTORS = 44, 47, 48  # of the rate loop
FITS = 52  # 1 = all motor commands are in range
BY_RATES = 53  # 1 = `WANTED` holds body rates [rad/s], and `YAW_RATE` the thrust
AIRFRAME = 54
AIRFRAME_SIZE = len(Airframe._fields)
MEMORY = AIRFRAME + AIRFRAME_SIZE
ROWS = MEMORY + MEMORY_SIZE


@kernel
def vec(state: State, row: int, j: int) -> Vec:
    """Return three rows of a column."""
    return state[row, j], state[row + 1, j], state[row + 2, j]


@kernel
def quat(state: State, row: int, j: int) -> Quat:
    """Return four rows of a column."""
    return state[row, j], state[row + 1, j], state[row + 2, j], state[row + 3, j]


@borrowing_kernel
def load(fleet: Fleet, i: int, state: State, j: int) -> None:
    """Copy vehicle i to lane j."""
    for axis in range(3):
        state[POSITION + axis, j] = fleet.position[i, axis]
        state[VELOCITY + axis, j] = fleet.velocity[i, axis]
        state[RATES + axis, j] = fleet.omega[i, axis]
        state[FELT + axis, j] = fleet.felt[i, axis]
        # Body rates need no conversion to NED.
        by_rates = fleet.by_rates[i]
        state[WANTED + axis, j] = (
            fleet.setpoint[i, axis] if by_rates else fleet.velocity_ned[i, axis]
        )
    for k in range(4):
        state[ATTITUDE + k, j] = fleet.quaternion[i, k]
        state[ROTOR + k, j] = fleet.rotor[i, k]
    state[YAW_RATE, j], state[BY_RATES, j] = fleet.setpoint[i, 3], fleet.by_rates[i]
    state[ENERGY, j] = fleet.energy[i]
    state[BATTERY, j] = fleet.battery[i]
    state[DISTANCE, j] = fleet.distance[i]
    # The time constant differs between randomized airframes.
    state[ROTOR_LEFT, j] = lag(airframe_of(fleet.airframe[i]), TICK_S)
    for k in range(AIRFRAME_SIZE):
        state[AIRFRAME + k, j] = fleet.airframe[i, k]
    for k in range(MEMORY_SIZE):
        state[MEMORY + k, j] = fleet.memory[i, k]


@borrowing_kernel
def unload(fleet: Fleet, i: int, state: State, j: int) -> None:
    """Write lane j back to vehicle i."""
    for axis in range(3):
        fleet.position[i, axis] = state[POSITION + axis, j]
        fleet.velocity[i, axis] = state[VELOCITY + axis, j]
        fleet.omega[i, axis] = state[RATES + axis, j]
        fleet.felt[i, axis] = state[FELT + axis, j]
    for k in range(4):
        fleet.quaternion[i, k] = state[ATTITUDE + k, j]
        fleet.rotor[i, k] = state[ROTOR + k, j]
    fleet.energy[i] = state[ENERGY, j]
    fleet.battery[i] = state[BATTERY, j]
    fleet.distance[i] = state[DISTANCE, j]
    for k in range(MEMORY_SIZE):
        fleet.memory[i, k] = state[MEMORY + k, j]

"""The batch twin: N vehicles with the full rigid body and cascade at 250 Hz, one call a decision.

The same kernels as the rehearsal (`airl_mav.vehicle`, `airl_mav.control`), without estimator and
MAVLink: control sees the true state. A setpoint in the heading frame is turned into NED when it
arrives and again at each of MAVSDK's 20 Hz repeats, as PX4 does it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.constants import GRAVITY_M_S2, TICK_S, TICK_US
from airl_mav.control.attitude import heading_of
from airl_mav.control.cascade import (
    Demand,
    Filters,
    cascade_tick,
    filters,
    new_memory,
    trim_for_hover,
)
from airl_mav.control.gains import Gains
from airl_mav.envs.arenas import ArenaBatch, move_obstacles
from airl_mav.envs.contact import NOTHING, clearance, touches
from airl_mav.kernels import kernel
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.battery import drain, open_circuit, terminal_voltage
from airl_mav.vehicle.power import Coefficients, coefficients, power_w
from airl_mav.vehicle.rigid_body import drag_force, step
from airl_mav.vehicle.rotation import Vec, rotate
from airl_mav.vehicle.rotor import command_for, lag, settle, wrench

REPEAT_US = 50_000
"""MAVSDK repeats the newest setpoint at 20 Hz [µs]."""

_ROUNDING_M = 1e-6
"""Distances are this exact, and far more."""

NAN3: Vec = (math.nan, math.nan, math.nan)


class Verdict(IntEnum):
    """How a flight ended, or that it goes on; `flight.judge.Outcome` for arrays."""

    FLYING = 0
    SUCCESS = 1
    COLLISION = 2
    BATTERY = 3
    TIMEOUT = 4


_FLYING = int(Verdict.FLYING)
_SUCCESS = int(Verdict.SUCCESS)
_COLLISION = int(Verdict.COLLISION)
_BATTERY = int(Verdict.BATTERY)
_TIMEOUT = int(Verdict.TIMEOUT)


class Rules(NamedTuple):
    """What ends a flight besides collision and battery; as `flight.judge.Task`."""

    goal_radius: float
    """The goal is reached closer than this, seen from above [m]."""
    time_limit_us: int
    """Longest flight [µs]."""


class Fleet(NamedTuple):
    """State of n vehicles; rows are updated in place."""

    time_us: NDArray[np.int64]  # (n,) since each one's start
    position: NDArray[np.float64]  # (n, 3) NED [m]
    velocity: NDArray[np.float64]  # (n, 3) NED [m/s]
    quaternion: NDArray[np.float64]  # (n, 4) body -> NED
    omega: NDArray[np.float64]  # (n, 3) FRD [rad/s]
    rotor: NDArray[np.float64]  # (n, 4) speeds, fraction of full
    memory: NDArray[np.float64]  # (n, MEMORY_SIZE) of the cascade
    setpoint: NDArray[np.float64]  # (n, 4) forward, right, down [m/s], yaw rate [rad/s]
    velocity_ned: NDArray[np.float64]  # (n, 3) the setpoint as PX4 holds it
    repeat_us: NDArray[np.int64]  # (n,) time of the next repeat
    distance: NDArray[np.float64]  # (n,) flown since the start [m]
    energy: NDArray[np.float64]  # (n,) drawn since the start [J]
    battery: NDArray[np.float64]  # (n,) state of charge, 1 full to 0 empty
    touched: NDArray[np.int64]  # (n,) first contact: obstacle, FLOOR, WALL, or NOTHING
    verdict: NDArray[np.int64]  # (n,) Verdict
    airframe: NDArray[np.float64]  # (n, fields of Airframe) each one's own


class Pack(NamedTuple):
    """The battery's constants."""

    empty_v: float
    """Open-circuit voltage of the empty pack [V]."""
    full_v: float
    resistance_ohm: float
    capacity_mah: float


class Vehicle(NamedTuple):
    """The constants that all vehicles of a fleet share."""

    airframe: Airframe
    """Nominal: what `hover` gives a vehicle that is not given its own."""
    gains: Gains
    power: Coefficients
    pack: Pack
    payload_g: float
    radius: float
    """Of the collision disc [m]."""
    half_height: float


def vehicle_of(profile: VehicleProfile, parameter: Callable[[str], float]) -> Vehicle:
    """Return the constants of a vehicle profile.

    Args:
        profile: The vehicle.
        parameter: Lookup of PX4-named parameters: the flight controller's, so that both fly alike.
    """
    b = profile.battery
    return Vehicle(
        airframe=Airframe.from_profile(profile),
        gains=Gains.from_parameters(parameter),
        power=coefficients(profile.power),
        pack=Pack(
            b.cells * b.cell_empty_v, b.cells * b.cell_full_v, b.resistance_ohm, b.capacity_mah
        ),
        payload_g=profile.power.payload_g,
        radius=0.5 * profile.body.width_m,
        half_height=0.5 * profile.body.height_m,
    )


def new_fleet(n: int) -> Fleet:
    """Return n vehicles at rest in the origin."""
    quaternion = np.zeros((n, 4))
    quaternion[:, 0] = 1.0
    return Fleet(
        time_us=np.zeros(n, np.int64),
        position=np.zeros((n, 3)),
        velocity=np.zeros((n, 3)),
        quaternion=quaternion,
        omega=np.zeros((n, 3)),
        rotor=np.zeros((n, 4)),
        memory=new_memory(n),
        setpoint=np.zeros((n, 4)),
        velocity_ned=np.zeros((n, 3)),
        repeat_us=np.zeros(n, np.int64),
        distance=np.zeros(n),
        energy=np.zeros(n),
        battery=np.ones(n),
        touched=np.full(n, NOTHING, np.int64),
        verdict=np.full(n, _FLYING, np.int64),
        airframe=np.zeros((n, len(Airframe._fields))),
    )


def hover(
    fleet: Fleet,
    i: int,
    altitude_m: float,
    vehicle: Vehicle,
    airframe: Airframe | None = None,
    battery: float = 1.0,
) -> None:
    """Put vehicle i into a hover above the origin, heading north, all counters at zero.

    Args:
        fleet: Where vehicle i is.
        i: Row.
        altitude_m: Height above the floor [m].
        vehicle: What all vehicles share.
        airframe: This vehicle's own; None = the nominal one.
        battery: State of charge at the start, 1 full to 0 empty.
    """
    for array in fleet:
        array[i] = 0
    a = vehicle.airframe if airframe is None else airframe
    fleet.airframe[i] = a
    fleet.position[i, 2] = -altitude_m
    fleet.quaternion[i, 0] = 1.0
    share = a.mass * GRAVITY_M_S2 / (4.0 * a.thrust_max)
    fleet.rotor[i] = math.sqrt(share)
    trim_for_hover(fleet.memory[i], command_for(share, a.thrust_curve), vehicle.gains)
    fleet.battery[i] = battery
    fleet.touched[i] = NOTHING
    fleet.verdict[i] = _FLYING


@kernel
def advance(
    fleet: Fleet, arenas: ArenaBatch, ticks: NDArray[np.int64], vehicle: Vehicle, rules: Rules
) -> None:
    """Fly every vehicle whose verdict is FLYING for its number of ticks on its setpoint.

    A flight ends in the tick that decides it, and its `time_us` stays there. Tests and their order
    are the referee's (`flight.judge`): goal, collision, battery, time limit.

    A setpoint that was changed since the last call takes effect at once: set `repeat_us` to the
    vehicle's time to have it turned into NED by the present heading.

    Args:
        fleet: Updated in place.
        arenas: One a vehicle; the moving obstacles' centres are updated in place.
        ticks: (n,) how many ticks each one flies.
        vehicle: What all vehicles share.
        rules: What ends a flight.
    """
    weights = filters(vehicle.gains, TICK_S)
    for i in range(len(fleet.time_us)):
        if fleet.verdict[i] == _FLYING:
            _fly(fleet, arenas, i, ticks[i], vehicle, rules, weights)


@kernel
def _airframe(row: NDArray[np.float64]) -> Airframe:
    """Return a row of `Fleet.airframe` by its names."""
    return Airframe(
        row[0],
        row[1],
        row[2],
        row[3],
        row[4],
        row[5],
        row[6],
        row[7],
        row[8],
        row[9],
        row[10],
        row[11],
        row[12],
    )


@kernel
def _contact(
    arenas: ArenaBatch, i: int, position: Vec, time_us: int, vehicle: Vehicle
) -> tuple[float, int]:
    """Return how far [m] vehicle i surely is from everything, and what it touches."""
    move_obstacles(arenas, i, time_us)
    bounds, count = arenas.bounds[i], arenas.n_obstacles[i]
    shape, center = arenas.shape[i], arenas.center[i]
    half_size, yaw = arenas.half_size[i], arenas.yaw[i]
    radius, half_height = vehicle.radius, vehicle.half_height
    room = clearance(position, radius, half_height, bounds, count, center, half_size)
    if room > _ROUNDING_M:
        return room, NOTHING
    return room, touches(
        position, radius, half_height, bounds, count, shape, center, half_size, yaw
    )


@kernel
def _fly(
    fleet: Fleet,
    arenas: ArenaBatch,
    i: int,
    ticks: int,
    vehicle: Vehicle,
    rules: Rules,
    weights: Filters,
) -> None:
    airframe, gains, pack = _airframe(fleet.airframe[i]), vehicle.gains, vehicle.pack
    goal_north, goal_east = arenas.goal[i, 0], arenas.goal[i, 1]
    battery = fleet.battery[i]
    p = (fleet.position[i, 0], fleet.position[i, 1], fleet.position[i, 2])
    v = (fleet.velocity[i, 0], fleet.velocity[i, 1], fleet.velocity[i, 2])
    q = (
        fleet.quaternion[i, 0],
        fleet.quaternion[i, 1],
        fleet.quaternion[i, 2],
        fleet.quaternion[i, 3],
    )
    w = (fleet.omega[i, 0], fleet.omega[i, 1], fleet.omega[i, 2])
    s0, s1, s2, s3 = fleet.rotor[i, 0], fleet.rotor[i, 1], fleet.rotor[i, 2], fleet.rotor[i, 3]
    time_us = fleet.time_us[i]
    memory = fleet.memory[i]
    distance, energy = fleet.distance[i], fleet.energy[i]
    obstacles_move = TICK_S * arenas.tour_speed[i]
    room = 0.0
    calm = (0.0, 0.0, 0.0)
    left = lag(airframe, TICK_S)
    for _ in range(ticks):
        if time_us >= fleet.repeat_us[i]:
            c, s = heading_of(q)
            forward, right = fleet.setpoint[i, 0], fleet.setpoint[i, 1]
            fleet.velocity_ned[i, 0] = c * forward - s * right
            fleet.velocity_ned[i, 1] = s * forward + c * right
            fleet.velocity_ned[i, 2] = fleet.setpoint[i, 2]
            fleet.repeat_us[i] += REPEAT_US
        wanted = (fleet.velocity_ned[i, 0], fleet.velocity_ned[i, 1], fleet.velocity_ned[i, 2])
        demand = Demand(NAN3, wanted, math.nan, fleet.setpoint[i, 3])
        motors = cascade_tick(p, v, q, w, demand, memory, gains, weights, TICK_S).motors
        s0 = settle(s0, motors[0], airframe, left)
        s1 = settle(s1, motors[1], airframe, left)
        s2 = settle(s2, motors[2], airframe, left)
        s3 = settle(s3, motors[3], airframe, left)
        thrust, torque = wrench(s0, s1, s2, s3, airframe)
        lift = rotate(q, (0.0, 0.0, -thrust))
        drag = drag_force(v, calm, airframe)
        force = (lift[0] + drag[0], lift[1] + drag[1], lift[2] + drag[2])
        k = airframe.drag_angular
        damped = (torque[0] - k * w[0], torque[1] - k * w[1], torque[2] - k * w[2])
        before, moved_from = v, p
        p, v, q, w = step(p, v, q, w, force, damped, airframe, TICK_S)
        accel = (
            (v[0] - before[0]) / TICK_S,
            (v[1] - before[1]) / TICK_S,
            (v[2] - before[2]) / TICK_S,
        )
        power = power_w(v, accel, calm, vehicle.payload_g, vehicle.power)
        energy += TICK_S * power
        rest_v = open_circuit(battery, pack.empty_v, pack.full_v)
        current = power / terminal_voltage(rest_v, pack.resistance_ohm, power)
        battery = drain(battery, current, pack.capacity_mah, TICK_S)
        moved = math.sqrt(
            (p[0] - moved_from[0]) ** 2 + (p[1] - moved_from[1]) ** 2 + (p[2] - moved_from[2]) ** 2
        )
        distance += moved
        time_us += TICK_US
        # Nothing is touched before vehicle and obstacles have moved as far as they were apart.
        room -= moved + obstacles_move
        hit = NOTHING
        if room < _ROUNDING_M:
            room, hit = _contact(arenas, i, p, time_us, vehicle)
        fleet.touched[i] = hit
        if (p[0] - goal_north) ** 2 + (p[1] - goal_east) ** 2 < rules.goal_radius**2:
            fleet.verdict[i] = _SUCCESS
        elif hit != NOTHING:
            fleet.verdict[i] = _COLLISION
        elif battery <= 0.0:
            fleet.verdict[i] = _BATTERY
        elif time_us >= rules.time_limit_us:
            fleet.verdict[i] = _TIMEOUT
        else:
            continue
        break
    move_obstacles(arenas, i, time_us)
    for axis in range(3):
        fleet.position[i, axis] = p[axis]
        fleet.velocity[i, axis] = v[axis]
        fleet.omega[i, axis] = w[axis]
    for axis in range(4):
        fleet.quaternion[i, axis] = q[axis]
    fleet.rotor[i, 0], fleet.rotor[i, 1], fleet.rotor[i, 2], fleet.rotor[i, 3] = s0, s1, s2, s3
    fleet.time_us[i] = time_us
    fleet.distance[i] = distance
    fleet.energy[i] = energy
    fleet.battery[i] = battery

"""The batch twin: N vehicles with the full rigid body and cascade at 250 Hz, one call a decision.

The same kernels as the rehearsal (`airl_mav.vehicle`, `airl_mav.control`), without estimator and
MAVLink: control sees the true state. A setpoint in the heading frame is turned into NED when it
arrives and again at each of MAVSDK's 20 Hz repeats, as PX4 does it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.constants import GRAVITY_M_S2, TICK_S, TICK_US
from airl_mav.control.cascade import Demand, cascade, new_memory
from airl_mav.control.gains import Gains
from airl_mav.envs.arenas import ArenaBatch, move_obstacles
from airl_mav.envs.contact import NOTHING, touches
from airl_mav.kernels import kernel
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.power import Coefficients, coefficients, power_w
from airl_mav.vehicle.rigid_body import drag_force, step
from airl_mav.vehicle.rotation import Vec, rotate, yaw_of
from airl_mav.vehicle.rotor import spin, wrench

REPEAT_US = 50_000
"""MAVSDK repeats the newest setpoint at 20 Hz [µs]."""

NAN3: Vec = (math.nan, math.nan, math.nan)


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
    touched: NDArray[np.int64]  # (n,) first contact: obstacle, FLOOR, WALL, or NOTHING


class Vehicle(NamedTuple):
    """The constants that all vehicles of a fleet share."""

    airframe: Airframe
    gains: Gains
    power: Coefficients
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
    return Vehicle(
        airframe=Airframe.from_profile(profile),
        gains=Gains.from_parameters(parameter),
        power=coefficients(profile.power),
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
        touched=np.full(n, NOTHING, np.int64),
    )


def hover(fleet: Fleet, i: int, altitude_m: float, vehicle: Vehicle) -> None:
    """Put vehicle i into a hover above the origin, heading north, all counters at zero."""
    for array in fleet:
        array[i] = 0
    fleet.position[i, 2] = -altitude_m
    fleet.quaternion[i, 0] = 1.0
    a = vehicle.airframe
    fleet.rotor[i] = math.sqrt(a.mass * GRAVITY_M_S2 / (4.0 * a.thrust_max))
    fleet.touched[i] = NOTHING


@kernel
def advance(fleet: Fleet, arenas: ArenaBatch, ticks: NDArray[np.int64], vehicle: Vehicle) -> None:
    """Fly every vehicle that has touched nothing for its number of `ticks` (n,) on its setpoint.

    A setpoint that was changed since the last call takes effect at once: set `repeat_us` to the
    vehicle's time to have it turned into NED by the present heading.
    """
    for i in range(len(fleet.time_us)):
        if fleet.touched[i] == NOTHING:
            _fly(fleet, arenas, i, ticks[i], vehicle)


@kernel
def _fly(fleet: Fleet, arenas: ArenaBatch, i: int, ticks: int, vehicle: Vehicle) -> None:
    airframe, gains = vehicle.airframe, vehicle.gains
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
    distance, energy = 0.0, 0.0
    moving = arenas.n_obstacles[i] > arenas.n_static[i]
    calm = (0.0, 0.0, 0.0)
    for _ in range(ticks):
        if time_us >= fleet.repeat_us[i]:
            yaw = yaw_of(q)
            c, s = math.cos(yaw), math.sin(yaw)
            forward, right = fleet.setpoint[i, 0], fleet.setpoint[i, 1]
            fleet.velocity_ned[i, 0] = c * forward - s * right
            fleet.velocity_ned[i, 1] = s * forward + c * right
            fleet.velocity_ned[i, 2] = fleet.setpoint[i, 2]
            fleet.repeat_us[i] += REPEAT_US
        wanted = (fleet.velocity_ned[i, 0], fleet.velocity_ned[i, 1], fleet.velocity_ned[i, 2])
        demand = Demand(NAN3, wanted, math.nan, fleet.setpoint[i, 3])
        motors = cascade(p, v, q, w, demand, memory, gains, TICK_S).motors
        s0 = spin(s0, motors[0], airframe, TICK_S)
        s1 = spin(s1, motors[1], airframe, TICK_S)
        s2 = spin(s2, motors[2], airframe, TICK_S)
        s3 = spin(s3, motors[3], airframe, TICK_S)
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
        energy += TICK_S * power_w(v, accel, calm, vehicle.payload_g, vehicle.power)
        distance += math.sqrt(
            (p[0] - moved_from[0]) ** 2 + (p[1] - moved_from[1]) ** 2 + (p[2] - moved_from[2]) ** 2
        )
        time_us += TICK_US
        if moving:
            move_obstacles(arenas, i, time_us)
        hit = touches(
            p,
            vehicle.radius,
            vehicle.half_height,
            arenas.bounds[i],
            arenas.n_obstacles[i],
            arenas.shape[i],
            arenas.center[i],
            arenas.half_size[i],
            arenas.yaw[i],
        )
        if hit != NOTHING:
            fleet.touched[i] = hit
            break
    for axis in range(3):
        fleet.position[i, axis] = p[axis]
        fleet.velocity[i, axis] = v[axis]
        fleet.omega[i, axis] = w[axis]
    for axis in range(4):
        fleet.quaternion[i, axis] = q[axis]
    fleet.rotor[i, 0], fleet.rotor[i, 1], fleet.rotor[i, 2], fleet.rotor[i, 3] = s0, s1, s2, s3
    fleet.time_us[i] = time_us
    fleet.distance[i] += distance
    fleet.energy[i] += energy

"""How the batch twin flies: every vehicle's rigid body and cascade at 250 Hz, one compiled call.

The same kernels as the rehearsal (`airl_mav.vehicle`, `airl_mav.control`), without estimator and
MAVLink: control sees the true state. A setpoint in the heading frame is turned into NED when it
arrives and again at each of MAVSDK's 20 Hz repeats, as PX4 does it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.attitude import heading_of
from airl_mav.control.cascade import Filters, cascade_tick, filters
from airl_mav.control.demand import Demand
from airl_mav.core.constants import TICK_S, TICK_US
from airl_mav.core.kernels import kernel
from airl_mav.envs.arenas import ArenaBatch, move_obstacles
from airl_mav.envs.contact import NOTHING, clearance, touches
from airl_mav.envs.fleet import STILL, Fleet, Rules, Vehicle, Verdict
from airl_mav.vehicle.airframe import airframe_of
from airl_mav.vehicle.battery import drain, open_circuit, terminal_voltage
from airl_mav.vehicle.power import felt, felt_share, flight_power_w
from airl_mav.vehicle.rigid_body import drag_force, step
from airl_mav.vehicle.rotation import Vec, rotate
from airl_mav.vehicle.rotor import lag, settle, wrench

REPEAT_US = 50_000
"""MAVSDK repeats the newest setpoint at 20 Hz [µs]."""

_ROUNDING_M = 1e-6
"""Distances are this exact, and far more."""

NAN3: Vec = (math.nan, math.nan, math.nan)

_FLYING = int(Verdict.FLYING)
_SUCCESS = int(Verdict.SUCCESS)
_COLLISION = int(Verdict.COLLISION)
_BATTERY = int(Verdict.BATTERY)
_TIMEOUT = int(Verdict.TIMEOUT)


@kernel
def advance(
    fleet: Fleet,
    arenas: ArenaBatch,
    ticks: NDArray[np.int64],
    vehicle: Vehicle,
    rules: Rules,
    air: NDArray[np.float64] | None,
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
        air: (n, k, 3) wind NED [m/s]; of the k rows each tick since the start of a flight takes the
            next, after the last one the first again. None: calm, compiled without any wind.
    """
    weights = filters(vehicle.gains, TICK_S)
    for i in range(len(fleet.time_us)):
        if fleet.verdict[i] == _FLYING:
            if air is None:
                _fly(fleet, arenas, i, ticks[i], vehicle, rules, None, weights)
            else:
                _fly(fleet, arenas, i, ticks[i], vehicle, rules, air[i], weights)


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
    air: NDArray[np.float64] | None,
    weights: Filters,
) -> None:
    airframe, gains, pack = airframe_of(fleet.airframe[i]), vehicle.gains, vehicle.pack
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
    acceleration = (fleet.felt[i, 0], fleet.felt[i, 1], fleet.felt[i, 2])
    time_us = fleet.time_us[i]
    memory = fleet.memory[i]
    distance, energy = fleet.distance[i], fleet.energy[i]
    obstacles_move = TICK_S * arenas.tour_speed[i]
    room = 0.0
    wind = STILL
    left, kept = lag(airframe, TICK_S), felt_share(vehicle.power, TICK_S)
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
        if air is not None:
            row = time_us // TICK_US % len(air)
            wind = (air[row, 0], air[row, 1], air[row, 2])
        drag = drag_force(v, wind, airframe)
        force = (lift[0] + drag[0], lift[1] + drag[1], lift[2] + drag[2])
        k = airframe.drag_angular
        damped = (torque[0] - k * w[0], torque[1] - k * w[1], torque[2] - k * w[2])
        # Of the state in which this tick's forces act, as the drag; and so it is worked out beside
        # the step, not after it, which is a tenth of the twin's speed.
        power = flight_power_w(thrust, v, q, wind, acceleration, airframe, vehicle.power)
        before, moved_from = v, p
        p, v, q, w = step(p, v, q, w, force, damped, airframe, TICK_S)
        acceleration = felt(acceleration, before, v, kept, TICK_S, vehicle.power)
        energy += TICK_S * power
        rest_v = open_circuit(battery, pack.empty_v, pack.full_v)
        load = power + vehicle.computer_w
        current = load / terminal_voltage(rest_v, pack.resistance_ohm, load)
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
        fleet.felt[i, axis] = acceleration[axis]
    for axis in range(4):
        fleet.quaternion[i, axis] = q[axis]
    fleet.rotor[i, 0], fleet.rotor[i, 1], fleet.rotor[i, 2], fleet.rotor[i, 3] = s0, s1, s2, s3
    fleet.time_us[i] = time_us
    fleet.distance[i] = distance
    fleet.energy[i] = energy
    fleet.battery[i] = battery

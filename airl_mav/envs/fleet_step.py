"""Flight dynamics of the vectorized simulator: rigid body and cascade at 250 Hz, compiled.

Uses the rehearsal's kernels (`airl_mav.vehicle`, `airl_mav.control`), without estimator and
MAVLink: control uses the true state. A setpoint in the heading frame is converted to NED when it
arrives and again at each of MAVSDK's 20 Hz repeats, as in PX4.

`LANES` vehicles are simulated together; when one has completed its ticks or its flight, the next
takes its lane. Function calls without a vector form, and rare cases, are in separate loops between
the vectorized ones.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from airl_mav.control import cascade, loops
from airl_mav.control.demand import Demand, Gains
from airl_mav.control.memory import (
    ATTITUDE_SP,
    FOLLOWS,
    MEMORY_SIZE,
    RATES_SP,
    SAT,
    THRUST_ON,
    THRUST_SP,
    VELOCITY_SP,
    WAIT,
    YAW_RATE_SP,
)
from airl_mav.core.constants import TICK_S, TICK_US
from airl_mav.core.kernels import borrowing_kernel, kernel, large_kernel
from airl_mav.envs import arena_batch
from airl_mav.envs.decision import DecisionBatch, FrameTimes, Timing, new_decision, next_stretch
from airl_mav.envs.fleet import (
    AIRFRAME,
    AIRFRAME_SIZE,
    ATTITUDE,
    BATTERY,
    BY_RATES,
    COLLECTIVE,
    DISTANCE,
    ENERGY,
    FELT,
    FIRST,
    FITS,
    HALF_TURN,
    LANES,
    MEMORY,
    MOTORS,
    MOVED,
    POSITION,
    PUBLISHED,
    PUBLISHED_THRUST,
    PUBLISHED_YAW_RATE,
    RATES,
    REDUCED,
    ROTOR,
    ROTOR_LEFT,
    ROWS,
    TORQUE,
    VELOCITY,
    WANTED,
    WIND,
    YAW_RATE,
    Fleet,
    FleetConstants,
    FlightStatus,
    Rules,
    State,
    load,
    quat,
    unload,
    vec,
)
from airl_mav.vehicle.airframe import airframe_of, drag_force, settle, step, wrench
from airl_mav.vehicle.power import (
    drain,
    felt,
    felt_share,
    flight_power_w,
    open_circuit,
    terminal_voltage,
)
from airl_mav.vehicle.rotation import Vec, rotate

REPEAT_US = 50_000
"""Interval of MAVSDK's setpoint repeats, 20 Hz [µs]."""

_ROUNDING_M = 1e-6
"""Upper bound of rounding errors in distances [m]."""

NAN3: Vec = (math.nan, math.nan, math.nan)

_NOBODY = -1
"""Marker of an empty lane."""

_FLYING = int(FlightStatus.FLYING)
_SUCCESS = int(FlightStatus.SUCCESS)
_COLLISION = int(FlightStatus.COLLISION)
_BATTERY = int(FlightStatus.BATTERY)
_TIMEOUT = int(FlightStatus.TIMEOUT)


def advance(
    fleet: Fleet,
    arenas: arena_batch.ArenaBatch,
    ticks: NDArray[np.int64],
    vehicle: FleetConstants,
    rules: Rules,
    air: NDArray[np.float64] | None,
) -> None:
    """Fly every vehicle with verdict FLYING for its number of ticks on its setpoint.

    A flight ends in the tick that decides it, and its `time_us` remains at that tick. Tests and
    their order match the referee (`flight.judge`): goal, collision, battery, time limit.

    A setpoint changed since the last call takes effect at once: set `repeat_us` to the vehicle's
    time to convert it to NED with the present heading.

    Args:
        fleet: Updated in place.
        arenas: One per vehicle; the moving obstacles' centres are updated in place.
        ticks: (n,) number of ticks to fly.
        vehicle: Constants shared by all vehicles.
        rules: End conditions.
        air: (n, k, 3) wind NED [m/s]; ticks since the start of a flight use the k rows in turn,
            cyclically. None, or k = 0: calm.
    """
    n, never = len(ticks), np.zeros((0, 3), np.int64)
    # A decision without events, so that `fly` only counts ticks.
    timing = Timing(False, 0, 0, -1, -1, 0.0, never, FrameTimes(np.zeros(n, np.int64), 1, 0, never))
    nothing = new_decision(timing, np.zeros((n, 9)))
    todo = np.where(fleet.verdict == _FLYING, ticks, 0)
    fly(
        *(fleet, arenas, todo, vehicle, rules),
        np.zeros((n, 0, 3)) if air is None else air,
        nothing,
    )
    arena_batch.move_all_obstacles(arenas, fleet.time_us)


@large_kernel
def fly(
    fleet: Fleet,
    arenas: arena_batch.ArenaBatch,
    todo: NDArray[np.int64],
    vehicle: FleetConstants,
    rules: Rules,
    air: NDArray[np.float64],
    decision: DecisionBatch,
) -> None:
    """Fly vehicles as in `advance`, `LANES` at a time, where `todo` is not 0; it becomes 0.

    A vehicle whose decision has events flies until its end, or until Python is needed; other
    vehicles fly `todo` ticks. Obstacles are only moved for contact checks.
    """
    weights, kept = cascade.filters(vehicle.gains, TICK_S), felt_share(vehicle.power, TICK_S)
    # Allocated here with constant sizes, so that the compiler knows that rows do not overlap.
    state, spare = np.zeros((ROWS, LANES)), np.zeros((MEMORY_SIZE, LANES))
    who, left = np.full(LANES, _NOBODY), np.zeros(LANES, np.int64)
    # Vehicles whose position loops are due at the same ticks share lanes: the loop runs for all.
    coming, odd = np.zeros(2, np.int64), 0
    while True:
        aloft = _fill(fleet, decision, todo, coming, odd, who, left, state)
        if aloft == 0:
            return
        for j in range(LANES):
            i = who[j]
            if i != _NOBODY:
                # Repeats come before the loops, as a setpoint acts in the tick of its arrival.
                if fleet.time_us[i] >= fleet.repeat_us[i]:
                    _repeat(fleet, i, state, j)
                if air.shape[1] > 0:
                    _blow(air[i], fleet.time_us[i], state, j)
        by_rates = _outer_loops(state, spare, who, aloft, vehicle.gains, weights)
        if by_rates:
            _prepare_rates(state, who)
        _inner_loops(state, who, vehicle.gains, weights)
        if by_rates:
            _keep_rates(state, who)
        # Position loops are due at every second tick, so the search alternates.
        odd ^= 1
        _move(state, vehicle, kept)
        for j in range(LANES):
            i = who[j]
            if i != _NOBODY:
                here, hit = vec(state, POSITION, j), arena_batch.NOTHING
                # Same order as `flight.judge`: move, contact, verdict.
                fleet.time_us[i] += TICK_US
                # Contact is impossible until the combined motion exceeds the clearance.
                fleet.room[i] -= state[MOVED, j] + TICK_S * arenas.tour_speed[i]
                if fleet.room[i] < _ROUNDING_M:
                    fleet.room[i], hit = _contact(arenas, i, here, fleet.time_us[i], vehicle)
                fleet.touched[i] = hit
                goal = arenas.goal[i, 0], arenas.goal[i, 1], arenas.goal[i, 2]
                fleet.verdict[i] = _verdict(
                    here, goal, hit, state[BATTERY, j], fleet.time_us[i], rules
                )
                # An ended flight leaves its lane.
                left[j] = left[j] - 1 if fleet.verdict[i] == _FLYING else 0


@borrowing_kernel
def _fill(
    fleet: Fleet,
    decision: DecisionBatch,
    todo: NDArray[np.int64],
    coming: NDArray[np.int64],
    odd: int,
    who: NDArray[np.int64],
    left: NDArray[np.int64],
    state: State,
) -> int:
    """Continue vehicles in their lanes, or fill lanes with others; return the number of vehicles.

    Arguments as in `_next` and `fly`, and for all lanes the vehicle and its remaining ticks.
    """
    aloft = 0
    for j in range(len(who)):
        while who[j] == _NOBODY or left[j] == 0:
            if who[j] != _NOBODY:
                left[j] = next_stretch(decision, fleet, who[j], state, j)
                if left[j] == 0:
                    unload(fleet, who[j], state, j)
                    who[j] = _NOBODY
                continue
            # First a vehicle with the same parity, then any other.
            i = _next(todo, fleet.memory, odd, coming)
            if i == _NOBODY:
                i = _next(todo, fleet.memory, odd ^ 1, coming)
            if i == _NOBODY:
                break
            load(fleet, i, state, j)
            # A vehicle with events gets its ticks from `next_stretch`.
            who[j], left[j], todo[i] = i, 0 if decision.events[i] > 0 else todo[i], 0
        aloft += who[j] != _NOBODY
    return aloft


@borrowing_kernel
def _next(
    todo: NDArray[np.int64],
    memory: NDArray[np.float64],
    odd: int,
    coming: NDArray[np.int64],
) -> int:
    """Return the next waiting vehicle whose position loop is due now; `_NOBODY` without one.

    With `odd` = 1, the loop is due a tick later. `coming` (2,) holds the search position for both.
    """
    while coming[odd] < len(todo):
        i: int = coming[odd]
        coming[odd] += 1
        if todo[i] > 0 and (memory[i, WAIT] != 0.0) == (odd == 1):
            return i
    return _NOBODY


@borrowing_kernel
def _repeat(fleet: Fleet, i: int, state: State, j: int) -> None:
    """Convert the setpoint of vehicle i, in lane j, to NED with the present heading.

    Body rates are unchanged.
    """
    fleet.repeat_us[i] += REPEAT_US
    if fleet.by_rates[i]:
        for axis in range(3):
            state[WANTED + axis, j] = fleet.setpoint[i, axis]
        return
    c, s = loops.heading_of(quat(state, ATTITUDE, j))
    forward, right = fleet.setpoint[i, 0], fleet.setpoint[i, 1]
    fleet.velocity_ned[i, 0] = c * forward - s * right
    fleet.velocity_ned[i, 1] = s * forward + c * right
    fleet.velocity_ned[i, 2] = fleet.setpoint[i, 2]
    for axis in range(3):
        state[WANTED + axis, j] = fleet.velocity_ned[i, axis]


@borrowing_kernel
def _blow(air: NDArray[np.float64], time_us: int, state: State, j: int) -> None:
    """Write the wind of a tick, from a vehicle's rows `air` (k, 3), to lane j."""
    row = time_us // TICK_US % len(air)
    for axis in range(3):
        state[WIND + axis, j] = air[row, axis]


@kernel
def _outer_loops(
    state: State,
    spare: NDArray[np.float64],
    who: NDArray[np.int64],
    aloft: int,
    gains: Gains,
    weights: cascade.Filters,
) -> bool:
    """Run the first half of `cascade_tick` in every lane, up to the attitude loop's setpoint.

    `spare` (MEMORY_SIZE, LANES) is a buffer, `who` (LANES,) the vehicle in each lane or `_NOBODY`,
    `aloft` the number of vehicles, `weights` is `filters(gains, TICK_S)`. Return True if any lane
    has body rate commands; such lanes only update a filter.
    """
    due, by_rates = 0, 0
    for j in range(state.shape[1]):
        memory = state[MEMORY:ROWS, j]
        by_rates += who[j] != _NOBODY and state[BY_RATES, j] != 0.0
        first = cascade.start(vec(state, VELOCITY, j), vec(state, RATES, j), memory, weights)
        state[FIRST, j] = 1.0 if first else 0.0
        due += who[j] != _NOBODY and memory[WAIT] == 0.0
        _publish(state, j)
    if due > 0:
        # Run in all lanes to vectorize; lanes that are not due are restored afterwards.
        kept = due < aloft or by_rates > 0
        if kept:
            for row in range(MEMORY_SIZE):
                for j in range(state.shape[1]):
                    spare[row, j] = state[MEMORY + row, j]
        for j in range(state.shape[1]):
            demand = Demand(NAN3, vec(state, WANTED, j), math.nan, state[YAW_RATE, j])
            p, v, q = vec(state, POSITION, j), vec(state, VELOCITY, j), quat(state, ATTITUDE, j)
            cascade.position_loop(p, v, q, demand, state[MEMORY:ROWS, j], gains, weights, TICK_S)
        for j in range(state.shape[1]):
            if state[MEMORY + WAIT, j] != 0.0:
                if kept:
                    _restore(state, spare, j)
            elif state[BY_RATES, j] != 0.0:
                _restore(state, spare, j)
                # Body rates skip the position loop, but its velocity filter must not stop.
                velocity, period = vec(state, VELOCITY, j), cascade.POSITION_TICKS * TICK_S
                cascade.differentiate(velocity, state[MEMORY:ROWS, j], weights, period)
                state[MEMORY + WAIT, j] = cascade.POSITION_TICKS
            else:
                state[MEMORY + WAIT, j] = cascade.POSITION_TICKS
                # In the first tick the inner loops use the setpoint of this tick.
                if state[FIRST, j] != 0.0:
                    _publish(state, j)
    return by_rates > 0


@kernel
def _restore(state: State, spare: NDArray[np.float64], j: int) -> None:
    """Restore the memory of lane j."""
    for row in range(MEMORY_SIZE):
        state[MEMORY + row, j] = spare[row, j]


@kernel
def _inner_loops(
    state: State, who: NDArray[np.int64], gains: Gains, weights: cascade.Filters
) -> None:
    """Run the second half of `cascade_tick` in every lane, up to the motor commands.

    Arguments as in `_outer_loops`.
    """
    for j in range(state.shape[1]):
        q, q_sp = quat(state, ATTITUDE, j), quat(state, PUBLISHED, j)
        reduced, state[HALF_TURN, j] = loops.reduced_attitude(q, q_sp)
        for k in range(4):
            state[REDUCED + k, j] = reduced[k]
        state[MEMORY + WAIT, j] -= 1.0
    for j in range(state.shape[1]):
        # A separate loop: `weighted_turn` calls functions without a vector form.
        state[HALF_TURN, j] = loops.weighted_turn(state[HALF_TURN, j], gains)
    for j in range(state.shape[1]):
        memory, reduced = state[MEMORY:ROWS, j], quat(state, REDUCED, j)
        yaw_rate = state[PUBLISHED_YAW_RATE, j]
        wanted = loops.rates_towards(
            quat(state, ATTITUDE, j), reduced, state[HALF_TURN, j], yaw_rate, gains
        )
        first = state[FIRST, j] != 0.0
        rates_sp, collective = cascade.hand_over(wanted, state[PUBLISHED_THRUST, j], first, memory)
        omega = vec(state, RATES, j)
        torque = cascade.torque_setpoint(omega, rates_sp, memory, gains, weights, TICK_S)
        motors, fits = loops.allocate(collective, torque, gains)
        state[FITS, j], state[COLLECTIVE, j] = 1.0 if fits else 0.0, collective
        for axis in range(3):
            state[TORQUE + axis, j] = torque[axis]
            memory[SAT + axis] = 0.0
        for k in range(4):
            state[MOTORS + k, j] = motors[k]
    # Desaturation is rare and not vectorized.
    for j in range(state.shape[1]):
        if state[FITS, j] == 0.0 and who[j] != _NOBODY:
            motors, missing = loops.desaturate(state[COLLECTIVE, j], vec(state, TORQUE, j), gains)
            for axis in range(3):
                state[MEMORY + SAT + axis, j] = missing[axis]
            for k in range(4):
                state[MOTORS + k, j] = motors[k]


@kernel
def _prepare_rates(state: State, who: NDArray[np.int64]) -> None:
    """Set the rate loop's setpoint to the command, for body rates, as in `rate_tick`.

    The rate loop uses the previously published setpoint, which is the command here.
    """
    for j in range(state.shape[1]):
        if who[j] != _NOBODY and state[BY_RATES, j] != 0.0:
            for axis in range(3):
                state[MEMORY + RATES_SP + axis, j] = state[WANTED + axis, j]
            state[MEMORY + THRUST_ON, j] = state[YAW_RATE, j]
            state[FIRST, j] = 0.0


@kernel
def _keep_rates(state: State, who: NDArray[np.int64]) -> None:
    """Update the memory as in `rate_tick`, for body rate commands."""
    for j in range(state.shape[1]):
        if who[j] != _NOBODY and state[BY_RATES, j] != 0.0:
            for axis in range(3):
                state[MEMORY + RATES_SP + axis, j] = state[WANTED + axis, j]
                state[MEMORY + VELOCITY_SP + axis, j] = math.nan
            for k in range(4):
                state[MEMORY + ATTITUDE_SP + k, j] = state[ATTITUDE + k, j]
            state[MEMORY + YAW_RATE_SP, j] = state[MEMORY + FOLLOWS, j] = 0.0
            state[MEMORY + THRUST_SP, j] = state[MEMORY + THRUST_ON, j] = state[YAW_RATE, j]


@kernel
def _publish(state: State, j: int) -> None:
    """Store the setpoints of the inner loops for this tick."""
    q_sp, yaw_rate, thrust = cascade.attitude_sp(state[MEMORY:ROWS, j])
    for k in range(4):
        state[PUBLISHED + k, j] = q_sp[k]
    state[PUBLISHED_YAW_RATE, j], state[PUBLISHED_THRUST, j] = yaw_rate, thrust


@kernel
def _move(state: State, vehicle: FleetConstants, kept: float) -> None:
    """Move the body in every lane by a tick; `kept` is `felt_share` of a tick."""
    pack = vehicle.pack
    for j in range(state.shape[1]):
        p, v = vec(state, POSITION, j), vec(state, VELOCITY, j)
        q, w = quat(state, ATTITUDE, j), vec(state, RATES, j)
        airframe = airframe_of(state[AIRFRAME : AIRFRAME + AIRFRAME_SIZE, j])
        motors, speeds = quat(state, MOTORS, j), quat(state, ROTOR, j)
        # Rotor speeds follow the motor commands with a first-order lag.
        s0 = settle(speeds[0], motors[0], airframe, state[ROTOR_LEFT, j])
        s1 = settle(speeds[1], motors[1], airframe, state[ROTOR_LEFT, j])
        s2 = settle(speeds[2], motors[2], airframe, state[ROTOR_LEFT, j])
        s3 = settle(speeds[3], motors[3], airframe, state[ROTOR_LEFT, j])
        thrust, torque = wrench(s0, s1, s2, s3, airframe)
        # Thrust acts along the body's z axis, upwards (FRD).
        lift = rotate(q, (0.0, 0.0, -thrust))
        wind = vec(state, WIND, j)
        drag = drag_force(v, wind, airframe)
        force = (lift[0] + drag[0], lift[1] + drag[1], lift[2] + drag[2])
        # Rotational drag of the body.
        k = airframe.drag_angular
        damped = (torque[0] - k * w[0], torque[1] - k * w[1], torque[2] - k * w[2])
        # Power at the start of the tick, as for the drag.
        acceleration = vec(state, FELT, j)
        power = flight_power_w(thrust, v, q, wind, acceleration, airframe, vehicle.power)
        p_new, v_new, q_new, w_new = step(p, v, q, w, force, damped, airframe, TICK_S)
        acceleration = felt(acceleration, v, v_new, kept, TICK_S, vehicle.power)
        x, y, z = p_new[0] - p[0], p_new[1] - p[1], p_new[2] - p[2]
        moved = math.sqrt(x**2 + y**2 + z**2)
        # Battery: voltage under load, then the charge that the current drains.
        rest_v = open_circuit(state[BATTERY, j], pack.empty_v, pack.full_v)
        load_w = power + vehicle.computer_w
        current = load_w / terminal_voltage(rest_v, pack.resistance_ohm, load_w)
        state[BATTERY, j] = drain(state[BATTERY, j], current, pack.capacity_mah, TICK_S)
        state[ENERGY, j] += TICK_S * power
        state[MOVED, j] = moved
        state[DISTANCE, j] += moved
        for axis in range(3):
            state[POSITION + axis, j] = p_new[axis]
            state[VELOCITY + axis, j] = v_new[axis]
            state[RATES + axis, j] = w_new[axis]
            state[FELT + axis, j] = acceleration[axis]
        for axis in range(4):
            state[ATTITUDE + axis, j] = q_new[axis]
        state[ROTOR, j], state[ROTOR + 1, j] = s0, s1
        state[ROTOR + 2, j], state[ROTOR + 3, j] = s2, s3


@kernel
def _verdict(here: Vec, goal: Vec, hit: int, battery: float, time_us: int, rules: Rules) -> int:
    """Return the verdict after a tick."""
    # Takes no fleet argument: reference counting of its arrays would take longer than a tick.
    away = (here[0] - goal[0]) ** 2 + (here[1] - goal[1]) ** 2
    if not math.isnan(goal[2]):
        away += (here[2] - goal[2]) ** 2
    if away < rules.goal_radius**2:
        return _SUCCESS
    if hit != arena_batch.NOTHING:
        return _COLLISION
    if battery <= 0.0:
        return _BATTERY
    return _TIMEOUT if time_us >= rules.time_limit_us else _FLYING


@kernel
def _contact(
    arenas: arena_batch.ArenaBatch, i: int, position: Vec, time_us: int, vehicle: FleetConstants
) -> tuple[float, int]:
    """Return a lower bound of vehicle i's clearance [m], and the touched object."""
    arena_batch.move_obstacles(arenas, i, time_us)
    bounds, count = arenas.bounds[i], arenas.n_obstacles[i]
    shape, center = arenas.shape[i], arenas.center[i]
    half_size, yaw = arenas.half_size[i], arenas.yaw[i]
    radius, half_height = vehicle.radius, vehicle.half_height
    relief = arena_batch.relief_of(arenas, i)
    room = arena_batch.clearance(
        position, radius, half_height, bounds, count, center, half_size, relief
    )
    # The exact test runs only where the lower bound permits a contact.
    if room > _ROUNDING_M:
        return room, arena_batch.NOTHING
    return room, arena_batch.touches(
        position, radius, half_height, bounds, count, shape, center, half_size, yaw, relief
    )

"""Planner: an expert that uses the true arena, including the tours of moving obstacles.

Only the vectorized simulator provides this information. The planner is a teacher for imitation
learning (`addons.imitation`), not a flight policy.

At the start of an episode it computes a map of the time to the goal (`Map`). A decision evaluates
actions of the set: each is simulated with the vehicle profile's response, to the end of its hold,
then straight on for a while, then braking to a stop, against the predicted positions of obstacles.
The collision-free action with the minimum time to the goal wins (a dynamic window approach: Fox,
Burgard, Thrun, IEEE Robotics & Automation Magazine 4(1), 1997).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from airl_mav.arena.geometry import TOP, Shape
from airl_mav.arena.relief import extreme_within
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import quats_to_euler
from airl_mav.core.kernels import kernel
from airl_mav.envs.arena_batch import ArenaBatch, relief_of
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import Delay
from airl_mav.latency.injection import Injection
from airl_mav.policy.planner_kernels import interpolated

CELLS = 125
"""Maximum number of map cells along an arena's longer side."""

FINEST_M = 0.4
"""Minimum side of a cell [m]."""

COMFORT_M = 1.2
"""Gap to static obstacles from which on the map allows full speed [m]."""

SLOWEST = 0.25
"""Relative speed on the map at zero gap."""

BLOCKED = 0.02
"""Relative speed on the map inside obstacles: small, so that the way out is still downhill."""

OVER_M = 0.3
"""Vertical margin [m]; obstacles below or above the vehicle by more than this are ignored."""

_BOX = int(Shape.BOX)

FAR = 1e9
"""Upper bound of distances [m] and of path times [s]."""


class Map(NamedTuple):
    """Planning map of an episode's arena; cells are (rows north, columns east)."""

    north: float
    """North coordinate of the first cell's centre [m]."""
    east: float
    cell: float
    """Side of a cell [m]."""
    gap: NDArray[np.float64]
    """Distance from a cell's centre to the nearest static obstacle or hill [m]; negative inside."""
    to_go: NDArray[np.float64]
    """Time to the goal at 1 m/s [s]."""


class PlannerBody(NamedTuple):
    """Vehicle parameters of the planner."""

    radius: float
    half_height: float
    altitude: float
    """Altitude hold height [m]."""
    top_speed: float
    """Maximum speed of the action set [m/s]."""
    arrived: float
    """Goal radius [m]."""


def map_of(batch: ArenaBatch, i: int, body: PlannerBody) -> Map:
    """Return the map of arena i."""
    # Rows run north and columns east, from the south-west corner.
    south, north, west, east = batch.bounds[i, :4]
    cell = max(FINEST_M, max(north - south, east - west) / CELLS)
    shape = math.ceil((north - south) / cell), math.ceil((east - west) / cell)
    gap, to_go = np.empty(shape), np.full(shape, FAR)
    first = south + 0.5 * cell, west + 0.5 * cell
    _fill_gaps(batch, i, body, first, cell, gap)
    most_m = body.altitude - body.half_height - OVER_M
    # Ground below the flight altitude needs no distance.
    if batch.grid[i, TOP] > most_m:
        gap = np.minimum(gap, _to_hills(batch, i, most_m, first, cell, gap.shape))
    _fill_times(gap, body.radius, first, cell, (batch.goal[i, 0], batch.goal[i, 1]), to_go)
    return Map(first[0], first[1], cell, gap, to_go)


@kernel
def beside(
    batch: ArenaBatch, i: int, obstacle: int, body: PlannerBody, north: float, east: float
) -> float:
    """Return the horizontal distance [m] from a position at flight altitude to an obstacle."""
    half_size = batch.half_size[i, obstacle]
    center = batch.center[i, obstacle]
    if abs(-body.altitude - center[2]) > half_size[2] + body.half_height + OVER_M:
        return FAR  # above or below
    dx, dy = north - center[0], east - center[1]
    if batch.shape[i, obstacle] != _BOX:
        gap: float = math.sqrt(dx * dx + dy * dy) - half_size[0]
        return gap
    c, s = math.cos(batch.yaw[i, obstacle]), math.sin(batch.yaw[i, obstacle])
    gx, gy = abs(c * dx + s * dy) - half_size[0], abs(c * dy - s * dx) - half_size[1]
    # Outside: distance to the box; inside: negative depth to the nearest side.
    beside: float = math.sqrt(max(gx, 0.0) ** 2 + max(gy, 0.0) ** 2) + min(0.0, max(gx, gy))
    return beside


def _to_hills(
    batch: ArenaBatch,
    i: int,
    most_m: float,
    first: tuple[float, float],
    cell: float,
    shape: tuple[int, int],
) -> NDArray[np.float64]:
    """Return the distances (rows, columns) [m] to ground above `most_m`; negative inside it.

    Overestimates by at most a quarter of a cell, and underestimates by little more than a cell, due
    to exact Euclidean distances between centres of high and low cells.
    """
    high = np.empty(shape, np.bool_)
    _fill_high(batch, i, most_m, first, cell, high)
    if not high.any():
        return np.full(shape, FAR)
    to_high = scipy.ndimage.distance_transform_edt(~high, sampling=cell)
    to_low = scipy.ndimage.distance_transform_edt(high, sampling=cell)
    # Distances are between cell centres, so the border is half a cell nearer.
    distance: NDArray[np.float64] = to_high - to_low + np.where(high, 0.5, -0.5) * cell
    return distance


@kernel
def _fill_high(
    batch: ArenaBatch,
    i: int,
    most_m: float,
    first: tuple[float, float],
    cell: float,
    high: NDArray[np.bool_],
) -> None:
    """Mark the cells (rows, columns) that reach ground higher than `most_m`, corners included."""
    relief, corner = relief_of(batch, i), cell / math.sqrt(2.0)
    for row in range(high.shape[0]):
        for column in range(high.shape[1]):
            north, east = first[0] + row * cell, first[1] + column * cell
            high[row, column] = extreme_within(relief, north, east, corner, 1.0) > most_m


@kernel
def _fill_gaps(
    batch: ArenaBatch,
    i: int,
    body: PlannerBody,
    first: tuple[float, float],
    cell: float,
    gap: NDArray[np.float64],
) -> None:
    bounds = batch.bounds[i]
    for row in range(gap.shape[0]):
        north = first[0] + row * cell
        for column in range(gap.shape[1]):
            east = first[1] + column * cell
            least = min(
                min(north - bounds[0], bounds[1] - north), min(east - bounds[2], bounds[3] - east)
            )
            for obstacle in range(batch.n_static[i]):
                # Beyond `reach`, from an upper bound of the half diagonal, it is no nearer.
                half, center = batch.half_size[i, obstacle], batch.center[i, obstacle]
                reach = half[0] + half[1] + max(least, 0.0)
                if (north - center[0]) ** 2 + (east - center[1]) ** 2 < reach * reach:
                    least = min(least, beside(batch, i, obstacle, body, north, east))
            gap[row, column] = least


@kernel
def _fill_times(
    gap: NDArray[np.float64],
    radius: float,
    first: tuple[float, float],
    cell: float,
    goal: tuple[float, float],
    to_go: NDArray[np.float64],
) -> None:
    """Solve the eikonal equation outwards from the goal; `to_go` is initialized to `FAR`."""
    rows, columns = gap.shape
    slow = np.empty((rows, columns))
    for row in range(rows):
        for column in range(columns):
            # Speed falls linearly with the gap, so that paths keep away from obstacles.
            room = gap[row, column] - radius
            share = SLOWEST + (1.0 - SLOWEST) * room / COMFORT_M
            slow[row, column] = 1.0 / (BLOCKED if room < 0.0 else min(1.0, share))
    goal_row = min(max(int((goal[0] - first[0]) / cell + 0.5), 0), rows - 1)
    goal_column = min(max(int((goal[1] - first[1]) / cell + 0.5), 0), columns - 1)
    to_go[goal_row, goal_column] = 0.0
    changed = 1.0
    sweep = 0
    # Fast sweeping: four orders of rows and columns, until no cell changes by more than 10 ms.
    while changed > 1e-2 and sweep < 200:
        if sweep % 4 == 0:
            changed = 0.0
        for k in range(rows):
            row = k if sweep % 4 < 2 else rows - 1 - k
            for m in range(columns):
                column = m if sweep % 2 == 0 else columns - 1 - m
                a = min(
                    to_go[row - 1, column] if row > 0 else FAR,
                    to_go[row + 1, column] if row < rows - 1 else FAR,
                )
                b = min(
                    to_go[row, column - 1] if column > 0 else FAR,
                    to_go[row, column + 1] if column < columns - 1 else FAR,
                )
                # Godunov's upwind scheme: one neighbour, or both if their times differ by less than
                # `f`.
                least = min(a, b)
                if least >= FAR:
                    continue
                f = cell * slow[row, column]
                found = least + f
                if abs(a - b) < f:
                    found = 0.5 * (a + b + math.sqrt(2.0 * f * f - (a - b) ** 2))
                if found < to_go[row, column]:
                    changed = max(changed, to_go[row, column] - found)
                    to_go[row, column] = found
        sweep += 1
        # Convergence is tested after a full set of four sweeps.
        if sweep % 4 != 0:
            changed = 1.0


@kernel
def read_at(known: Map, field: NDArray[np.float64], north: float, east: float) -> float:
    """Return a field of the map at a position, by bilinear interpolation."""
    x, y = (north - known.north) / known.cell, (east - known.east) / known.cell
    return interpolated(field, x, y)


STEP_S = 0.1
"""Time step of the prediction [s]."""

AHEAD_S = 2.5
"""Prediction time after the hold [s]."""

STRAIGHT_ON_S = (0.0, 0.5, 1.3, 2.5)
"""Times of straight flight after the hold, before the vehicle brakes [s].

With immediate braking only, the vehicle cannot avoid an obstacle that approaches its stop: among
the 30 moving obstacles of `crowded` it loses a fifth of the flights.
"""

MOST_M_S2 = 6.0
"""Maximum acceleration in the prediction [m/s2]; limits the first-order response."""

LEAST_GAP_M = 0.3
"""Minimum gap [m]; smaller gaps count as a contact."""

WARY_GAP_M = 2.0
"""Gap to a moving obstacle below which a cost applies [m].

Larger than the planner requires, because its students have less information.
"""

WARY = 4.0
"""Cost per second at a gap 1 m below `WARY_GAP_M` [s]."""

TURN_S = 0.4
"""Cost per radian between nose and path [s], unless the camera has a 360 degree view."""

LATENCIES = 64
"""Number of draws for the mean latency."""


class PlannerTiming(NamedTuple):
    """Timing of a decision relative to its observation [s], and the vehicle's response."""

    lead: float
    """Time until the vehicle responds to the new setpoint; the previous one is active before."""
    dead: float
    """Dead time: the part of `lead` after the new setpoint arrives."""
    hold: float
    response: float
    """Time constant of the velocity."""
    turn_response: float
    """Time constant of the yaw rate, modelled as a delay."""
    turn: float
    """Cost per radian between nose and path."""


class Planner:
    """Planner for the flights of a vectorized simulator. Implements `imitation.Chooser`."""

    def __init__(self, navigation: Navigation, commands: NDArray[np.float64]) -> None:
        """Store the flights and the candidate commands (c, 3).

        Raises:
            FieldError: The vehicle's profile has no setpoint response.
        """
        self._navigation = navigation
        self._commands = commands
        response = navigation.vehicle.response
        if response is None:
            raise FieldError(
                "expert",
                "planner",
                problem="the vehicle's profile has no table `response`; scripts/fit-response"
                " identifies it",
            )
        vehicle, spec = navigation.whole_truth().vehicle, navigation.spec
        top = float(np.hypot(commands[:, 0], commands[:, 1]).max())
        rules = spec.episode
        self._body = PlannerBody(
            vehicle.radius, vehicle.half_height, rules.altitude_m, top, rules.goal_radius_m
        )
        lead_us = np.mean([_mean_t2_us(each, spec.delay) for each in navigation.injections])
        lead_us += spec.delay.link_ms * US_PER_MS
        self._timing = PlannerTiming(
            float(lead_us) / US_PER_S + response.dead_time_s,
            response.dead_time_s,
            rules.hold_s,
            response.velocity_time_s,
            response.yaw_rate_time_s,
            # With a view all around, the heading has no cost.
            TURN_S * (spec.camera.of(navigation.vehicle.camera).horizontal_fov_deg < 360.0),
        )
        self._maps: dict[int, Map] = {}

    def begin(self, slots: Sequence[int]) -> None:
        """Compute the maps of episodes that start in slots, or resume after `set_state`."""
        arenas = self._navigation.whole_truth().arenas
        for i in slots:
            self._maps[i] = map_of(arenas, i, self._body)

    def decide(self) -> NDArray[np.int64]:
        """Return the indices (n,) of the commands for the present states."""
        fleet, arenas, _ = self._navigation.whole_truth()
        _, _, yaw = quats_to_euler(fleet.quaternion)
        chosen = np.zeros(self._navigation.n, np.int64)
        for i, known in self._maps.items():
            last, at, going = fleet.setpoint[i], fleet.position[i], fleet.velocity[i]
            chosen[i] = best_command(
                arenas,
                i,
                known,
                self._body,
                self._timing,
                self._commands,
                (last[0], last[1], last[3]),
                (at[0], at[1]),
                (going[0], going[1]),
                float(yaw[i]),
                float(fleet.time_us[i] / US_PER_S),
            )
        return chosen


def _mean_t2_us(injection: Injection, delay: Delay) -> float:
    """Return the mean latency of a decision [µs], from a separate random generator."""
    # A fixed seed: the mean must not depend on the episode.
    sampler = injection.sampler(np.random.default_rng(0))
    if sampler is None:
        return delay.native_ms * US_PER_MS
    return float(np.mean([sampler.sample_us() for _ in range(LATENCIES)]))


@kernel
def _follow_movers(batch: ArenaBatch, i: int, time_s: float, places: NDArray[np.float64]) -> None:
    """Write the predicted positions of moving obstacles: (steps, movers, 2) north, east [m].

    The batch's obstacle centres remain unchanged.
    """
    for j in range(places.shape[1]):
        times, at = batch.tour_times_s[i, j], batch.tour_points[i, j]
        k = 0
        for step in range(places.shape[0]):
            t = (time_s + (step + 1) * STEP_S) % batch.tour_period_s[i, j]
            # Tours are cyclic: after the end the search starts again.
            if times[k] > t:
                k = 0
            while times[k + 1] <= t:
                k += 1
            a = (t - times[k]) / (times[k + 1] - times[k])
            for axis in range(2):
                places[step, j, axis] = at[k, axis] + a * (at[k + 1, axis] - at[k, axis])


@kernel
def _to_movers(
    batch: ArenaBatch,
    i: int,
    body: PlannerBody,
    north: float,
    east: float,
    places: NDArray[np.float64],
) -> float:
    """Return the distance [m] to the nearest moving obstacle at positions `places` (movers, 2).

    Obstacles beyond `WARY_GAP_M` are skipped.
    """
    least = FAR
    for j in range(places.shape[0]):
        obstacle = batch.n_static[i] + j
        dx, dy = north - places[j, 0], east - places[j, 1]
        half = batch.half_size[i, obstacle]
        # An upper bound of the half diagonal: most movers are too far away to matter.
        reach = half[0] + half[1] + body.radius + WARY_GAP_M
        if dx * dx + dy * dy < reach * reach:
            # Shift the vehicle instead of the obstacle.
            x, y = dx + batch.center[i, obstacle, 0], dy + batch.center[i, obstacle, 1]
            least = min(least, beside(batch, i, obstacle, body, x, y))
    return least


@kernel
def best_command(
    batch: ArenaBatch,
    i: int,
    known: Map,
    body: PlannerBody,
    timing: PlannerTiming,
    commands: NDArray[np.float64],
    last: tuple[float, float, float],
    position: tuple[float, float],
    velocity: tuple[float, float],
    yaw: float,
    time_s: float,
) -> int:
    """Return the index of the best of the commands (c, 3) for flight i.

    Args:
        batch: The arenas, with obstacles at their present positions.
        i: Index of the flight.
        known: Map of the flight's arena.
        body: The vehicle.
        timing: Timing of the decision.
        commands: Forward, right [m/s], yaw rate [rad/s].
        last: The command until the decision acts.
        position: North, east [m].
        velocity: North, east [m/s].
        yaw: Heading [rad].
        time_s: Time since the start of the flight [s].
    """
    best, least = 0, math.inf
    # Share of a first-order response in one step.
    share = 1.0 - math.exp(-STEP_S / timing.response)
    turned = timing.lead + timing.hold
    horizon = turned + AHEAD_S
    places = np.empty((int(horizon / STEP_S) + 2, batch.n_obstacles[i] - batch.n_static[i], 2))
    _follow_movers(batch, i, time_s, places)
    # PX4 converts a setpoint with the heading on arrival, a dead time before the response.
    facing = yaw - last[2] * timing.dead
    for c in range(len(commands)):
        for straight_on in STRAIGHT_ON_S:
            x, y, vx, vy, nose = position[0], position[1], velocity[0], velocity[1], facing
            t, step, cost = 0.0, 0, 0.0
            there, looked, ahead = False, timing.turn == 0.0, 0.0
            cn, sn = math.cos(nose), math.sin(nose)
            # Stop early once the cost, with a straight flight to the goal, exceeds the best.
            while t < horizon and cost + t + ahead < least and not there:
                forward, right, rate = commands[c, 0], commands[c, 1], commands[c, 2]
                # Until the new command acts, the vehicle follows the last one.
                if t < timing.lead:
                    forward, right, _ = last
                elif t >= turned + straight_on:
                    forward, right = 0.0, 0.0
                # The yaw rate follows later than the velocity.
                if t < timing.lead + timing.turn_response:
                    rate = last[2]
                elif t >= turned + timing.turn_response:
                    rate = 0.0
                # Once, when the turn has ended: the nose should point along the path.
                if rate == 0.0 and t >= turned and not looked:
                    looked = True
                    cost += timing.turn * _off_the_way(known, x, y, nose)
                if rate != 0.0:
                    cn, sn = math.cos(nose), math.sin(nose)
                ax = (cn * forward - sn * right - vx) * share
                ay = (sn * forward + cn * right - vy) * share
                # Limit the acceleration, keep its direction.
                most = MOST_M_S2 * STEP_S / max(math.sqrt(ax * ax + ay * ay), 1e-9)
                vx, vy = vx + min(1.0, most) * ax, vy + min(1.0, most) * ay
                x, y, nose, t = x + STEP_S * vx, y + STEP_S * vy, nose + STEP_S * rate, t + STEP_S
                standing = read_at(known, known.gap, x, y) - body.radius
                moving = _to_movers(batch, i, body, x, y, places[step]) - body.radius
                step += 1
                if min(standing, moving) < LEAST_GAP_M:
                    # A contact dominates all other costs; later and shallower contacts cost less.
                    cost += 1000.0 - 100.0 * min(t, 5.0) - 10.0 * max(-5.0, min(standing, moving))
                    break
                if moving < WARY_GAP_M:
                    cost += WARY * (WARY_GAP_M - moving) * STEP_S
                dx, dy = x - batch.goal[i, 0], y - batch.goal[i, 1]
                away = math.sqrt(dx * dx + dy * dy)
                there, ahead = away < body.arrived, (away - body.arrived - 1.0) / body.top_speed
            # Time flown, plus the map's time from the end of the prediction.
            cost += t
            if not there:
                cost += read_at(known, known.to_go, x, y) / body.top_speed
            if cost < least:
                best, least = c, cost
    return best


@kernel
def _off_the_way(known: Map, north: float, east: float, nose: float) -> float:
    """Return the angle between the nose and the path to the goal [rad], 0 to pi."""
    cell = known.cell
    # Central differences of the time to go; the path runs downhill.
    down_x = read_at(known, known.to_go, north - cell, east)
    down_x -= read_at(known, known.to_go, north + cell, east)
    down_y = read_at(known, known.to_go, north, east - cell)
    down_y -= read_at(known, known.to_go, north, east + cell)
    off = math.atan2(down_y, down_x) - nose
    return abs(math.atan2(math.sin(off), math.cos(off)))

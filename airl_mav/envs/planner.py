"""The planner: an expert that knows the true arena, moving obstacles' tours included.

Only the batch twin knows so much: nothing of this flies. It is there to be imitated
(`training.imitation`).

An episode begins with a map of the way to the goal (`Map`). A decision tries actions of
the set: each is flown ahead on the response of the vehicle's profile, to the end of its hold, then
straight on for a while, and then to a stand, past the obstacles where they will be. Of those that
touch nothing the one with the least time to go wins (a dynamic window approach: Fox, Burgard,
Thrun, IEEE Robotics & Automation Magazine 4(1), 1997).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from airl_mav.arena.geometry import Shape
from airl_mav.arena.ground import TOP
from airl_mav.arena.relief import extreme_within
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import quats_to_euler
from airl_mav.core.kernels import kernel
from airl_mav.envs.arenas import ArenaBatch, relief_of
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import Delay
from airl_mav.latency.injection import Injection

CELLS = 125
"""Cells of the map along the longer side of an arena, at most."""

FINEST_M = 0.4
"""Least side of a cell [m]."""

COMFORT_M = 1.2
"""Gap to what stands from which on the way there is as good as any [m]."""

SLOWEST = 0.25
"""Share of the speed on the map where the vehicle just fits."""

BLOCKED = 0.02
"""The same where it does not: small, so that the way out is still downhill."""

OVER_M = 0.3
"""What is lower than the vehicle's lower side by this, or higher than its upper, is not in the way
[m]."""

_BOX = int(Shape.BOX)

FAR = 1e9
"""Farther than any place is [m], or longer than any way [s]."""


class Map(NamedTuple):
    """What an episode's planning needs of its arena; cells (rows north, columns east)."""

    north: float
    """Of the first cell's centre [m]."""
    east: float
    cell: float
    """Side of a cell [m]."""
    gap: NDArray[np.float64]
    """From a cell's centre to the nearest thing that stands, or hill [m]; negative inside."""
    to_go: NDArray[np.float64]
    """Time to the goal at 1 m/s [s]."""


class Body(NamedTuple):
    """The vehicle, as the planner flies it."""

    radius: float
    half_height: float
    altitude: float
    """Height that it holds [m]."""
    top_speed: float
    """Of the action set [m/s]."""
    arrived: float
    """How near the goal it has arrived [m]."""


def map_of(batch: ArenaBatch, i: int, body: Body) -> Map:
    """Return the map of arena i."""
    south, north, west, east = batch.bounds[i, :4]
    cell = max(FINEST_M, max(north - south, east - west) / CELLS)
    shape = math.ceil((north - south) / cell), math.ceil((east - west) / cell)
    gap, to_go = np.empty(shape), np.full(shape, FAR)
    first = south + 0.5 * cell, west + 0.5 * cell
    _fill_gaps(batch, i, body, first, cell, gap)
    most_m = body.altitude - body.half_height - OVER_M
    if batch.grid[i, TOP] > most_m:
        gap = np.minimum(gap, _to_hills(batch, i, most_m, first, cell, gap.shape))
    _fill_times(gap, body.radius, first, cell, (batch.goal[i, 0], batch.goal[i, 1]), to_go)
    return Map(first[0], first[1], cell, gap, to_go)


@kernel
def beside(
    batch: ArenaBatch, i: int, obstacle: int, body: Body, north: float, east: float
) -> float:
    """Return the distance [m] from a place at flight altitude to an obstacle, seen from above."""
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
    """Return the distances (rows, columns) [m] to ground that is higher; negative in it.

    No more than a quarter of a cell too far, and little more than a cell too near: by the exact
    Euclidean distances between the centres of cells of both kinds.
    """
    high = np.empty(shape, np.bool_)
    _fill_high(batch, i, most_m, first, cell, high)
    if not high.any():
        return np.full(shape, FAR)
    to_high = scipy.ndimage.distance_transform_edt(~high, sampling=cell)
    to_low = scipy.ndimage.distance_transform_edt(high, sampling=cell)
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
    """Write in which cells (rows, columns), out to their corners, any ground is higher [m]."""
    relief, corner = relief_of(batch, i), cell / math.sqrt(2.0)
    for row in range(high.shape[0]):
        for column in range(high.shape[1]):
            north, east = first[0] + row * cell, first[1] + column * cell
            high[row, column] = extreme_within(relief, north, east, corner, 1.0) > most_m


@kernel
def _fill_gaps(
    batch: ArenaBatch,
    i: int,
    body: Body,
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
    """Solve the eikonal equation from the goal outwards; `to_go` comes in as far as can be."""
    rows, columns = gap.shape
    slow = np.empty((rows, columns))
    for row in range(rows):
        for column in range(columns):
            room = gap[row, column] - radius
            share = SLOWEST + (1.0 - SLOWEST) * room / COMFORT_M
            slow[row, column] = 1.0 / (BLOCKED if room < 0.0 else min(1.0, share))
    goal_row = min(max(int((goal[0] - first[0]) / cell + 0.5), 0), rows - 1)
    goal_column = min(max(int((goal[1] - first[1]) / cell + 0.5), 0), columns - 1)
    to_go[goal_row, goal_column] = 0.0
    changed = 1.0
    sweep = 0
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
        if sweep % 4 != 0:
            changed = 1.0


@kernel
def read_at(known: Map, field: NDArray[np.float64], north: float, east: float) -> float:
    """Return a field of the map at a place, between its cells."""
    rows, columns = field.shape
    x = min(max((north - known.north) / known.cell, 0.0), rows - 1.001)
    y = min(max((east - known.east) / known.cell, 0.0), columns - 1.001)
    row, column = int(x), int(y)
    u, v = x - row, y - column
    near = (1.0 - v) * field[row, column] + v * field[row, column + 1]
    far = (1.0 - v) * field[row + 1, column] + v * field[row + 1, column + 1]
    found: float = (1.0 - u) * near + u * far
    return found


STEP_S = 0.1
"""Step of the flight ahead [s]."""

AHEAD_S = 2.5
"""How long beyond the hold each way is flown ahead [s]."""

STRAIGHT_ON_S = (0.0, 0.5, 1.3, 2.5)
"""How long beyond the hold a way goes straight on before the vehicle brakes [s].

One that can only brake has no way out when something comes towards it where it would stand: among
the 30 moving obstacles of `crowded` it loses a fifth of the flights.
"""

MOST_M_S2 = 6.0
"""Greatest acceleration on the way [m/s2]; the first-order response alone would be quicker."""

LEAST_GAP_M = 0.3
"""A lesser gap is as bad as a contact [m]."""

WARY_GAP_M = 2.0
"""A lesser gap to a moving obstacle costs something [m].

The planner itself would need less; who learns from it knows less than the planner does.
"""

WARY = 4.0
"""What a second is worth in which such a gap is 1 m less [s]."""

TURN_S = 0.4
"""What a radian between the nose and the way is worth [s], unless the camera sees all round."""

LATENCIES = 64
"""Draws that the mean latency is of."""


class Timing(NamedTuple):
    """When a decision acts [s], counted from its observation, and how fast the vehicle answers."""

    lead: float
    """Until the vehicle begins to answer the new setpoint; the last one flies on."""
    dead: float
    """The part of it in which the vehicle flies as it was told before."""
    hold: float
    response: float
    """Time constant of the velocity."""
    turn_response: float
    """The same of the yaw rate, here a delay."""
    turn: float
    """What a radian between the nose and the way is worth."""


class Planner:
    """Decides for the flights of a batch twin. Implements `experts.Expert`."""

    def __init__(self, navigation: Navigation, commands: NDArray[np.float64]) -> None:
        """Take the flights, and the commands (c, 3) to choose from.

        Raises:
            FieldError: The vehicle's profile does not say how it answers setpoints.
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
        self._body = Body(
            vehicle.radius, vehicle.half_height, rules.altitude_m, top, rules.goal_radius_m
        )
        lead_us = np.mean([_mean_t2_us(each, spec.delay) for each in navigation.injections])
        lead_us += spec.delay.link_ms * US_PER_MS
        self._timing = Timing(
            float(lead_us) / US_PER_S + response.dead_time_s,
            response.dead_time_s,
            rules.hold_s,
            response.velocity_time_s,
            response.yaw_rate_time_s,
            TURN_S * (spec.camera.of(navigation.vehicle.camera).horizontal_fov_deg < 360.0),
        )
        self._maps: dict[int, Map] = {}

    def begin(self, slots: Sequence[int]) -> None:
        """Make the maps of the episodes that slots begin, or go on with after `set_state`."""
        arenas = self._navigation.whole_truth().arenas
        for i in slots:
            self._maps[i] = map_of(arenas, i, self._body)

    def decide(self) -> NDArray[np.int64]:
        """Return the indices (n,) of the commands chosen for the present states."""
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
    """Return the mean latency of a decision [µs], over draws of its own."""
    sampler = injection.sampler(np.random.default_rng(0))
    if sampler is None:
        return delay.native_ms * US_PER_MS
    return float(np.mean([sampler.sample_us() for _ in range(LATENCIES)]))


@kernel
def _follow_movers(batch: ArenaBatch, i: int, time_s: float, places: NDArray[np.float64]) -> None:
    """Write where the moving obstacles will be: places (steps, movers, 2) north, east [m].

    The batch's own centres stay as they are: those of the present.
    """
    for j in range(places.shape[1]):
        times, at = batch.tour_times_s[i, j], batch.tour_points[i, j]
        k = 0
        for step in range(places.shape[0]):
            t = (time_s + (step + 1) * STEP_S) % batch.tour_period_s[i, j]
            if times[k] > t:
                k = 0
            while times[k + 1] <= t:
                k += 1
            a = (t - times[k]) / (times[k + 1] - times[k])
            for axis in range(2):
                places[step, j, axis] = at[k, axis] + a * (at[k + 1, axis] - at[k, axis])


@kernel
def _to_movers(
    batch: ArenaBatch, i: int, body: Body, north: float, east: float, places: NDArray[np.float64]
) -> float:
    """Return the distance [m] to the nearest moving obstacle, if they are at places (movers, 2).

    Those that are farther than matters are passed over.
    """
    least = FAR
    for j in range(places.shape[0]):
        obstacle = batch.n_static[i] + j
        dx, dy = north - places[j, 0], east - places[j, 1]
        half = batch.half_size[i, obstacle]
        reach = half[0] + half[1] + body.radius + WARY_GAP_M
        if dx * dx + dy * dy < reach * reach:
            # As if the vehicle were elsewhere, not the obstacle.
            x, y = dx + batch.center[i, obstacle, 0], dy + batch.center[i, obstacle, 1]
            least = min(least, beside(batch, i, obstacle, body, x, y))
    return least


@kernel
def best_command(
    batch: ArenaBatch,
    i: int,
    known: Map,
    body: Body,
    timing: Timing,
    commands: NDArray[np.float64],
    last: tuple[float, float, float],
    position: tuple[float, float],
    velocity: tuple[float, float],
    yaw: float,
    time_s: float,
) -> int:
    """Return the index of the best of the commands (c, 3) for flight i.

    Args:
        batch: The arenas; obstacles where they are now.
        i: Which flight.
        known: Its map.
        body: The vehicle.
        timing: When the decision acts.
        commands: Forward, right [m/s], yaw rate [rad/s].
        last: The command that flies until then.
        position: North, east [m].
        velocity: The same [m/s].
        yaw: Heading [rad].
        time_s: Since the start of the flight [s].
    """
    best, least = 0, math.inf
    share = 1.0 - math.exp(-STEP_S / timing.response)
    turned = timing.lead + timing.hold
    horizon = turned + AHEAD_S
    places = np.empty((int(horizon / STEP_S) + 2, batch.n_obstacles[i] - batch.n_static[i], 2))
    _follow_movers(batch, i, time_s, places)
    # A setpoint is turned by the heading at which it arrives, a dead time before it is answered.
    facing = yaw - last[2] * timing.dead
    for c in range(len(commands)):
        for straight_on in STRAIGHT_ON_S:
            x, y, vx, vy, nose = position[0], position[1], velocity[0], velocity[1], facing
            t, step, cost = 0.0, 0, 0.0
            there, looked = False, timing.turn == 0.0
            cn, sn = math.cos(nose), math.sin(nose)
            # What is no better than the best so far is not flown to its end.
            while t < horizon and cost + t < least and not there:
                forward, right, rate = commands[c, 0], commands[c, 1], commands[c, 2]
                if t < timing.lead:
                    forward, right, _ = last
                elif t >= turned + straight_on:
                    forward, right = 0.0, 0.0
                if t < timing.lead + timing.turn_response:
                    rate = last[2]
                elif t >= turned + timing.turn_response:
                    rate = 0.0
                if rate == 0.0 and t >= turned and not looked:
                    looked = True
                    cost += timing.turn * _off_the_way(known, x, y, nose)
                if rate != 0.0:
                    cn, sn = math.cos(nose), math.sin(nose)
                ax = (cn * forward - sn * right - vx) * share
                ay = (sn * forward + cn * right - vy) * share
                most = MOST_M_S2 * STEP_S / max(math.sqrt(ax * ax + ay * ay), 1e-9)
                vx, vy = vx + min(1.0, most) * ax, vy + min(1.0, most) * ay
                x, y, nose, t = x + STEP_S * vx, y + STEP_S * vy, nose + STEP_S * rate, t + STEP_S
                standing = read_at(known, known.gap, x, y) - body.radius
                moving = _to_movers(batch, i, body, x, y, places[step]) - body.radius
                step += 1
                if min(standing, moving) < LEAST_GAP_M:
                    # Nothing is as bad, but later is better, and so is less deep.
                    cost += 1000.0 - 100.0 * min(t, 5.0) - 10.0 * max(-5.0, min(standing, moving))
                    break
                if moving < WARY_GAP_M:
                    cost += WARY * (WARY_GAP_M - moving) * STEP_S
                dx, dy = x - batch.goal[i, 0], y - batch.goal[i, 1]
                there = dx * dx + dy * dy < body.arrived * body.arrived
            cost += t
            if not there:
                cost += read_at(known, known.to_go, x, y) / body.top_speed
            if cost < least:
                best, least = c, cost
    return best


@kernel
def _off_the_way(known: Map, north: float, east: float, nose: float) -> float:
    """Return the angle between the nose and the way to the goal [rad], 0 to pi."""
    cell = known.cell
    down_x = read_at(known, known.to_go, north - cell, east)
    down_x -= read_at(known, known.to_go, north + cell, east)
    down_y = read_at(known, known.to_go, north, east - cell)
    down_y -= read_at(known, known.to_go, north, east + cell)
    off = math.atan2(down_y, down_x) - nose
    return abs(math.atan2(math.sin(off), math.cos(off)))

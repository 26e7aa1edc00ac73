"""Compiled predictions of the planner."""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel

Floats = NDArray[np.float64]

STEP_S = 0.15
"""Time step of the prediction [s]."""

BRAKING_S = 1.2
"""Time of braking in the prediction [s]."""

SPREAD_M, GROWTH_M_S = 0.25, 0.25
"""Uncertainty of a moving obstacle's size [m], and its growth with the prediction [m/s]."""

NEAR_M, CLOSE_M = 1.5, 0.8
"""Gaps to moving and static obstacles below which a prediction costs more [m]."""

ARRIVED_M = 2.5
"""Distance from the goal at which a prediction ends [m]."""

COST, HIT_S, FLOWN, LEFT, UNKNOWN, STATIC_M, MOVING_M, POSSIBLE_M = range(8)
"""Outcomes of a prediction: cost [s]; time to the collision, infinite = none [s]; cost before
`LEFT`, the time from its end to the target [s]; share of the way in unknown cells; minimum gaps to
static, moving and possibly moving obstacles [m]."""


@kernel
def interpolated(field: Floats, x: float, y: float) -> float:
    """Return a field (rows, columns) at a row and a column between cells, bilinearly."""
    rows, columns = field.shape
    # Just below the last index, so that row + 1 and column + 1 exist.
    x, y = min(max(x, 0.0), rows - 1.001), min(max(y, 0.0), columns - 1.001)
    row, column = int(x), int(y)
    u, v = x - row, y - column
    near = (1.0 - v) * field[row, column] + v * field[row, column + 1]
    far = (1.0 - v) * field[row + 1, column] + v * field[row + 1, column + 1]
    found: float = (1.0 - u) * near + u * far
    return found


@kernel
def gap_at(gap: Floats, origin: Floats, cell: float, north: float, east: float) -> float:
    """Return the gap at a position, interpolated on the map (rows, columns)."""
    return interpolated(gap, (north - origin[0]) / cell - 0.5, (east - origin[1]) / cell - 0.5)


@kernel
def _gap_to(tracks: Floats, north: float, east: float, t: float, radius: float) -> float:
    """Return the gap to moving obstacles (m, 5) in t [s]: position, velocity, radius."""
    found = math.inf
    for k in range(len(tracks)):
        x = north - tracks[k, 0] - t * tracks[k, 2]
        y = east - tracks[k, 1] - t * tracks[k, 3]
        size = tracks[k, 4] + radius + SPREAD_M + GROWTH_M_S * t
        found = min(found, math.sqrt(x * x + y * y) - size)
    return found


@kernel
def predict(
    gaps: Floats,
    evidence: Floats,
    origin: Floats,
    cell: float,
    tracks: Floats,
    possible: Floats,
    wishes: Floats,
    straight_on: Floats,
    places: Floats,
    last: Floats,
    hold: Floats,
    body: Floats,
    found: Floats,
) -> None:
    """Predict velocities, each held, then straight on for a while, then braked to a stop.

    Args:
        gaps: (2, rows, columns) distances to static obstacles [m], at the vehicle's height and at
            the height to which it goes.
        evidence: (rows, columns) of the map at that height; 0 = unknown.
        origin: North, east of the map's corner [m].
        cell: Side of a cell [m].
        tracks: (m, 5) moving obstacles: position, velocity, radius.
        possible: The same of possibly moving obstacles.
        wishes: (c, 2) velocities, north, east [m/s].
        straight_on: (k,) times of straight flight [s].
        places: (4, 2) position, velocity, goal, target.
        last: (2,) previous velocity.
        hold: Lead and hold [s], yaw rate and previous yaw rate [rad/s], time until the height is
            reached [s], dead time [s].
        body: Radius, margin [m], time constant of the velocity [s],
            acceleration [m/s2], speed to the target [m/s], weight of small static gaps.
        found: (8, k, c) outcomes, written.
    """
    radius, margin, response_s, most_m_s2, speed = body[0], body[1], body[2], body[3], body[4]
    lead, end = hold[0], hold[0] + hold[1]
    share = 1.0 - math.exp(-STEP_S / response_s)
    steps = math.ceil((end + straight_on[-1] + BRAKING_S) / STEP_S)
    # Too close already: only getting closer is a collision.
    here = gap_at(gaps[0], origin, cell, places[0, 0], places[0, 1])
    least = min(margin, here - radius - 0.05)
    for k in range(len(straight_on)):
        for c in range(len(wishes)):
            x, y, vx, vy = places[0, 0], places[0, 1], places[1, 0], places[1, 1]
            cost, hit_s, unknown, flown = 0.0, math.inf, 0, 0
            least_m = (2.0, 3.0, 3.0)
            there = False
            for step in range(1, steps + 1):
                t = step * STEP_S
                # Setpoints turn with the nose.
                north, east, angle = 0.0, 0.0, 0.0
                if t <= lead:
                    north, east, angle = last[0], last[1], hold[3] * (t - hold[5])
                elif t <= end + straight_on[k]:
                    north, east = wishes[c, 0], wishes[c, 1]
                    angle = hold[2] * (min(t, end) - 0.5 * (lead + end))
                cos, sin = math.cos(angle), math.sin(angle)
                ax = (cos * north - sin * east - vx) * share
                ay = (sin * north + cos * east - vy) * share
                most = most_m_s2 * STEP_S / max(math.sqrt(ax * ax + ay * ay), 1e-9)
                vx, vy = vx + min(1.0, most) * ax, vy + min(1.0, most) * ay
                x, y = x + STEP_S * vx, y + STEP_S * vy
                if there:
                    continue
                static = gap_at(gaps[int(t >= hold[4])], origin, cell, x, y) - radius
                moving = _gap_to(tracks, x, y, t, radius)
                maybe = _gap_to(possible, x, y, t, radius)
                near, close, perhaps = least_m
                least_m = min(near, static), min(close, moving), min(perhaps, maybe)
                row = min(max(int((x - origin[0]) / cell), 0), len(evidence) - 1)
                column = min(max(int((y - origin[1]) / cell), 0), len(evidence) - 1)
                unknown, flown = unknown + (evidence[row, column] == 0.0), flown + 1
                depth = min(static - least, moving - margin)
                # Until the vehicle responds, all candidates are alike.
                if depth < 0.0 and t > lead:
                    cost, hit_s = 1000.0 - 100.0 * t - 30.0 * max(depth, -3.0), t
                    there = True
                    continue
                charge = 2.0 * max(0.0, NEAR_M - moving) + body[5] * max(0.0, CLOSE_M - static)
                cost += STEP_S * (1.0 + charge)
                there = math.hypot(x - places[2, 0], y - places[2, 1]) < ARRIVED_M
            left = math.hypot(x - places[3, 0], y - places[3, 1]) / speed
            found[COST, k, c] = cost if there else cost + left
            found[HIT_S, k, c], found[FLOWN, k, c], found[LEFT, k, c] = hit_s, cost, left
            found[UNKNOWN, k, c] = unknown / max(flown, 1)
            found[STATIC_M, k, c], found[MOVING_M, k, c], found[POSSIBLE_M, k, c] = least_m


@kernel
def fill_gaps(square: Floats, reach: int) -> None:
    """Replace zero and far (n, n) by the squared distance to the next zero in cells, up to `reach`.

    Far is (reach + 1) squared.
    """
    n, far = len(square), (reach + 1.0) ** 2
    for column in range(n):
        for order in (1, -1):
            away = reach + 1.0
            for k in range(n):
                row = k if order == 1 else n - 1 - k
                away = 0.0 if square[row, column] == 0.0 else min(away + 1.0, reach + 1.0)
                square[row, column] = min(square[row, column], away * away)
    before = np.empty(n)
    for row in range(n):
        before[:] = square[row]
        if before.min() == far:
            continue
        for column in range(n):
            least = before[column]
            for k in range(1, reach + 1):
                if column >= k:
                    least = min(least, before[column - k] + k * k)
                if column + k < n:
                    least = min(least, before[column + k] + k * k)
            square[row, column] = least


MOVES = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
"""Moves between nodes of a path, forwards or backwards: rows, columns."""


@kernel
def find_path(cost: Floats, start: int, end: int) -> tuple[NDArray[np.int64], float]:
    """Return the nodes of the path of least cost, and the cost.

    A* (Hart, Nilsson, Raphael, IEEE Trans. Systems Science and Cybernetics 4(2), 1968). `cost`
    (rows, columns) is of a unit of length in a node, at least 1; nodes are numbered row by row.
    """
    n = len(cost)
    least, before = np.full(n * n, math.inf), np.full(n * n, -1)
    done = np.zeros(n * n, np.bool_)
    least[start] = 0.0
    waiting = [(0.0, start)]
    while waiting:
        node = heapq.heappop(waiting)[1]
        if node == end:
            break
        if done[node]:
            continue
        done[node] = True
        row, column = node // n, node % n
        for down, right in MOVES:
            length = math.sqrt(down * down + right * right)
            for sign in (1, -1):
                r, c = row + sign * down, column + sign * right
                if not (0 <= r < n and 0 <= c < n) or done[r * n + c]:
                    continue
                passed = 0.5 * (cost[row, column] + cost[r, c])
                if abs(down) + abs(right) == 3:
                    # A knight's move passes between two nodes, which count, too.
                    half_r, half_c = sign * (down // 2), sign * int(right / 2)
                    over = cost[row + half_r, column + half_c]
                    over += cost[r - half_r, c - half_c]
                    passed = 0.5 * (passed + 0.5 * over)
                total = least[node] + length * passed
                if total < least[r * n + c]:
                    least[r * n + c], before[r * n + c] = total, node
                    ahead = math.sqrt((r - end // n) ** 2 + (c - end % n) ** 2)
                    heapq.heappush(waiting, (total + ahead, r * n + c))
    nodes = [end]
    while nodes[-1] != start:
        nodes.append(before[nodes[-1]])
    return np.array(nodes[::-1]), least[end]


@kernel
def see_free(
    evidence: Floats,
    origin: Floats,
    cell: float,
    position: Floats,
    first: float,
    per_rad: float,
    limit: Floats,
    above: Floats,
    level: int,
    slope: float,
    per_slope: float,
    rays: Floats,
    lowest: float,
) -> None:
    """Lower the evidence (l, rows, columns) of cells in front of the returns.

    `limit` (l, b) are the free ranges of bearings from `first` [rad] on, `per_rad` in a radian.
    `above` (l,) are the heights of the layers above the vehicle, which is in the layer `level`.
    `rays` (b, s) are the ranges of the lines of sight, from a `slope` on, `per_slope` in a unit.
    """
    furthest = limit.max()
    for row in range(evidence.shape[1]):
        north = origin[0] + (row + 0.5) * cell - position[0]
        for column in range(evidence.shape[2]):
            east = origin[1] + (column + 0.5) * cell - position[1]
            away = math.sqrt(north * north + east * east)
            if away >= furthest:
                continue
            bearing = int(((math.atan2(east, north) - first) % (2.0 * math.pi)) * per_rad)
            if bearing >= limit.shape[1]:
                continue
            for layer in range(len(limit)):
                if away >= limit[layer, bearing]:
                    continue
                if layer != level:
                    line = math.floor((above[layer] / away - slope) * per_slope)
                    if not 0 <= line < rays.shape[1] or away >= rays[bearing, line]:
                        continue
                before = evidence[layer, row, column]
                evidence[layer, row, column] = max(lowest, before - 1.0)


@kernel
def scan_layers(
    points: Floats,
    above: Floats,
    band: float,
    fov: float,
    slope: float,
    per_slope: float,
    ranges: Floats,
    rays: Floats,
) -> None:
    """Reduce ranges (l, b) and rays (b, s) [m] to the nearest points.

    `points` (n, 3) are forward, right and down [m]; `above` (l,) are the heights of the layers
    above the vehicle, each seen in a band of +- `band` [m]; rays as for `see_free`.
    """
    layers, bearings = ranges.shape
    for k in range(len(points)):
        angle = math.atan2(points[k, 1], points[k, 0]) + 0.5 * fov
        bearing = math.floor(angle * (bearings / fov))
        if not 0 <= bearing < bearings:
            continue
        away = math.hypot(points[k, 0], points[k, 1])
        line = math.floor((-points[k, 2] / max(away, 1e-3) - slope) * per_slope)
        if 0 <= line < rays.shape[1]:
            rays[bearing, line] = min(rays[bearing, line], away)
        for layer in range(layers):
            if abs(points[k, 2] + above[layer]) < band:
                ranges[layer, bearing] = min(ranges[layer, bearing], away)


def warm_up() -> None:
    """Compile all functions, or load them from the cache."""
    square, pair, none = np.zeros((4, 4)), np.zeros(2), np.zeros((0, 5))
    fill_gaps(square, 1)
    one = np.ones((1, 1))
    find_path(one, 0, 0)
    see_free(square[None], pair, 1.0, pair, 0.0, 1.0, one, np.ones(1), 0, 0.0, 1.0, one, 0.0)
    scan_layers(np.zeros((1, 3)), np.zeros(1), 1.0, 1.0, 0.0, 1.0, one, one)
    still, tables = np.zeros((1, 2)), (square[None], square, pair, 1.0, none, none)
    hold, body, found = np.zeros(6), np.ones(6), np.zeros((8, 1, 1))
    predict(*tables, still, np.zeros(1), np.zeros((4, 2)), pair, hold, body, found)

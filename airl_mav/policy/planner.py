"""Planner: a classical policy with a map of its depth images.

A level scan of each image updates an occupancy grid (Elfes, IEEE Computer 22(6), 1989) and tracks
of moving obstacles. Dijkstra's algorithm finds the path to the goal; unknown cells count as free.
The policy pursues the most distant point of the path in line of sight. It predicts a set of
velocities, each with a brake to a stop, and takes the one with the least cost (a dynamic window:
Fox, Burgard, Thrun, IEEE Robotics & Automation Magazine 4(1), 1997).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.policy.actions import Action
from airl_mav.policy.greedy import near_points
from airl_mav.policy.observation import Observation

Floats = NDArray[np.float64]
Cells = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Rows (north) and columns (east) of a map."""


@dataclass(frozen=True)
class PlannerSettings:
    """Settings of the planner."""

    speeds_m_s: tuple[float, ...] = (0.6, 1.25, 2.5, 3.75, 5.0)
    """Speeds of the candidates, ascending."""
    max_yaw_rate_rad_s: float = math.radians(120.0)
    turn_gain_1_s: float = 2.0
    """Yaw rate per angle between nose and path."""
    radius_m: float = 0.3
    """Radius of the vehicle."""
    margin_m: float = 0.2
    """Minimum gap to obstacles."""
    comfort_m: float = 1.6
    """Distance to obstacles above which a path has no extra cost."""
    dead_time_s: float = 0.23
    """Time from a setpoint to the vehicle's response; PX4 1.17 on the quad."""
    response_s: float = 0.54
    """Time constant of the velocity."""
    brake_m_s2: float = 6.0
    """Maximum acceleration in the prediction."""
    latency_s: float = 0.01
    """Decision latency if the observation has none."""
    period_s: float = 0.1
    """Time between decisions if the telemetry has no time."""
    band_m: float = 0.5
    """Returns within this height above or below the vehicle are obstacles."""


CELLS = 160
"""Cells along a map's side; an even number."""

CELL_M = 0.4
"""Minimum side of a cell [m]."""

AROUND = 1.6
"""Side of a map, relative to the distance of the goal along the longer axis."""

LEAST, MOST, SURE = -2.0, 8.0, 5.0
"""Evidence of a cell, +1 a return, -1 a view through it: limits, and a static obstacle's."""

SIGHT_M = 15.0
"""Maximum distance of the pursued point [m]."""

FREE_M = 18.0
"""Maximum range at which a scan frees cells [m]."""

BLOCKED = 1000.0
"""Cost of a metre in an obstacle, relative to free space."""

MOVES = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
"""Moves between nodes of the path: rows, columns."""


class OccupancyMap:
    """Occupancy grid with memory."""

    def __init__(self, position: Floats, goal: Floats) -> None:
        """Create an unknown map with position and goal (2,) north, east [m] in its middle."""
        side = max(CELL_M * CELLS, AROUND * float(np.abs(goal - position).max()))
        self.cell = side / CELLS
        self.origin = 0.5 * (position + goal - side)
        self.evidence = np.zeros((CELLS, CELLS))
        middles = (np.arange(CELLS) + 0.5) * self.cell
        self._north = (self.origin[0] + middles)[:, None]
        self._east = (self.origin[1] + middles)[None, :]
        self._graph: Any = None

    def cells_of(self, points: Floats) -> Cells:
        """Return the cells of points (n, 2); those outside count to the border."""
        index = np.clip(((points - self.origin) / self.cell).astype(np.int64), 0, CELLS - 1)
        return index[:, 0], index[:, 1]

    def look(self, position: Floats, yaw: float, fov: float, ranges: Floats, hits: Floats) -> None:
        """Update the evidence by a scan: ranges (b,) [m] over the view, hits (n, 2) [m]."""
        north, east = self._north - position[0], self._east - position[1]
        angle = np.mod(np.arctan2(east, north) - yaw + 0.5 * fov, 2.0 * math.pi)
        bearing = np.minimum((angle * (len(ranges) / fov)).astype(np.int64), len(ranges))
        # A cell is as wide as a bearing in some distance: its neighbours must be free, too.
        padded = np.pad(np.minimum(ranges, FREE_M), 1)
        least = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
        limit = np.append(least - 0.9 * self.cell, 0.0)
        free = np.hypot(north, east) < limit[bearing]
        self.evidence[free] = np.maximum(LEAST, self.evidence[free] - 1.0)
        hit = self.cells_of(hits)
        self.evidence[hit] = np.minimum(MOST, self.evidence[hit] + 1.0)

    def gaps(self, hits: Floats, reach_m: float) -> Floats:
        """Return the distances of all cells to the nearest obstacle [m], up to about `reach_m`.

        A distance transform in two passes (Felzenszwalb, Huttenlocher, Theory of Computing 8).
        The newest `hits` (n, 2) are obstacles, even if their cells were free.
        """
        reach = math.ceil(reach_m / self.cell)
        square = np.where(self.evidence > 0.0, 0.0, (reach + 1.0) ** 2)
        square[self.cells_of(hits)] = 0.0
        for turned in (square, square.T):
            before = turned.copy()
            for k in range(1, reach + 1):
                np.minimum(turned[k:], before[:-k] + k * k, out=turned[k:])
                np.minimum(turned[:-k], before[k:] + k * k, out=turned[:-k])
        return np.sqrt(square) * self.cell

    def gap_at(self, gap: Floats, at: Floats) -> Floats:
        """Return the gaps at positions (..., 2), interpolated."""
        index = np.clip((at - self.origin) / self.cell - 0.5, 0.0, CELLS - 1.001)
        low = index.astype(np.int64)
        u, v = np.moveaxis(index - low, -1, 0)
        flat, k = gap.ravel(), low[..., 0] * CELLS + low[..., 1]
        near = (1.0 - v) * flat[k] + v * flat[k + 1]
        far = (1.0 - v) * flat[k + CELLS] + v * flat[k + CELLS + 1]
        return np.asarray((1.0 - u) * near + u * far)

    def is_clear(self, gap: Floats, start: Floats, end: Floats, room_m: float) -> bool:
        """Return True if the gap along a line is at least `room_m`, or its start's gap."""
        length = float(np.hypot(*(end - start)))
        share = np.linspace(0.0, 1.0, 2 + int(2.0 * length / self.cell))
        found = gap[self.cells_of(start + share[:, None] * (end - start))]
        return bool((found >= min(room_m, found[0])).all())

    def path(self, position: Floats, goal: Floats, gap: Floats, s: PlannerSettings) -> Floats:
        """Return the path of least cost to the goal (n, 2) [m]."""
        csgraph, csr_matrix = _search()
        half = CELLS // 2
        # A node is two by two cells: the largest gap counts, so that a narrow door stays open.
        wide = gap.reshape(half, 2, half, 2).max(axis=(1, 3))
        room = (wide - s.radius_m) / (s.comfort_m - s.radius_m)
        cost = np.where(room < 0.15, BLOCKED, 1.0 / np.clip(room, 0.25, 1.0))
        ids = np.arange(half * half).reshape(half, half)
        weights, links = [], []
        for down, right in MOVES:
            # A knight's move passes between two nodes, which count, too.
            aside = int(math.copysign(1, right))
            knight = {1: [(0, aside), (1, aside)], 2: [(1, 0), (1, aside)]}
            on_way = [(0, 0), (down, right), *(knight[down] if abs(right) + down == 3 else [])]
            first = max(0, -right)
            windows = [
                (slice(r, half - down + r), slice(first + c, first + c + half - abs(right)))
                for r, c in on_way
            ]
            length = math.hypot(down, right) * 2.0 * self.cell / len(on_way)
            passed = np.stack([cost[each] for each in windows])
            weights.append(length * passed.sum(axis=0).ravel())
            if self._graph is None:
                links.append((ids[windows[0]].ravel(), ids[windows[1]].ravel()))
        weight = np.concatenate(weights)
        if self._graph is None:
            source, sink = (np.concatenate(each) for each in zip(*links, strict=True))
            # Its numbers tell the order of the links.
            self._graph = csr_matrix((np.arange(len(weight)), (source, sink)), (half**2, half**2))
            self._order = self._graph.data.copy()
            self._graph = self._graph.astype(np.float64)
        self._graph.data = weight[self._order]
        (row, end_row), (column, end_column) = self.cells_of(np.stack([position, goal]))
        end = int(ids[end_row // 2, end_column // 2])
        _, following = csgraph.dijkstra(
            self._graph, directed=False, indices=np.array(end), return_predecessors=True
        )
        nodes = [int(ids[row // 2, column // 2])]
        while (node := int(following[nodes[-1]])) >= 0:
            nodes.append(node)
        at = np.stack(np.divmod(np.array(nodes), half), axis=1)
        points = self.origin + (at + 0.5) * 2.0 * self.cell
        points[-1] = goal
        return np.asarray(points)


TRACKED_M = 14.0
"""Maximum range of tracked obstacles [m]."""

WIDEST_M = 3.5
"""Maximum width of tracked obstacles [m]."""

GATE_M = 1.2
"""Maximum distance of an obstacle from its predicted position [m]."""

APART_M = 0.8
"""Minimum distance of neighbouring returns of different obstacles [m]."""

BEHIND_M = 0.4
"""Minimum step of the range beside an obstacle that is entirely visible [m]."""


@dataclass(eq=False)
class Track:
    """An obstacle that is followed from scan to scan, by an alpha-beta filter."""

    position: Floats
    """North, east [m]."""
    born: Floats
    """First position [m]."""
    radius_m: float
    velocity: Floats = field(default_factory=lambda: np.zeros(2))
    """North, east [m/s]."""
    age_s: float = 0.0
    unseen_s: float = 0.0

    @property
    def moving(self) -> bool:
        """True if it left its first position at about its speed."""
        gone = float(np.hypot(*(self.position - self.born)))
        speed = float(np.hypot(*self.velocity))
        known_s = max(self.age_s + self.unseen_s, 1e-3)
        steady = 0.5 * speed < gone / known_s < 2.0 * speed
        return self.age_s > 0.15 and speed > 0.7 and gone > 0.25 and steady

    def see(self, middle: Floats, radius_m: float, elapsed_s: float) -> None:
        """Update the track by the middle of an obstacle [m]."""
        self.age_s, self.unseen_s = self.age_s + elapsed_s, 0.0
        gain = max(0.25, elapsed_s / (self.age_s + elapsed_s))
        error = middle - self.position
        self.position = self.position + max(0.5, gain) * error
        self.velocity = self.velocity + gain * error / elapsed_s
        self.radius_m = max(radius_m, 0.98 * self.radius_m)


def follow(
    tracks: list[Track], known: OccupancyMap, points: Floats, ranges: Floats, elapsed_s: float
) -> tuple[list[Track], NDArray[np.bool_]]:
    """Return the tracks after a scan, and which of its bearings (b,) show a moving obstacle.

    Args:
        tracks: Tracks after the previous scan.
        known: Map of static obstacles.
        points: (b, 2) returns, north, east [m].
        ranges: (b,) [m]; infinite = no return.
        elapsed_s: Time since the previous scan.
    """
    free, kept, moving = list(tracks), [], np.zeros(len(points), np.bool_)
    for track in free:
        track.position = track.position + elapsed_s * track.velocity
        track.unseen_s += elapsed_s
    for first, last, whole in _groups(points, ranges):
        part = points[first:last]
        width = float(np.hypot(*np.ptp(part, axis=0)))
        evidence = known.evidence[known.cells_of(part)]
        # The visible part of an obstacle in free space is enough: it came from elsewhere.
        if not whole and (evidence < 0.0).mean() < 0.5:
            continue
        if width > WIDEST_M or ranges[first:last].min() > TRACKED_M:
            continue
        middle = part.mean(axis=0)
        away = [float(np.hypot(*(middle - track.position))) for track in free]
        if not away or min(away) > GATE_M:
            kept.append(Track(middle, middle, 0.5 * width))
            continue
        found = free.pop(int(np.argmin(away)))
        kept.append(found)
        found.see(middle, 0.5 * width, elapsed_s)
        if (evidence >= SURE).mean() > 0.5:
            found.born, found.velocity, found.age_s = found.position, np.zeros(2), 0.0
        moving[first:last] = found.moving
    lost = [track for track in free if track.unseen_s < (1.5 if track.moving else 0.3)]
    return kept + lost, moving


def _groups(points: Floats, ranges: Floats) -> list[tuple[int, int, bool]]:
    """Return first and last (exclusive) bearing of each obstacle; True: entirely visible."""
    beside = np.pad(ranges, 1)
    with np.errstate(invalid="ignore"):
        step = np.hypot(*np.diff(points, axis=0).T)
    borders = np.flatnonzero(np.pad(~(step < APART_M), 1, constant_values=True)).tolist()
    before, after = beside[:-2] > ranges + BEHIND_M, beside[2:] > ranges + BEHIND_M
    return [
        (first, last, bool(before[first] and after[last - 1]))
        for first, last in pairwise(borders)
        if np.isfinite(ranges[first])
    ]


COURSES = 32
"""Courses of the candidates."""

CREEP_M_S = 1.25
"""Maximum speed out of the camera's view."""

STEP_S = 0.15
"""Time step of the prediction [s]."""

STRAIGHT_ON_S = (0.0, 0.6, 1.5)
"""Times of straight flight before the vehicle brakes in the prediction [s]."""

BRAKING_S = 1.2
"""Time of braking in the prediction [s]."""

SPREAD_M, GROWTH_M_S = 0.25, 0.25
"""Uncertainty of a moving obstacle's size [m], and its growth with the prediction [m/s]."""

NEAR_M, CLOSE_M = 1.5, 0.8
"""Gaps to moving and static obstacles below which a prediction costs more [m]."""

ARRIVED_M = 2.5
"""Distance from the goal at which a prediction ends [m]."""


def _search() -> tuple[Any, Any]:
    """Return scipy's `csgraph` and `csr_matrix`. Raises UsageError without scipy."""
    try:
        from scipy.sparse import csgraph, csr_matrix
    except ImportError:
        raise UsageError("policy planner: needs scipy; pip install scipy") from None
    return csgraph, csr_matrix


class PlannerPolicy:
    """Path planning on a map of the depth images. Implements `actions.Policy`."""

    def __init__(self, settings: PlannerSettings | None = None) -> None:
        self._settings = settings or PlannerSettings()
        _search()  # No decision in flight waits for the import.
        self._map: OccupancyMap | None = None
        self._tracks: list[Track] = []
        self._time_us: int | None = None
        self._last = np.zeros(2)
        """Previous setpoint, north, east [m/s]."""
        self._side = 1.0
        """Direction of a turn to the rear, 1 = right; kept to avoid oscillation."""

    def act(self, observation: Observation) -> Action:
        """Return the velocity for an observation."""
        s, state, yaw = self._settings, observation.states[0], float(observation.yaw)
        lens, fov = observation.intrinsics, observation.intrinsics.horizontal_fov_rad
        to_world = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        position = np.asarray(state.position[:2], np.float64)
        goal = position + to_world @ observation.goal
        self._map = self._map or OccupancyMap(position, goal)
        # A bearing is wider than any column, so that a wall leaves none empty.
        ranges = scan(near_points(observation, s.band_m), fov, int(fov * lens.focal / 1.1))
        angle = yaw + (np.arange(len(ranges)) + 0.5) * (fov / len(ranges)) - 0.5 * fov
        seen = np.isfinite(ranges)
        points = np.full((len(ranges), 2), np.inf)
        ray = np.stack([np.cos(angle[seen]), np.sin(angle[seen])], axis=1)
        points[seen] = position + ranges[seen, None] * ray
        elapsed_s = self._elapsed(state.time_us)
        self._tracks, moving = follow(self._tracks, self._map, points, ranges, elapsed_s)
        hits = points[seen & ~moving]
        self._map.look(position, yaw, fov, ranges, hits)
        gap = self._map.gaps(hits, s.comfort_m)
        target = self._target(self._map, position, goal, gap)
        told = observation.in_flight
        latency_s = s.latency_s if told is None else float(told.latency_s)
        velocity = to_world @ observation.velocity[:2]
        bearing = math.atan2(target[1] - position[1], target[0] - position[0])
        wishes = self._wishes(bearing, yaw, fov)
        costs = self._costs(self._map, gap, wishes, latency_s, (position, velocity, goal, target))
        self._last = wishes[int(costs.min(axis=0).argmin())]
        turn = self._turn(bearing - yaw)
        # The velocity turns with the nose during the hold: aim so that the mean course is right.
        mean = yaw + 0.5 * turn * s.period_s
        north, east = float(self._last[0]), float(self._last[1])
        c, d = math.cos(mean), math.sin(mean)
        return Action(c * north + d * east, c * east - d * north, turn)

    def _elapsed(self, time_us: int | None) -> float:
        """Return the time since the previous decision [s]."""
        before, self._time_us = self._time_us, time_us
        if time_us is None or before is None:
            return self._settings.period_s
        return min(1.0, max(1e-3, (time_us - before) / US_PER_S))

    def _turn(self, angle: float) -> float:
        """Return the yaw rate [rad/s] for an angle between nose and path."""
        angle = math.atan2(math.sin(angle), math.cos(angle))
        if abs(angle) > math.radians(150.0):
            angle = self._side * abs(angle)
        else:
            self._side = math.copysign(1.0, angle)
        limit = self._settings.max_yaw_rate_rad_s
        return max(-limit, min(limit, self._settings.turn_gain_1_s * angle))

    def _target(self, known: OccupancyMap, position: Floats, goal: Floats, gap: Floats) -> Floats:
        """Return the pursued point: the most distant one of the path in line of sight."""
        s = self._settings
        room_m = s.radius_m + s.margin_m + 0.1
        if known.is_clear(gap, position, goal, room_m):
            return goal
        path = known.path(position, goal, gap, s)
        # Never the point next to the vehicle: it would stop there.
        best, *further = path[min(3, len(path) - 1) :]
        for point in further[:: max(1, len(path) // 40)]:
            if float(np.hypot(*(point - position))) > SIGHT_M:
                break
            if known.is_clear(gap, position, point, room_m):
                best = point
        return np.asarray(best)

    def _wishes(self, bearing: float, yaw: float, fov: float) -> Floats:
        """Return the candidate velocities (c, 2), north, east [m/s]."""
        course = bearing + np.arange(COURSES) * (2.0 * math.pi / COURSES)
        off = np.abs(np.mod(course - yaw + math.pi, 2.0 * math.pi) - math.pi)
        fan = np.stack([np.cos(course), np.sin(course)], axis=1)
        speeds, seen = self._settings.speeds_m_s, fan[off < 0.5 * fov]
        moves = [v * (fan if v <= CREEP_M_S else seen) for v in speeds]
        return np.concatenate([np.zeros((1, 2)), *moves])

    def _costs(
        self,
        known: OccupancyMap,
        gap: Floats,
        wishes: Floats,
        latency_s: float,
        points: tuple[Floats, Floats, Floats, Floats],
    ) -> Floats:
        """Return the costs (k, c) [s] of velocities (c, 2), for k times of straight flight.

        A cost is the time to the target, at the maximum speed from the end of the prediction, plus
        a charge for small gaps. A collision dominates it: later and shallower ones cost less.
        `points` are position, velocity, goal and target (2,) north, east.
        """
        s, (position, velocity, goal, target) = self._settings, points
        movers = [track for track in self._tracks if track.moving]
        straight_on = np.array(STRAIGHT_ON_S)[:, None, None]
        shape = (len(STRAIGHT_ON_S), len(wishes))
        at, going = np.broadcast_to(position, (*shape, 2)), np.broadcast_to(velocity, (*shape, 2))
        share = 1.0 - math.exp(-STEP_S / s.response_s)
        lead_s = s.dead_time_s + latency_s
        # The next setpoint follows after the hold and another latency.
        held_s = lead_s + s.period_s + latency_s
        cost, hit, there = np.zeros(shape), np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
        # Too close already: only getting closer is a collision.
        least = min(s.margin_m, float(known.gap_at(gap, position)) - s.radius_m - 0.05)
        for step in range(1, 1 + math.ceil((held_s + STRAIGHT_ON_S[-1] + BRAKING_S) / STEP_S)):
            t = step * STEP_S
            asked = self._last if t <= lead_s else np.where(t <= held_s + straight_on, wishes, 0.0)
            change = (asked - going) * share
            most = s.brake_m_s2 * STEP_S / np.maximum(np.hypot(*np.moveaxis(change, -1, 0)), 1e-9)
            going = going + change * np.minimum(1.0, most)[..., None]
            at = at + STEP_S * going
            static = known.gap_at(gap, at) - s.radius_m
            moving = np.full(shape, np.inf)
            for track in movers:
                off = at - (track.position + t * track.velocity)
                size = track.radius_m + s.radius_m + SPREAD_M + GROWTH_M_S * t
                moving = np.minimum(moving, np.hypot(off[..., 0], off[..., 1]) - size)
            depth = np.minimum(static - least, moving - s.margin_m)
            over = hit | there
            # Until the vehicle responds, all candidates are alike.
            now = (depth < 0.0) & ~over & (t > lead_s)
            cost[now] = 1000.0 - 100.0 * t - 30.0 * np.maximum(depth[now], -3.0)
            hit |= now
            near = 2.0 * np.maximum(0.0, NEAR_M - moving) + np.maximum(0.0, CLOSE_M - static)
            cost += np.where(over | now, 0.0, STEP_S * (1.0 + near))
            there |= np.hypot(*np.moveaxis(at - goal, -1, 0)) < ARRIVED_M
        left = np.hypot(*np.moveaxis(at - target, -1, 0)) / s.speeds_m_s[-1]
        return np.asarray(np.where(hit | there, cost, cost + left))


def scan(points: Floats, fov: float, bearings: int) -> Floats:
    """Return the nearest range [m] of each bearing; points are (n, 2), forward and right [m]."""
    angle = np.arctan2(points[:, 1], points[:, 0]) + 0.5 * fov
    bearing = np.floor(angle * (bearings / fov)).astype(np.int64)
    inside = (bearing >= 0) & (bearing < bearings)
    found = np.full(bearings, np.inf)
    np.minimum.at(found, bearing[inside], np.hypot(points[inside, 0], points[inside, 1]))
    return found

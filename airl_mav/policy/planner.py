"""Planner: a classical policy with a map of its depth images.

Level scans of each image, one for each height, update an occupancy grid (Elfes, IEEE Computer
22(6), 1989), and tracks of moving obstacles. A* finds the path to the goal; unknown cells count as
free. The policy holds its first height unless the path is blocked or long there: it then takes a
path that is free at some height everywhere, and the height that is free the furthest. It pursues
the most distant point of the path in line of sight. It predicts a set of velocities, each with a
brake to a stop, and takes the one with the least cost (a dynamic window: Fox, Burgard, Thrun, IEEE
Robotics & Automation Magazine 4(1), 1997).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache, reduce
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.policy.actions import Action, fastest_climb
from airl_mav.policy.greedy import level_points
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

    @property
    def limits(self) -> tuple[float, float, float, float]:
        """Maximum command: forward, right [m/s], yaw rate [rad/s], down [m/s]."""
        speed = self.speeds_m_s[-1]
        return speed, speed, self.max_yaw_rate_rad_s, fastest_climb(speed)


LEARNED = PlannerSettings(speeds_m_s=(0.6, 1.25, 2.5, 3.75, 5.0, 6.0, 7.0))
"""Settings of the candidates that a network scores."""

WORST_S = 20.0
"""Upper bound of a candidate's cost, relative to the best one's [s]."""

CELLS = 160
"""Cells along a map's side; an even number."""

CELL_M = 0.4
"""Minimum side of a cell [m]."""

LAYERS, BASE = 7, 3
"""Layers of a map, the lowest first, and the one at the height of the first decision."""

LAYER_M = 0.5
"""Distance of layers [m]."""

ABOVE_M: Floats = np.float64(LAYER_M) * np.arange(-BASE, LAYERS - BASE)
"""Heights of the layers above the first [m]."""

LOWEST_M = 0.9
"""Minimum height of a layer above the start [m]."""

CLIMB_M_S, CLIMB_GAIN_1_S = 1.5, 1.0
"""Maximum vertical speed [m/s], and vertical speed per error of the height [1/s]."""

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

NARROW = 0.15
"""Minimum room of a free node."""

DETOUR, DETOUR_M, SHORTER = 1.2, 2.0, 0.8
"""Cost of a path, relative to the goal's distance and beyond [m], from which other heights are
tried; their path must cost at most `SHORTER` of it."""


class Scans(NamedTuple):
    """Level scans of an image in layers of different heights, over the field of view."""

    above: Floats
    """(l,) heights of the layers above the vehicle [m]."""
    ranges: Floats
    """(l, b) nearest range of each bearing [m]; infinite = no return."""
    lowest: float
    """Slope of the lowest line of sight."""
    per_slope: float
    """Lines of sight in a unit of the slope."""
    rays: Floats
    """(b, s) nearest range of each bearing and slope [m]."""


class OccupancyMap:
    """Occupancy grid with memory, in layers of different heights."""

    def __init__(self, position: Floats, goal: Floats) -> None:
        """Create an unknown map with position and goal (2,) north, east [m] in its middle."""
        side = max(CELL_M * CELLS, AROUND * float(np.abs(goal - position).max()))
        self.cell = side / CELLS
        self.origin = 0.5 * (position + goal - side)
        self.evidence = np.zeros((LAYERS, CELLS, CELLS))
        self.level = BASE
        """Layer of the vehicle."""

    def cells_of(self, points: Floats) -> Cells:
        """Return the cells of points (n, 2); those outside count to the border."""
        index = np.clip(((points - self.origin) / self.cell).astype(np.int64), 0, CELLS - 1)
        return index[:, 0], index[:, 1]

    def look(
        self, position: Floats, yaw: float, fov: float, seen: Scans, hits: Sequence[Floats]
    ) -> None:
        """Update the evidence by scans over the view, and the hits (n, 2) of each layer [m]."""
        # A cell is as wide as a bearing in some distance: its neighbours must be free, too.
        padded = np.pad(np.minimum(seen.ranges, FREE_M), ((0, 0), (1, 1)))
        limit = np.minimum(np.minimum(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:])
        limit -= 0.9 * self.cell
        place, per_rad = (self.origin, self.cell, position), limit.shape[1] / fov
        view = (seen.above, self.level, seen.lowest, seen.per_slope, seen.rays)
        _kernels().see_free(self.evidence, *place, yaw - 0.5 * fov, per_rad, limit, *view, LEAST)
        for evidence, each in zip(self.evidence, hits, strict=True):
            hit = self.cells_of(each)
            evidence[hit] = np.minimum(MOST, evidence[hit] + 1.0)

    def gaps(self, layer: int, hits: Floats, reach_m: float) -> Floats:
        """Return the distances of a layer's cells to obstacles [m], up to about `reach_m`.

        A distance transform in two passes (Felzenszwalb, Huttenlocher, Theory of Computing 8).
        The newest `hits` (n, 2) are obstacles, even if their cells were free.
        """
        reach, known = math.ceil(reach_m / self.cell), self.evidence[layer]
        if layer != BASE:
            # Until it is seen, an obstacle is as high as the arena.
            known = np.where(known == 0.0, reduce(np.maximum, self.evidence), known)
        square = np.where(known > 0.0, 0.0, (reach + 1.0) ** 2)
        square[self.cells_of(hits)] = 0.0
        _kernels().fill_gaps(square, reach)
        return np.sqrt(square) * self.cell

    def is_clear(self, gap: Floats, start: Floats, end: Floats, room_m: float) -> bool:
        """Return True if the gap along a line is at least `room_m`, or its start's gap."""
        length = float(np.hypot(*(end - start)))
        share = np.linspace(0.0, 1.0, 2 + int(2.0 * length / self.cell))
        found = gap[self.cells_of(start + share[:, None] * (end - start))]
        return bool((found >= min(room_m, found[0])).all())

    def room(self, gap: Floats, s: PlannerSettings) -> Floats:
        """Return the room of the path's nodes: 0 at the vehicle's radius, 1 at the comfort."""
        # A node is two by two cells: the largest gap counts, so that a narrow door stays open.
        rows = np.maximum(gap[::2], gap[1::2])
        wide = np.maximum(rows[:, ::2], rows[:, 1::2])
        return np.asarray((wide - s.radius_m) / (s.comfort_m - s.radius_m))

    def path(
        self, position: Floats, goal: Floats, gap: Floats, s: PlannerSettings
    ) -> tuple[Floats, float]:
        """Return the path of least cost to the goal (n, 2) [m], and its cost [m]."""
        half, room = CELLS // 2, self.room(gap, s)
        cost = np.where(room < NARROW, BLOCKED, 1.0 / np.clip(room, 0.25, 1.0))
        rows, columns = self.cells_of(np.stack([position, goal]))
        nodes, total = _kernels().find_path(cost, *(rows // 2 * half + columns // 2).tolist())
        points = self.origin + (np.stack(np.divmod(nodes, half), axis=1) + 0.5) * 2.0 * self.cell
        points[-1] = goal
        return points, 2.0 * self.cell * total


TRACKED_M, WIDEST_M, GATE_M = 14.0, 3.5, 1.2
"""Maximum range and width of tracked obstacles, and distance from the predicted position [m]."""

APART_M, BEHIND_M = 0.8, 0.4
"""Minimum distance of neighbouring returns of different obstacles, and minimum step of the range
beside an obstacle that is entirely visible [m]."""


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

    @property
    def possible(self) -> bool:
        """True if it may move, but is not known to."""
        return not self.moving and self.age_s > 0.05 and 0.4 < np.hypot(*self.velocity) < 6.0

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
        evidence = known.evidence[known.level][known.cells_of(part)]
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

ASIDE_M_S = 3.75
"""Maximum speed while the path is out of the camera's view."""

BLIND_M = 1.0
"""Maximum distance flown during a decision [m]."""

PATIENCE_S, MOVED_M = 2.0, 1.0
"""Time without a move of `MOVED_M` [m] after which small static gaps cost less [s]."""

DRIFT_M_S = 0.5
"""Growth of the minimum gap with the latency [m/s]."""

CREEP_M_S = 1.25
"""Maximum speed out of the camera's view."""

STRAIGHT_ON_S = np.array([0.0, 0.6, 1.5])
"""Times of straight flight before the vehicle brakes in the prediction [s]."""


@cache
def _kernels() -> Any:
    """Return the compiled functions, ready to run; imported late, as numba takes a second."""
    from airl_mav.policy import planner_kernels

    planner_kernels.warm_up()
    return planner_kernels


class Places(NamedTuple):
    """Positions of a decision and the velocity, each (2,) north, east [m, m/s]."""

    position: Floats
    velocity: Floats
    goal: Floats
    target: Floats
    """Pursued point of the path."""


class Hold(NamedTuple):
    """Timing of a setpoint, from the observation on."""

    lead_s: float
    """Time until the vehicle responds to it; the previous one is active before."""
    held_s: float
    """Time until it responds to the next."""
    turn: float
    """Yaw rate of the setpoint [rad/s]."""
    last_turn: float
    """Yaw rate of the previous one [rad/s]."""
    level_s: float = 0.0
    """Time until the vehicle is at its new height [s]."""


class Candidates(NamedTuple):
    """Candidate velocities of a decision."""

    velocities: Floats
    """(c, 2) north, east [m/s]."""
    commands: Floats
    """(c, 4) forward, right [m/s], yaw rate [rad/s], down [m/s]."""
    costs: Floats
    """(c,) costs of the planner [s]."""
    features: Floats
    """(c, FEATURES) inputs of a network."""


OUTCOME_FEATURES, OWN_FEATURES = 8, 14
FEATURES = len(STRAIGHT_ON_S) * OUTCOME_FEATURES + OWN_FEATURES
"""Features of a candidate: of its predictions, and its own."""

MOST_COST_S = 6.0
"""Upper bound of the cost of a prediction among the features [s]."""


def candidate_count(speeds: Sequence[float], fov: float) -> int:
    """Return the maximum number of candidates for a horizontal field of view [rad]."""
    creeps = sum(speed <= CREEP_M_S for speed in speeds)
    seen = min(COURSES, int(COURSES * fov / (2.0 * math.pi)) + 1)
    return 1 + COURSES * creeps + seen * (len(speeds) - creeps)


class PlannerPolicy:
    """Path planning on a map of the depth images. Implements `actions.Policy`."""

    def __init__(self, settings: PlannerSettings | None = None) -> None:
        self._settings = settings or PlannerSettings()
        # No decision in flight waits for an import or a compilation.
        _kernels()
        self._map: OccupancyMap | None = None
        self._heights_m = np.zeros(LAYERS)
        """Heights of the layers above the start."""
        self._tracks: list[Track] = []
        self._time_us: int | None = None
        self._last = np.zeros(2)
        """Previous setpoint, north, east [m/s]."""
        self._waited_s, self._waits_at = 0.0, np.full(2, np.inf)
        """Time near the same position [s], and that position, north, east [m]."""
        self._side = 1.0
        """Direction of a turn to the rear, 1 = right; kept to avoid oscillation."""

    def act(self, observation: Observation) -> Action:
        """Return the velocity for an observation."""
        found = self.candidates(observation)
        best = int(found.costs.argmin())
        self._last = found.velocities[best]
        return Action(*found.commands[best].tolist())

    def candidates(self, observation: Observation, *, features: bool = False) -> Candidates:
        """Return the candidates for an observation; without `features` they have none."""
        s, state, yaw = self._settings, observation.states[0], float(observation.yaw)
        fov = observation.intrinsics.horizontal_fov_rad
        to_world = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        told = observation.in_flight
        latency_s = s.latency_s if told is None else float(told.latency_s)
        # The next setpoint follows after the hold and another latency.
        held_s = s.period_s + latency_s
        ahead_s, nose = latency_s, yaw
        if told is not None:
            self._last = to_world @ told.command[:2]
            # A compensated observation is of the time at which the setpoint arrives.
            ahead_s *= not told.foreseen
            nose += ahead_s * float(told.command[2])
        position = np.asarray(state.position[:2], np.float64)
        goal = position + to_world @ observation.goal
        height_m = -float(state.position[2])
        if self._map is None:
            self._map = OccupancyMap(position, goal)
            self._heights_m = height_m + ABOVE_M
        above = self._heights_m - height_m
        now = self._map.level = int(np.abs(above).argmin())
        looked = scan(observation, above, s.band_m)
        ranges, bearings = looked.ranges, looked.ranges.shape[1]
        angle = yaw + (np.arange(bearings) + 0.5) * (fov / bearings) - 0.5 * fov
        ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        seen = np.isfinite(ranges)
        points = position + np.where(seen, ranges, 0.0)[..., None] * ray
        points[~seen] = np.inf
        elapsed_s = self._elapsed(state.time_us, s.period_s if told is None else held_s)
        self._waited_s += elapsed_s
        if float(np.hypot(*(position - self._waits_at))) > MOVED_M:
            self._waited_s, self._waits_at = 0.0, position
        self._tracks, moving = follow(self._tracks, self._map, points[now], ranges[now], elapsed_s)
        # Higher and lower parts of what moves are no obstacles, either.
        beside = (ranges > ranges[now] - WIDEST_M) & (ranges < ranges[now] + WIDEST_M)
        still = seen & ~(moving & beside)
        hits = [each[rows] for each, rows in zip(points, still, strict=True)]
        self._map.look(position, yaw, fov, looked, hits)
        target, level, gaps = self._way(self._map, position, goal, hits)
        velocity = to_world @ observation.velocity[:2]
        bearing = math.atan2(target[1] - position[1], target[0] - position[0])
        wishes = self._wishes(bearing, yaw, fov, latency_s)
        places = Places(position, velocity, goal, target)
        turn = self._turn(bearing - nose, held_s)
        last_turn = 0.0 if told is None else float(told.command[2])
        rise_s = max(0.0, abs(float(above[level])) - 0.5 * LAYER_M) / CLIMB_M_S
        lead_s = s.dead_time_s + ahead_s
        hold = Hold(lead_s, held_s, turn, last_turn, lead_s + s.response_s + rise_s)
        outcomes = self._outcomes(self._map, level, gaps, wishes, hold, places)
        # The velocity turns with the nose during the hold: aim so that the mean course is right.
        mean = nose + 0.5 * turn * held_s
        c, d, (north, east) = math.cos(mean), math.sin(mean), wishes.T
        gain = min(CLIMB_GAIN_1_S, 0.5 / held_s)
        down = max(-CLIMB_M_S, min(CLIMB_M_S, -gain * float(above[level])))
        alike = [np.full(len(wishes), each) for each in (turn, down)]
        commands = [c * north + d * east, c * east - d * north, *alike]
        numbers = np.zeros((len(wishes), 0))
        if features:
            numbers = self._features(wishes, outcomes, latency_s, places, np.array([bearing, yaw]))
        return Candidates(wishes, np.stack(commands, axis=1), outcomes[0].min(axis=0), numbers)

    def _elapsed(self, time_us: int | None, cycle_s: float) -> float:
        """Return the time since the previous decision [s]; without timestamps `cycle_s`."""
        before, self._time_us = self._time_us, time_us
        if time_us is None or before is None:
            return cycle_s
        return min(1.0, max(1e-3, (time_us - before) / US_PER_S))

    def _turn(self, angle: float, held_s: float) -> float:
        """Return the yaw rate [rad/s] for an angle between nose and path and a hold [s]."""
        angle = math.atan2(math.sin(angle), math.cos(angle))
        if abs(angle) > math.radians(150.0):
            angle = self._side * abs(angle)
        else:
            self._side = math.copysign(1.0, angle)
        limit = self._settings.max_yaw_rate_rad_s
        gain = min(self._settings.turn_gain_1_s, 1.0 / held_s)
        return max(-limit, min(limit, gain * angle))

    def _way(
        self, known: OccupancyMap, position: Floats, goal: Floats, hits: Sequence[Floats]
    ) -> tuple[Floats, int, Floats]:
        """Return the pursued point, the layer to fly in, and the gaps (2, rows, columns).

        The gaps are of the layer of the vehicle, and of that to fly in.
        """
        s, here, now = self._settings, known.cells_of(position[None]), known.level
        gap_in = cache(lambda layer: known.gaps(layer, hits[layer], s.comfort_m))

        def reach(step: int) -> list[int]:
            """Return the layers that the vehicle reaches upwards (1) or downwards (-1)."""
            found = []
            for layer in range(now + step, LAYERS if step > 0 else -1, step):
                low = self._heights_m[layer] < min(LOWEST_M, self._heights_m[BASE])
                if low or gap_in(layer)[here][0] < s.radius_m + s.margin_m:
                    break
                found.append(layer)
            return found

        level = BASE if now == BASE or BASE in reach(int(math.copysign(1, BASE - now))) else now
        path, cost = goal[None], 0.0
        if not known.is_clear(gap_in(level), position, goal, s.radius_m + s.margin_m + 0.1):
            path, cost = known.path(position, goal, gap_in(level), s)
        if cost > DETOUR * float(np.hypot(*(goal - position))) + DETOUR_M:
            reached = [now, *reach(1), *reach(-1)]
            widest = reduce(np.maximum, map(gap_in, range(LAYERS)))
            over, less = known.path(position, goal, widest, s)
            if less < SHORTER * cost:
                path, (rows, columns) = over, known.cells_of(over[1:])
                nodes = rows // 2, columns // 2
                room = np.array([known.room(gap_in(layer), s)[nodes] for layer in reached])
                clear = np.logical_and.accumulate(room >= NARROW, axis=1)
                furthest, off = clear.any(axis=0), np.abs(np.array(reached) - now)
                lost = np.where(clear, 1.0 - np.clip(room, 0.0, 1.0), 2.0)[:, furthest]
                level = reached[int((lost.sum(axis=1) + 0.3 * off).argmin())]
        target = self._target(known, position, path, gap_in(level))
        return target, level, np.stack([gap_in(now), gap_in(level)])

    def _target(self, known: OccupancyMap, position: Floats, path: Floats, gap: Floats) -> Floats:
        """Return the pursued point: the most distant one of the path in line of sight."""
        s = self._settings
        room_m = s.radius_m + s.margin_m + 0.1
        # Never the point next to the vehicle, where it would stop, but to go round a corner.
        near, further = path[1:4][::-1], path[4:]
        tight_m = s.radius_m + 0.5 * s.margin_m
        passable = (each for each in near if known.is_clear(gap, position, each, tight_m))
        best = next(passable, path[min(3, len(path) - 1)])
        for point in further[:: max(1, len(path) // 40)]:
            if float(np.hypot(*(point - position))) > SIGHT_M:
                break
            if known.is_clear(gap, position, point, room_m):
                best = point
        return np.asarray(best)

    def _wishes(self, bearing: float, yaw: float, fov: float, latency_s: float) -> Floats:
        """Return the candidate velocities (c, 2), north, east [m/s]."""
        course = bearing + np.arange(COURSES) * (2.0 * math.pi / COURSES)
        off = np.abs(np.mod(course - yaw + math.pi, 2.0 * math.pi) - math.pi)
        fan = np.stack([np.cos(course), np.sin(course)], axis=1)
        seen = fan[off < 0.5 * fov]
        # The way is not in view: the vehicle would turn into what it has not seen.
        most = ASIDE_M_S if off[0] >= 0.5 * fov else math.inf
        most = max(CREEP_M_S, min(most, BLIND_M / max(latency_s, 1e-9)))
        speeds = [v for v in self._settings.speeds_m_s if v <= most]
        moves = [v * (fan if v <= CREEP_M_S else seen) for v in speeds]
        return np.concatenate([np.zeros((1, 2)), *moves])

    def _outcomes(
        self,
        known: OccupancyMap,
        level: int,
        gaps: Floats,
        wishes: Floats,
        hold: Hold,
        places: Places,
    ) -> Floats:
        """Return the outcomes (8, k, c) of velocities (c, 2), for k times of straight flight.

        A cost is the time to the target, at the maximum speed from the end of the prediction, plus
        a charge for small gaps. A collision dominates it: later and shallower ones cost less.
        """
        s = self._settings
        found = np.empty((8, len(STRAIGHT_ON_S), len(wishes)))
        # The longer the reaction, the less certain is the position.
        margin_m = s.margin_m + DRIFT_M_S * (hold.held_s - s.period_s)
        # A vehicle that does not get on passes closer.
        patience = min(1.0, max(0.0, 2.0 - self._waited_s / PATIENCE_S))
        dynamics = (s.response_s, s.brake_m_s2, s.speeds_m_s[-1])
        body = (s.radius_m, margin_m, *dynamics, patience)
        _kernels().predict(
            *(gaps, known.evidence[level], known.origin, known.cell),
            *(_rows(track for track in self._tracks if getattr(track, kind)) for kind in KINDS),
            *(wishes, STRAIGHT_ON_S, np.array(places), self._last),
            *(np.array([*hold, s.dead_time_s]), np.array(body), found),
        )
        return found

    def _features(
        self, wishes: Floats, found: Floats, latency_s: float, places: Places, course: Floats
    ) -> Floats:
        """Return the features (c, FEATURES) of velocities (c, 2), each about -1 to 2.

        `course` are the bearing of the target and the heading [rad].
        """
        cost, hit_s, flown, left, unknown, static_m, moving_m, possible_m = found
        hit = np.isfinite(hit_s)
        predicted = [
            hit,
            np.where(hit, 1.0 - hit_s / 4.0, 0.0),
            *(static_m, moving_m / 1.5, possible_m / 1.5),
            *(unknown, left, np.minimum(flown, MOST_COST_S) / 3.0),
        ]
        speed = np.hypot(wishes[:, 0], wishes[:, 1])
        turn = np.arctan2(wishes[:, 1], wishes[:, 0])[:, None] - course
        going = speed > 0.0
        velocity, best = places.velocity, cost.min(axis=0)
        movers = sum(track.moving for track in self._tracks)
        possible = sum(track.possible for track in self._tracks)
        own: list[Any] = [
            speed / 5.0,
            np.cos(turn[:, 0]) * going,
            np.cos(turn[:, 1]) * going,
            np.abs(np.sin(turn[:, 1])) * going,
            np.hypot(*(wishes - self._last).T) / 5.0,
            np.hypot(*(wishes - velocity).T) / 5.0,
            math.hypot(*velocity) / 5.0,
            math.cos(course[0] - course[1]),
            min(math.hypot(*(places.goal - places.position)), 20.0) / 20.0,
            latency_s,
            movers / 4.0,
            possible / 4.0,
            np.minimum(best - best.min(), 10.0) / 5.0,
            min(float(best.min()), 20.0) / 10.0,
        ]
        columns = [row for each in zip(*predicted, strict=True) for row in each]
        columns += [np.broadcast_to(each, len(wishes)) for each in own]
        return np.stack(columns, axis=1)


KINDS = "moving", "possible"
"""Kinds of tracks in a prediction."""


def _rows(tracks: Iterable[Track]) -> Floats:
    """Return position, velocity and radius (m, 5) of tracks."""
    rows = [(*track.position, *track.velocity, track.radius_m) for track in tracks]
    return np.array(rows, np.float64).reshape(-1, 5)


def scan(observation: Observation, above: Floats, band_m: float) -> Scans:
    """Return the scans of an image in layers at heights `above` (l,) the vehicle [m].

    Returns within `band_m` of a layer's height count to it.
    """
    lens, fov = observation.intrinsics, observation.intrinsics.horizontal_fov_rad
    # A bearing is wider than any column, so that a wall leaves none empty.
    bearings = int(fov * lens.focal / 1.1)
    half = math.atan2(0.5 * lens.height, lens.focal)
    half -= abs(math.sin(0.5 * fov) * float(observation.roll))
    edges = np.array([observation.pitch - half, observation.pitch + half])
    lowest, highest = np.tan(np.clip(edges, -1.25, 1.25)).tolist()
    slopes = max(1, int((highest - lowest) * lens.focal / 1.1))
    per_slope = slopes / max(highest - lowest, 1e-3)
    ranges, rays = np.full((len(above), bearings), np.inf), np.full((bearings, slopes), np.inf)
    points = level_points(observation)
    _kernels().scan_layers(points, above, band_m, fov, lowest, per_slope, ranges, rays)
    return Scans(above, ranges, lowest, per_slope, rays)

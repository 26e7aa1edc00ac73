"""Collision prevention: distance CP_DIST to obstacles in Position mode.

OBSTACLE_DISTANCE reports obstacles in bins around the vehicle. Bins without data are avoided unless
CP_GO_NO_DATA permits them; without any data the vehicle stops.

Source: PX4 1.16, lib/collision_prevention: CollisionPrevention and ObstacleMath. As in PX4, the map
is in the body frame and is not rotated between messages. This vehicle has no DISTANCE_SENSOR.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, Q
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import FlightContext, ObstacleBins
from firmware_sim.autopilot.modes.sticks import Pair, Position
from firmware_sim.autopilot.smooth_trajectory import braking_speed

BINS = 72
BIN_DEG = 360.0 / BINS
"""Width of a bin [deg]. Bin 0 is straight ahead; indices increase clockwise."""

UNKNOWN_CM = 65_535
"""Distance of a bin without data."""

STALE_US = US_PER_S // 2
"""Maximum age of data [µs] (RANGE_STREAM_TIMEOUT_US)."""

GIVE_UP_US = 5 * US_PER_S
"""Timeout without data after which the mode ends in Hold [µs] (TIMEOUT_HOLD_US)."""

_DEFLECTED_M_S2 = 1e-3
"""Minimum acceleration of a deflected stick."""

_M_PER_CM = 0.01


class ObstacleMap:
    """Distance to the nearest obstacle in each body direction, from the newest reports."""

    def __init__(self) -> None:
        """Start without data."""
        self.distances_cm = np.full(BINS, float(UNKNOWN_CM))
        self.seen_us = np.zeros(BINS)
        """Time of each bin's newest report [µs]."""
        self.ranges_cm = np.zeros(BINS)
        """Maximum range of the sensor of each bin [cm]."""
        self.reported = np.zeros(BINS, dtype=bool)
        """True if the bin was ever reported, so lies in a sensor's field of view."""
        self.nearest_cm = UNKNOWN_CM
        """Minimum measurable distance [cm]."""
        self.time_us = 0
        """Time of the newest data [µs]."""

    def take(self, obstacles: ObstacleBins, yaw: float) -> None:
        """Add reported obstacles at a heading [rad]."""
        self.time_us = max(self.time_us, obstacles.time_us)
        # Several sensors share the map: the smallest minimum range applies.
        self.nearest_cm = min(self.nearest_cm, obstacles.nearest_cm)
        # The map turns with the body.
        offset = obstacles.offset_deg - (math.degrees(yaw) if obstacles.in_world else 0.0)
        # Coarse bins need fewer of them for a full turn.
        count = min(BINS, math.ceil(360.0 / obstacles.increment_deg))
        mine = _edges(BINS, BIN_DEG, 0.0)
        reported = _edges(count, obstacles.increment_deg, offset)
        for i, j in np.argwhere(_overlap(mine, reported)).tolist():
            distance_cm = obstacles.distances_cm[j]
            if distance_cm != UNKNOWN_CM and self._replaces(i, distance_cm, obstacles.farthest_cm):
                self.distances_cm[i] = distance_cm
                self.seen_us[i] = self.time_us
                self.ranges_cm[i] = obstacles.farthest_cm
                self.reported[i] = True

    def forget(self, now_us: int) -> None:
        """Discard stale data."""
        self.distances_cm[now_us - self.seen_us > STALE_US] = UNKNOWN_CM

    def has_data(self, now_us: int) -> bool:
        """Return whether there are current data."""
        fresh = now_us - self.time_us < STALE_US
        return fresh and bool((self.distances_cm < UNKNOWN_CM).any())

    def _replaces(self, i: int, reading_cm: float, range_cm: float) -> bool:
        """Return whether a reading is used (`_enterData`).

        Among sensors with an obstacle in range, the shortest range takes precedence; among the
        others, the longest.
        """
        before_in_range = self.distances_cm[i] < self.ranges_cm[i]
        if reading_cm < range_cm:
            return bool(not before_in_range or range_cm <= self.ranges_cm[i])
        if before_in_range:
            return bool(range_cm == self.ranges_cm[i])
        return bool(range_cm >= self.ranges_cm[i])


class CollisionPrevention:
    """Limiter for the acceleration commanded by the sticks."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Start without data; `value` is the look-up for PX4 parameters."""
        self._value = value
        self.map = ObstacleMap()
        self._taken: ObstacleBins | None = None
        self._active_us: int | None = None
        """Time of activation [µs]."""
        self.gives_up = False
        """True if data have been missing for `GIVE_UP_US` and the mode must end."""

    @property
    def is_on(self) -> bool:
        """True if enabled by CP_DIST."""
        return self._value("CP_DIST") > 0.0

    def rest(self) -> None:
        """Record that collision prevention is inactive."""
        self._active_us, self.gives_up = None, False

    def constrain(
        self,
        commanded: tuple[float, float],
        velocity: tuple[float, float],
        obstacles: ObstacleBins | None,
        yaw: float,
        now_us: int,
    ) -> tuple[float, float]:
        """Return the permitted acceleration (north, east) [m/s²].

        Args:
            commanded: Acceleration commanded by the sticks, north and east [m/s²].
            velocity: Velocity setpoint, north and east [m/s].
            obstacles: Newest report; None = none yet.
            yaw: Heading [rad].
            now_us: Current time [µs].
        """
        self._active_us = now_us if self._active_us is None else self._active_us
        fresh = obstacles is not None and now_us - obstacles.time_us < STALE_US
        # A report is entered once: entering it again would refresh its age.
        if obstacles is not None and obstacles is not self._taken and fresh:
            self._taken = obstacles
            self.map.take(obstacles, yaw)
        # Discard after entering, so that a new report is not judged by its predecessor's age.
        self.map.forget(now_us)
        if not self.map.has_data(now_us):
            # Without data no direction is permitted.
            since_us = max(self.map.time_us, self._active_us)
            self.gives_up = now_us - since_us > GIVE_UP_US
            return 0.0, 0.0
        length = math.hypot(*commanded)
        # Released sticks have no direction; the position hold brakes.
        if length <= _DEFLECTED_M_S2:
            return commanded
        directions = yaw + np.radians(BIN_DEG * np.arange(BINS))
        bins = np.stack([np.cos(directions), np.sin(directions)], axis=1)
        index, direction = self._guided(np.array(commanded) / length, yaw, bins)
        allowed = np.zeros(2)
        if self._is_feasible(index):
            allowed = length * self._scaled(direction, yaw, bins)
        north, east = (allowed + self._braking(np.array(velocity), bins, now_us)).tolist()
        return north, east

    @property
    def _keep_m(self) -> float:
        """Minimum distance to keep [m]."""
        return max(_M_PER_CM * self.map.nearest_cm, self._value("CP_DIST"))

    def _guided(self, direction: Vector, yaw: float, bins: Vector) -> tuple[int, Vector]:
        """Return bin and direction, turned by up to CP_GUIDE_ANG towards more space."""
        ahead = math.degrees(math.atan2(direction[1], direction[0]) - yaw) % 360.0
        requested = best = int(ahead // BIN_DEG)
        distances, keep_cm = self.map.distances_cm, 100.0 * self._value("CP_DIST")
        # Unknown space is assumed to be as near as CP_DIST: neither attractive nor blocking.
        assumed = np.where(distances == UNKNOWN_CM, keep_cm, distances)
        least, most = math.inf, int(self._value("CP_GUIDE_ANG") // BIN_DEG)
        for aside in range(-most, most + 1):
            i = (requested + aside) % BINS
            mean = (assumed[i - 1] + assumed[i] + assumed[(i + 1) % BINS]) / 3.0
            # Turning away from the stick costs half of CP_DIST per bin, so small gains are ignored.
            cost = 0.5 * keep_cm * abs(aside) - mean - distances[i]
            if cost < least and distances[i] != UNKNOWN_CM:
                least, best = cost, i
        return (requested, direction) if best == requested else (best, bins[best])

    def _is_feasible(self, index: int) -> bool:
        """Return whether the requested direction has data, or may lack them."""
        if self.map.distances_cm[index] != UNKNOWN_CM:
            return True
        return bool(self._value("CP_GO_NO_DATA")) and not self.map.reported[index]

    def _scaled(self, direction: Vector, yaw: float, bins: Vector) -> Vector:
        """Return a direction, shortened by its component towards the closest obstacle."""
        closest = int(np.argmin(self.map.distances_cm))
        towards = bins[closest]
        share = float(direction @ towards)
        # Motion away from the closest obstacle is free.
        if share <= 0.0:
            return direction
        normal = share * towards
        tangential = direction - normal
        beside_m = 0.0
        # Straight towards the obstacle there is no tangential direction.
        if np.linalg.norm(tangential) > 1e-6:
            angle = math.degrees(math.atan2(tangential[1], tangential[0]) - yaw) % 360.0
            beside_m = _M_PER_CM * self.map.distances_cm[round(angle / BIN_DEG) % BINS]
        ahead_m = _M_PER_CM * float(self.map.distances_cm[closest])
        scaled: Vector = tangential * self._scale(beside_m) + normal * self._scale(ahead_m)
        return scaled

    def _scale(self, distance_m: float) -> float:
        """Return the share of an acceleration towards an obstacle at a distance; negative: away."""
        keep_m = self._keep_m
        over_m = distance_m - keep_m
        # Distance over which the position controller reaches full speed.
        reach_m = max(keep_m, self._value("MPC_VEL_MANUAL") / self._value("MPC_XY_P"))
        return min(1.0, (over_m / reach_m) ** 2 if over_m > 0.0 else over_m)

    def _braking(self, velocity: Vector, bins: Vector, now_us: int) -> Vector:
        """Return the acceleration (2,) that preserves the stopping distance."""
        value, obstacles = self._value, self.map
        hardest, away = math.inf, np.zeros(2)
        for i in range(BINS):
            distance_cm = float(obstacles.distances_cm[i])
            # Below the minimum range a distance is a sensor artefact.
            if not obstacles.nearest_cm < distance_cm < UNKNOWN_CM:
                continue
            towards = max(0.0, float(velocity @ bins[i]))
            # The vehicle flies on during the sensor's delay and the age of the reading.
            delayed_m = towards * value("CP_DELAY")
            if distance_cm < obstacles.ranges_cm[i]:
                delayed_m += towards * (now_us - float(obstacles.seen_us[i])) / US_PER_S
            left_m = _M_PER_CM * distance_cm - self._keep_m - delayed_m
            most = 0.0
            if left_m >= 0.0:
                most = braking_speed(left_m, value("MPC_ACC_HOR"), value("MPC_JERK_MAX"))
            brake = value("MPC_XY_VEL_P_ACC") * min(most - towards, 0.0)
            # Only the most urgent direction brakes: a sum over neighbouring bins would count an
            # obstacle several times.
            if brake < hardest:
                hardest, away = brake, bins[i]
        braked: Vector = hardest * away if math.isfinite(hardest) else away
        return braked


class GuardedPosition(Position, modes=(Mode.POSITION,)):
    """Position mode with collision prevention."""

    prevents_collisions = True

    def __init__(self, context: FlightContext, /) -> None:
        super().__init__(context)
        self._prevention = CollisionPrevention(context.value)

    def _restart(self, state: Vector) -> None:
        super()._restart(state)
        self._prevention.rest()

    def _limiter(self, state: Vector, /) -> Callable[[Pair, Pair], Pair] | None:
        prevention = self._prevention
        if not prevention.is_on:
            prevention.rest()
            return None
        return partial(
            prevention.constrain,
            obstacles=self._context.obstacles,
            yaw=quat_yaw(state[Q:RATES]),
            now_us=self._time_us or 0,
        )

    def is_done(self, _state: Vector, /) -> bool:
        """Return whether obstacle data have been missing too long to permit steering."""
        return self._prevention.gives_up


def _edges(count: int, width_deg: float, offset_deg: float) -> Vector:
    """Return the lower and upper edge (count, 2) [deg] of bins; lower edges are in -360..360."""
    numbers = np.arange(count)
    per_turn = 360.0 / width_deg
    lower = (np.mod(numbers, per_turn) * width_deg + offset_deg - 0.5 * width_deg) % 360.0
    upper = (np.mod(numbers + 1, per_turn) * width_deg + offset_deg - 0.5 * width_deg) % 360.0
    return np.stack([np.where(lower > upper, lower - 360.0, lower), upper], axis=1)


def _overlap(mine: Vector, reported: Vector) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return the overlap (n, m) of the map's bins (n, 2) with the reported bins (m, 2)."""
    lower, upper = mine[:, None, 0], mine[:, None, 1]
    low, high = reported[None, :, 0], reported[None, :, 1]
    begins = (low > lower) & (low < upper)
    ends = (high > lower) & (high < upper)
    around = (low <= lower) & (high >= upper)
    within = (low >= lower) & (high <= upper)
    found: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = begins | ends | around | within
    return found

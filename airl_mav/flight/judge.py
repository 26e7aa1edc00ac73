"""The referee: when an episode ends, and how it is judged."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.core.fields import quantity
from airl_mav.core.goals import Goal, goal_distance_m

GOAL_RADIUS_M = 3.0
"""Default goal radius [m]: that of the paper's code, seen from above."""

TIME_LIMIT_S = 120.0
"""Default longest flight from the start of navigation [s]. The paper's code counts 750 steps; its
slowest policies took 48 s on average."""

GoalRadius = Annotated[
    float,
    quantity(
        "the goal is reached closer than this: seen from above, without a height",
        "m",
        ge=0.2,
        le=50,
    ),
]
TimeLimit = Annotated[
    float, quantity("longest flight from the start of navigation", "s", ge=1, le=3600)
]


class Outcome(str, Enum):
    """How an episode ended."""

    SUCCESS = "success"
    COLLISION = "collision"
    TIMEOUT = "timeout"
    BATTERY = "battery"
    ABORTED = "aborted"


@dataclass(frozen=True)
class Task:
    """What a flight has to do."""

    goal: Goal
    """North, east [m], and down where it has a height."""
    goal_radius_m: float
    """The goal is reached closer than this: seen from above, if it has no height [m]."""
    time_limit_s: float
    """Longest time from the start of navigation [s]."""


class TruthSample(NamedTuple):
    """What the referee sees of the true state."""

    time_us: int
    """Simulated time [µs]."""
    position: tuple[float, float, float]
    """NED [m]."""
    collision: str | None
    """What was hit, None so far; latched by the plant."""
    battery_remaining: float
    """Charge left, 1 to 0."""


@dataclass(frozen=True)
class Verdict:
    """How and when an episode ended."""

    outcome: Outcome
    reason: str
    time_us: int
    """Simulated time of the sample that decided [µs]."""


class Referee:
    """Judges one episode from its true samples. Pure: no clock, no randomness.

    The tests, in this order (that of the paper's code, with its missing battery test): goal,
    collision, battery, time limit. The goal and the time limit count from the start of navigation.
    A collision or an empty battery ends the take-off too. The first verdict stands.
    """

    def __init__(self, task: Task) -> None:
        """Take the task. Raises ValueError when no flight could fulfil it."""
        if not task.goal_radius_m > 0.0:
            raise ValueError(f"goal_radius_m={task.goal_radius_m}: must be > 0")
        if not task.time_limit_s > 0.0:
            raise ValueError(f"time_limit_s={task.time_limit_s}: must be > 0")
        self.task = task
        self.navigation_us: int | None = None
        """When navigation began [µs]; None during the take-off."""
        self.verdict: Verdict | None = None

    def start_navigation(self, time_us: int) -> None:
        """Say that take-off is over and the policy flies. Raises ValueError when said twice."""
        if self.navigation_us is not None:
            raise ValueError(f"navigation already began at {self.navigation_us} µs")
        self.navigation_us = time_us

    def abort(self, time_us: int, reason: str) -> Verdict:
        """End the episode for a reason outside the flight: a crash, Ctrl-C, a lost process."""
        if self.verdict is None:
            self.verdict = Verdict(Outcome.ABORTED, reason, time_us)
        return self.verdict

    def observe(self, sample: TruthSample) -> Verdict | None:
        """Take the next sample; return the verdict once there is one."""
        if self.verdict is None:
            found = self._judge(sample)
            if found is not None:
                self.verdict = Verdict(*found, sample.time_us)
        return self.verdict

    def _judge(self, sample: TruthSample) -> tuple[Outcome, str] | None:
        """Return outcome and reason of this sample, if it decides."""
        task = self.task
        flying = self.navigation_us is not None and sample.time_us >= self.navigation_us
        if flying:
            distance = goal_distance_m(task.goal, sample.position)
            if distance < task.goal_radius_m:
                return Outcome.SUCCESS, f"{distance:.2f} m from the goal"
        if sample.collision is not None:
            phase = "" if flying else " during the take-off"
            return Outcome.COLLISION, f"hit {sample.collision}{phase}"
        if sample.battery_remaining <= 0.0:
            return Outcome.BATTERY, "battery empty"
        if flying and sample.time_us - (self.navigation_us or 0) >= task.time_limit_s * US_PER_S:
            return Outcome.TIMEOUT, f"{distance:.2f} m from the goal after {task.time_limit_s:g} s"
        return None

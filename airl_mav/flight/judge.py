"""Referee: ends an episode and returns its verdict."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.core.fields import quantity
from airl_mav.core.frames import Goal, goal_distance_m

GOAL_RADIUS_M = 3.0
"""Default goal radius [m], from the paper's code; horizontal distance."""

TIME_LIMIT_S = 120.0
"""Default maximum flight time from the start of navigation [s]. The paper's code counts 750 steps;
its slowest policies took 48 s on average."""

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
    """Result of an episode."""

    SUCCESS = "success"
    COLLISION = "collision"
    TIMEOUT = "timeout"
    BATTERY = "battery"
    ABORTED = "aborted"


@dataclass(frozen=True)
class Task:
    """Task of a flight."""

    goal: Goal
    """North, east [m], and down for a goal with a height."""
    goal_radius_m: float
    """Goal radius [m]: horizontal distance for a goal without a height."""
    time_limit_s: float
    """Maximum time from the start of navigation [s]."""


class TruthSample(NamedTuple):
    """True state for the referee."""

    time_us: int
    """Simulated time [µs]."""
    position: tuple[float, float, float]
    """NED [m]."""
    collision: str | None
    """Name of the hit object, None before a collision; latched by the plant."""
    battery_remaining: float
    """Remaining charge, 1 to 0."""


@dataclass(frozen=True)
class Verdict:
    """Result of an episode, its reason and time."""

    outcome: Outcome
    reason: str
    time_us: int
    """Simulated time of the deciding sample [µs]."""


class Referee:
    """Judges one episode from its true samples. Pure: no clock, no randomness.

    Tests in order, as in the paper's code, which lacks the battery test: goal, collision, battery,
    time limit. The goal and the time limit count from the start of navigation. A collision or an
    empty battery also ends the take-off. The first verdict is final.
    """

    def __init__(self, task: Task) -> None:
        """Take the task. Raises ValueError for an impossible task."""
        if not task.goal_radius_m > 0.0:
            raise ValueError(f"goal_radius_m={task.goal_radius_m}: must be > 0")
        if not task.time_limit_s > 0.0:
            raise ValueError(f"time_limit_s={task.time_limit_s}: must be > 0")
        self.task = task
        self.navigation_us: int | None = None
        """Start of navigation [µs]; None during the take-off."""
        self.verdict: Verdict | None = None

    def start_navigation(self, time_us: int) -> None:
        """Start navigation: the policy takes over. Raises ValueError on a second call."""
        if self.navigation_us is not None:
            raise ValueError(f"navigation already began at {self.navigation_us} µs")
        self.navigation_us = time_us

    def abort(self, time_us: int, reason: str) -> Verdict:
        """End the episode for an external reason: a crash, Ctrl-C, a lost process."""
        if self.verdict is None:
            self.verdict = Verdict(Outcome.ABORTED, reason, time_us)
        return self.verdict

    def observe(self, sample: TruthSample) -> Verdict | None:
        """Process the next sample; return the verdict, or None before it."""
        if self.verdict is None:
            found = self._judge(sample)
            if found is not None:
                self.verdict = Verdict(*found, sample.time_us)
        return self.verdict

    def _judge(self, sample: TruthSample) -> tuple[Outcome, str] | None:
        """Return outcome and reason of this sample, or None."""
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

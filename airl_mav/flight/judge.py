"""Referee: ends an episode and returns its verdict. Validity: a test, or disturbed by the host.

Flights paced by the wall clock share a machine with other programs. An overloaded host or another
client's commands invalidate a flight. Invalid flights are repeated, and never counted silently.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.fields import quantity
from airl_mav.core.frames import Goal, goal_distance_m
from airl_mav.latency.stamps import NO_STAMP

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
        # Samples may arrive after the start of navigation, but be older.
        flying = self.navigation_us is not None and sample.time_us >= self.navigation_us
        if flying:
            distance = goal_distance_m(task.goal, sample.position)
            # Goal first: a vehicle that reaches the goal and hits it in the same sample has
            # succeeded.
            if distance < task.goal_radius_m:
                return Outcome.SUCCESS, f"{distance:.2f} m from the goal"
        if sample.collision is not None:
            phase = "" if flying else " during the take-off"
            return Outcome.COLLISION, f"hit {sample.collision}{phase}"
        # Before the time limit: an empty battery explains a slow flight.
        if sample.battery_remaining <= 0.0:
            return Outcome.BATTERY, "battery empty"
        if flying and sample.time_us - (self.navigation_us or 0) >= task.time_limit_s * US_PER_S:
            return Outcome.TIMEOUT, f"{distance:.2f} m from the goal after {task.time_limit_s:g} s"
        return None


BY_HAND = "latency or compensation was changed by hand"
"""Invalidity reason after a manual change in flight."""

STRANGER = "commanded by a stranger"
"""Invalidity reason if a sender other than the companion acted on the vehicle; `Effect` follows."""


@dataclass(frozen=True)
class Effect:
    """Messages of one sender and type that took effect on the vehicle."""

    link: str
    """Name of the link: `onboard`, `gcs`, `payload`, `gimbal`."""
    peer: str
    """HOST:PORT of the sender; empty for the link's preset remote."""
    system: int
    component: int
    message: str
    """MAVLink message, with its MAV_CMD, or the name of the parameter that it changed."""
    count: int
    first_us: int
    """Simulated time of the first message [µs]."""
    is_companion: bool
    """True for the flight's own companion, the only sender that every scenario expects."""
    old: float | None = None
    """Value of the parameter, or size of the plan, before the first message; None: no change."""
    new: float | None = None
    """Value or size after the last message."""

    def line(self, started_us: int) -> str:
        """Return the effect on one line, with its time after the reset at `started_us` [µs]."""
        where = f"{self.link} {self.peer}".rstrip()
        changed = "" if self.old is None else f" from {self.old:.7g} to {self.new:.7g}"
        times = "once" if self.count == 1 else f"{self.count} times"
        after_s = (self.first_us - started_us) / US_PER_S
        return (
            f"{where}, system {self.system} component {self.component}, {self.message}{changed}"
            f" ({times}, first {after_s:.1f} s after the reset)"
        )


LATE_FRAMES = 3.0
"""Delay limit in camera periods, for a frame's age at its decision, and for a decision's start
after the previous hold time. With a fast host the delay is one period plus transport."""


@dataclass(frozen=True)
class HostFigures:
    """Disturbance of a flight by the host. None without data."""

    given_up: float
    """Skipped simulated time, as a share of the flight."""
    tick_lateness_ms: float | None
    """99th percentile of the ticks' start delay [simulated ms]."""
    speed: float | None
    """Simulated seconds per wall second, as a share of the requested speed."""
    stale_frames: float | None
    """Share of decisions on a frame older than `LATE_FRAMES` camera periods."""
    late_decisions: float | None
    """Share of decisions that began more than `LATE_FRAMES` camera periods after the hold time."""


class Rule(NamedTuple):
    """Bound that a flight must keep to be valid."""

    figure: str
    """Field of `HostFigures`."""
    limit: float
    least: bool
    """True for a minimum, False for a maximum."""
    scale: float
    """Factor from the figure to the unit of the text."""
    text: str
    """Problem description, with placeholders for the figure and the limit."""


RULES = (
    Rule(
        "given_up", 0.01, False, 100.0, "{:.1f} % of its simulated time was given up (limit {:g} %)"
    ),
    Rule("tick_lateness_ms", 40.0, False, 1.0, "1 % of ticks began {:.0f} ms late (limit {:g} ms)"),
    Rule("speed", 0.95, True, 100.0, "flown at {:.0f} % of the speed asked for (limit {:g} %)"),
    Rule(
        "stale_frames",
        0.05,
        False,
        100.0,
        "{:.0f} % of decisions were on a camera frame missed by the host (limit {:g} %)",
    ),
    Rule(
        "late_decisions",
        0.05,
        False,
        100.0,
        "{:.0f} % of decisions were paced too late (limit {:g} %)",
    ),
)
"""Validity rules. Ticks are 4 ms apart and camera frames mostly 33 ms. A decision moves a vehicle
at 4 m/s by 0.16 m in 40 ms, a tenth of its effect in a hold time of 0.5 s."""


def host_figures(
    *,
    flight_us: int,
    slipped_us: int,
    wall_s: float | None,
    speed: float | None,
    lateness_us: NDArray[np.int64],
    decisions: Mapping[str, NDArray[Any]],
    frame_period_us: int,
    excused: Sequence[tuple[int, int]] = (),
) -> HostFigures:
    """Return the disturbance of a flight by the host, in simulated time.

    `flight_us` is the time from the reset to the verdict, without skipped time, `slipped_us`;
    `wall_s` is the wall time, None without pacing. `lateness_us` (n,) is the start delay of each
    tick. `decisions` has stamps by column, as in `latency.npz`. `excused` are intervals in which
    requested faults or slow images may delay decisions: faults of the camera, a link or a process.
    """
    whole_us, late_us = flight_us + slipped_us, LATE_FRAMES * frame_period_us
    began_us, held_us = decisions.get("infer_start_us"), decisions.get("held_until_us")
    # Without decisions there is nothing to disturb.
    stale = late = None
    if began_us is not None and "capture_us" in decisions:
        stale = _share_beyond(decisions["capture_us"], began_us, late_us, excused)
    if began_us is not None and held_us is not None:
        # The end of each hold time, and the start of the next decision.
        late = _share_beyond(held_us[:-1], began_us[1:], late_us, excused)
    # A high percentile: one late tick is harmless, one in a hundred shows an overloaded host.
    ticks = lateness_us.size
    return HostFigures(
        given_up=slipped_us / whole_us if whole_us > 0 else 0.0,
        tick_lateness_ms=float(np.percentile(lateness_us, 99.0)) / US_PER_MS if ticks else None,
        speed=flight_us / US_PER_S / (wall_s * speed) if wall_s and speed else None,
        stale_frames=stale,
        late_decisions=late,
    )


def host_faults(figures: HostFigures) -> tuple[str, ...]:
    """Return the reasons why a flight disturbed by the host is invalid."""
    faults = []
    for rule in RULES:
        value = getattr(figures, rule.figure)
        if value is None:
            continue
        if value < rule.limit if rule.least else value > rule.limit:
            faults.append(rule.text.format(rule.scale * value, rule.scale * rule.limit))
    return tuple(faults)


def _share_beyond(
    first: NDArray[np.int64],
    last: NDArray[np.int64],
    limit_us: float,
    excused: Sequence[tuple[int, int]],
) -> float | None:
    """Return the share of intervals over a limit, without excused times; None: no interval."""
    # Decisions without a frame or an end have no interval.
    both = (first != NO_STAMP) & (last != NO_STAMP)
    for from_us, to_us in excused:
        # An interval that touches an excused time is left out entirely.
        both &= (last < from_us) | (first > to_us)
    if not both.any():
        return None
    return float(np.mean((last - first)[both] > limit_us))

"""Rewards of a decision, for n vehicles at a time.

`shaped` is the default. `timed` is for decisions of unequal length, as latencies that vary make
them: it charges the time, not the decision, and a failure three times as much. `progress` is for
policies that decide with every image: progress is most of it; `paced` the same without haste.
`paper` is the paper's equation 2 to the letter: it does not train, its terms being a thousand times
too large for any learner with a usual scale. `paper-scaled` is the same divided by 1000. Any other
is the user's: a function of a `Step`, or a class, made without arguments, whose object is one.
`costs` are taken off any of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import plugins
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs.fleet import Verdict
from airl_mav.envs.navigation import Flights
from airl_mav.envs.spec import Costs
from airl_mav.policy.action_sets import PAPER_SPEED_M_S
from airl_mav.policy.actions import BodyRates

PROGRESS_1_M = 0.02
"""`shaped`: per metre of progress towards the goal; 50 m of it are worth as much as the goal."""

DECISION_COST = 0.005
"""`shaped`: cost of every decision, so that faster is better."""

TIME_COST_1_S = 0.015
"""`timed`: cost of a second of flight."""

FAILURE_COST = 3.0
"""`timed`: cost of a collision or an empty battery; the goal is worth 1."""

AGILE_BONUS = 4.0
"""`progress`: of the goal, and what a failure costs."""

AGILE_1_M, AGILE_1_S, AGILE_TURN = 0.3, 0.1, 0.002
"""`progress`: per metre of progress, per second, and per (rad/s)² that a decision commands."""

PACE_M_S, PACE_SPREAD_M_S = 4.0, 12.0
"""`paced`: progress beyond that speed is worth nothing, and up to it the less the faster."""

PAPER_BONUS = 1000.0

J_PER_KJ = 1000.0


@dataclass(frozen=True)
class Step:
    """A decision of n vehicles, as it was flown: all that a reward may depend on."""

    before: Flights
    """At the decision."""
    now: Flights
    """At its end."""
    commands: NDArray[np.float64]
    """(n, 3) forward and right [m/s] in the heading frame, yaw rate [rad/s]; of actions that
    command body rates (n, 4), as `policy.actions.BodyRates`."""
    hold_s: float
    """How long an action is held [s]."""

    @property
    def success(self) -> NDArray[np.bool_]:
        """(n,) the goal is reached."""
        reached: NDArray[np.bool_] = self.now.verdict == Verdict.SUCCESS
        return reached

    @property
    def failure(self) -> NDArray[np.bool_]:
        """(n,) a collision, or an empty battery. A timeout is no failure."""
        verdict = self.now.verdict
        failed: NDArray[np.bool_] = (verdict == Verdict.COLLISION) | (verdict == Verdict.BATTERY)
        return failed

    @property
    def progress_m(self) -> NDArray[np.float64]:
        """(n,) how much nearer the goal has come [m]."""
        return self.before.goal_distance_m - self.now.goal_distance_m


Reward = Callable[[Step], NDArray[np.float64]]
"""Returns the rewards (n,) of a decision, of each vehicle from its own row alone."""


def shaped(step: Step) -> NDArray[np.float64]:
    """Return 1 for the goal, -1 for a failure, a little for progress, less for the time."""
    return _ended(step) + PROGRESS_1_M * step.progress_m - DECISION_COST


def timed(step: Step) -> NDArray[np.float64]:
    """Return 1 for the goal, -3 for a failure, a little for progress, less for every second."""
    passed_s = step.now.time_s - step.before.time_s
    ended = step.success - FAILURE_COST * step.failure
    return ended + PROGRESS_1_M * step.progress_m - TIME_COST_1_S * passed_s


def progress(step: Step) -> NDArray[np.float64]:
    """Return 4 for the goal, -4 for a failure, much for progress, less for time and turning.

    For policies that decide with every image, as those that command body rates. Source: Song et
    al., Autonomous Drone Racing with Deep Reinforcement Learning, IROS 2021, eq. 3. For other
    actions the turn is the yaw rate.
    """
    passed_s = step.now.time_s - step.before.time_s
    ended = AGILE_BONUS * _ended(step) - AGILE_TURN * _turned(step)
    found: NDArray[np.float64] = ended + AGILE_1_M * step.progress_m - AGILE_1_S * passed_s
    return found


def paced(step: Step) -> NDArray[np.float64]:
    """Return as `progress`, but for no haste: for policies that must see obstacles in time.

    Time costs nothing, progress is paid up to 4 m/s, and the less of it the faster the vehicle
    flies, none from 16 m/s on. Where haste pays, full thrust is learnt first: then nothing is seen
    but the ground, and no gradient leads back from beyond the range of an action.
    """
    passed_s = step.now.time_s - step.before.time_s
    worth = np.clip(1.0 - (step.now.speed_m_s - PACE_M_S) / PACE_SPREAD_M_S, 0.0, 1.0)
    nearer_m = np.minimum(step.progress_m, PACE_M_S * passed_s) * worth
    found: NDArray[np.float64] = (
        AGILE_BONUS * _ended(step) + AGILE_1_M * nearer_m - AGILE_TURN * _turned(step)
    )
    return found


def paper(step: Step) -> NDArray[np.float64]:
    """Return r = 1000 a - 1000 b - D_g + g D_c (Krishnan et al. 2021, appendix B, eqs. 2, 3).

    a: goal reached, b: collision, D_g: distance to the goal, D_c = (V_max - V_now) t_max with
    t_max the time an action is held, g: 1 when closer to the goal than before.

    As printed, D_c is added, and only on the way to the goal: it pays slowness there, although
    the text calls it a penalty on speeding away. V_max is 5 m/s whatever the action set; who is
    faster pays. Running out of time costs nothing, and every decision costs its distance.
    """
    before_m, now_m = step.before.goal_distance_m, step.now.goal_distance_m
    correction = (PAPER_SPEED_M_S - step.now.speed_m_s) * step.hold_s
    paid: NDArray[np.float64] = PAPER_BONUS * _ended(step) - now_m + (now_m < before_m) * correction
    return paid


def paper_scaled(step: Step) -> NDArray[np.float64]:
    """Return `paper`, divided by 1000."""
    return paper(step) / PAPER_BONUS


def _turned(step: Step) -> NDArray[np.float64]:
    """Return the squares (n,) of the rates that are commanded [rad²/s²]."""
    by_rates = step.commands.shape[1] == len(BodyRates._fields)
    rates = step.commands[:, :3] if by_rates else step.commands[:, 2:]
    squares: NDArray[np.float64] = np.square(rates).sum(axis=1)
    return squares


def _ended(step: Step) -> NDArray[np.float64]:
    return step.success.astype(np.float64) - step.failure


SHIPPED: dict[str, Reward] = {
    "shaped": shaped,
    "timed": timed,
    "progress": progress,
    "paced": paced,
    "paper-scaled": paper_scaled,
    "paper": paper,
}


def reward_of(name: str) -> Reward:
    """Return a reward by its name; one of the user's is loaded, and held to give (n,) numbers.

    Raises:
        FieldError: There is no such reward, or it cannot be made.
    """
    if name in SHIPPED:
        return SHIPPED[name]
    found = plugins.load_part(plugins.REWARDS, name)
    try:
        own = found() if isinstance(found, type) else found
    except Exception as error:
        problem = f"cannot be made without arguments: {type(error).__name__}: {error}"
        raise FieldError(plugins.REWARDS.field, name, problem=problem) from error
    if not callable(own):
        raise FieldError(plugins.REWARDS.field, name, plugins.REWARDS.wanted)
    return _Checked(name, own)


class _Checked:
    """A reward of the user's whose numbers a learner can take."""

    def __init__(self, name: str, own: Callable[[Step], Any]) -> None:
        self._name = name
        self._own = own

    def __call__(self, step: Step) -> NDArray[np.float64]:
        """Return the rewards (n,). Raises UsageError for anything else."""
        n = len(step.now.verdict)
        paid = np.asarray(self._own(step), np.float64)
        if paid.shape != (n,) or not np.isfinite(paid).all():
            found = f"an array {paid.shape}" if paid.shape != (n,) else "what is no number"
            raise UsageError(f"reward {self._name!r}: gives {found}; accepted: ({n},) numbers")
        return paid


def costs(weights: Costs, last: NDArray[np.float64], step: Step) -> NDArray[np.float64]:
    """Return what a decision costs (n,), to be taken off its reward.

    Args:
        weights: What is how dear.
        last: (n, 3) the commands that flew until now: forward, right [m/s], yaw rate [rad/s]; zero
            at the start of a flight, and where the watchdog has let the vehicle hover.
        step: The decision.
    """
    change = np.abs(step.commands - last)
    found: NDArray[np.float64] = weights.command_step * np.hypot(change[:, 0], change[:, 1])
    found += weights.turn_step * change[:, 2]
    found += weights.energy * (step.now.energy_j - step.before.energy_j) / J_PER_KJ
    found += weights.failure * step.failure
    return found

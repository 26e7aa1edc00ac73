"""Rewards of a decision, for n vehicles at a time.

`shaped` is the default. `timed` is for decisions of varying duration, as with random latencies: it
charges time instead of decisions, and three times as much for a failure. `progress` is for policies
that decide on every image: progress dominates; `paced` is the same without a time cost. `paper` is
equation 2 of the paper, unchanged: it does not train, because its terms are a thousand times too
large for learners of usual scale. `paper-scaled` is `paper` divided by 1000. Custom rewards are
functions of a `Step`, or classes without constructor arguments whose objects are such functions.
`costs` are subtracted from any reward.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import plugins
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.kernels import kernel
from airl_mav.envs.fleet import FlightArrays, FlightStatus
from airl_mav.envs.spec import SHIPPED_REWARDS, Costs
from airl_mav.policy.actions import PAPER_SPEED_M_S, BodyRates

PROGRESS_1_M = 0.02
"""`shaped`: reward per metre of progress towards the goal; 50 m equal the goal's reward."""

DECISION_COST = 0.005
"""`shaped`: cost per decision, so that faster is better."""

TIME_COST_1_S = 0.015
"""`timed`: cost per second of flight."""

FAILURE_COST = 3.0
"""`timed`: cost of a collision or an empty battery; the goal's reward is 1."""

AGILE_BONUS = 4.0
"""`progress`: reward of the goal, and cost of a failure."""

AGILE_1_M, AGILE_1_S, AGILE_TURN = 0.3, 0.1, 0.002
"""`progress`: weights per metre of progress, per second, and per (rad/s)² of commanded rates."""

PACE_M_S, PACE_SPREAD_M_S = 4.0, 12.0
"""`paced`: speed limit of rewarded progress; range above it over which progress loses weight."""

PAPER_BONUS = 1000.0

J_PER_KJ = 1000.0

_SHAPED, _TIMED, _PROGRESS, _PACED, _, _PAPER = range(len(SHIPPED_REWARDS))
_SUCCESS, _COLLISION = int(FlightStatus.SUCCESS), int(FlightStatus.COLLISION)
_BATTERY = int(FlightStatus.BATTERY)


@dataclass(frozen=True)
class Step:
    """Decision of n vehicles as executed; the input of a reward."""

    before: FlightArrays
    """Status at the start of the decision."""
    now: FlightArrays
    """Status at the end of the decision."""
    commands: NDArray[np.float64]
    """(n, 3) forward and right [m/s] in the heading frame, yaw rate [rad/s]; for body rate actions
    (n, 4), as `policy.actions.BodyRates`."""
    hold_s: float
    """Hold time of an action [s]."""

    @property
    def success(self) -> NDArray[np.bool_]:
        """(n,) True if the goal is reached."""
        reached: NDArray[np.bool_] = self.now.verdict == FlightStatus.SUCCESS
        return reached

    @property
    def failure(self) -> NDArray[np.bool_]:
        """(n,) True for a collision or an empty battery; False for a timeout."""
        verdict = self.now.verdict
        failed: NDArray[np.bool_] = (verdict == FlightStatus.COLLISION) | (
            verdict == FlightStatus.BATTERY
        )
        return failed

    @property
    def progress_m(self) -> NDArray[np.float64]:
        """(n,) decrease of the distance to the goal [m]."""
        return self.before.goal_distance_m - self.now.goal_distance_m


Reward = Callable[[Step], NDArray[np.float64]]
"""Function from a decision to rewards (n,), each from the vehicle's row only."""


@kernel
def pay(
    name: int, verdict: int, before_m: float, now_m: float, passed_s: float, speed_m_s: float,
    turned: float, hold_s: float,
) -> float:  # fmt: skip
    """Return a built-in reward of one vehicle's decision; a timeout is no failure.

    `name` is the index in `SHIPPED_REWARDS`; `verdict`, distance to the goal `now_m` and
    `speed_m_s` are values at the end of the decision, `before_m` at its start. `turned` is the sum
    of squares of the commanded rates [rad²/s²].
    """
    success = 1.0 if verdict == _SUCCESS else 0.0
    failure = 1.0 if verdict in (_COLLISION, _BATTERY) else 0.0
    ended, nearer_m = success - failure, before_m - now_m
    if name == _SHAPED:
        return ended + PROGRESS_1_M * nearer_m - DECISION_COST
    if name == _TIMED:
        ended = success - FAILURE_COST * failure
        return ended + PROGRESS_1_M * nearer_m - TIME_COST_1_S * passed_s
    if name == _PROGRESS:
        # Song et al., Autonomous Drone Racing with Deep Reinforcement Learning, IROS 2021, eq. 3.
        ended = AGILE_BONUS * ended - AGILE_TURN * turned
        return ended + AGILE_1_M * nearer_m - AGILE_1_S * passed_s
    if name == _PACED:
        # A time cost makes the policy learn full thrust first: then the camera sees only the
        # ground, and the clipped actions have no gradient.
        worth = min(max(1.0 - (speed_m_s - PACE_M_S) / PACE_SPREAD_M_S, 0.0), 1.0)
        # Progress beyond the pace earns nothing, and loses weight at higher speeds.
        nearer_m = min(nearer_m, PACE_M_S * passed_s) * worth
        return AGILE_BONUS * ended + AGILE_1_M * nearer_m - AGILE_TURN * turned
    # Krishnan et al. 2021, appendix B, eqs. 2 and 3: r = 1000 a - 1000 b - D_g + g D_c. As printed,
    # D_c = (V_max - V_now) t_max is added, and only while approaching the goal: it rewards slow
    # flight, but the text calls it a penalty on speeding away. V_max is 5 m/s for every action set.
    correction = (PAPER_SPEED_M_S - speed_m_s) * hold_s
    paid = PAPER_BONUS * ended - now_m + (correction if now_m < before_m else 0.0)
    return paid if name == _PAPER else paid / PAPER_BONUS


def _shipped(name: int, step: Step) -> NDArray[np.float64]:
    """Return `pay` of n vehicles."""
    before, now = step.before, step.now
    # Four columns are body rates and thrust, three are velocities and a yaw rate.
    by_rates = step.commands.shape[1] == len(BodyRates._fields)
    turned = np.square(step.commands[:, :3] if by_rates else step.commands[:, 2:]).sum(axis=1)
    columns = (before.goal_distance_m, now.goal_distance_m, now.time_s - before.time_s)
    rows = np.stack([*columns, now.speed_m_s, turned], axis=1, dtype=np.float64).tolist()
    verdicts = zip(now.verdict.tolist(), rows, strict=True)
    return np.array([pay(name, verdict, *[*row, step.hold_s]) for verdict, row in verdicts])


def reward_of(name: str) -> Reward:
    """Return a reward by name; custom rewards are loaded and checked for n finite values.

    Raises:
        FieldError: Unknown reward, or its construction failed.
    """
    if name in SHIPPED_REWARDS:
        return partial(_shipped, SHIPPED_REWARDS.index(name))
    found = plugins.load_part(plugins.REWARDS, name)
    # A class is instantiated; its objects are the rewards.
    try:
        own = found() if isinstance(found, type) else found
    except Exception as error:
        problem = f"cannot be made without arguments: {type(error).__name__}: {error}"
        raise FieldError(plugins.REWARDS.field, name, problem=problem) from error
    if not callable(own):
        raise FieldError(plugins.REWARDS.field, name, plugins.REWARDS.wanted)
    return _Checked(name, own)


class _Checked:
    """Custom reward with validation of its values."""

    def __init__(self, name: str, own: Callable[[Step], Any]) -> None:
        self._name = name
        self._own = own

    def __call__(self, step: Step) -> NDArray[np.float64]:
        """Return the rewards (n,). Raises UsageError for wrong shapes, NaN and infinity."""
        n = len(step.now.verdict)
        paid = np.asarray(self._own(step), np.float64)
        if paid.shape != (n,) or not np.isfinite(paid).all():
            found = f"an array {paid.shape}" if paid.shape != (n,) else "what is no number"
            raise UsageError(f"reward {self._name!r}: gives {found}; accepted: ({n},) numbers")
        return paid


def costs(weights: Costs, last: NDArray[np.float64], step: Step) -> NDArray[np.float64]:
    """Return the action costs of a decision (n,), to be subtracted from its reward.

    Args:
        weights: Weights of the costs.
        last: (n, 3) previous commands: forward, right [m/s], yaw rate [rad/s]; zero at the start of
            a flight, and after the watchdog's hover.
        step: The decision.
    """
    change = np.abs(step.commands - last)
    found: NDArray[np.float64] = weights.command_step * np.hypot(change[:, 0], change[:, 1])
    found += weights.turn_step * change[:, 2]
    found += weights.energy * (step.now.energy_j - step.before.energy_j) / J_PER_KJ
    found += weights.failure * step.failure
    return found

"""Policies by name."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.errors import UsageError
from airl_mav.policy.actions import Policy
from airl_mav.policy.greedy import GreedyPolicy, GreedySettings

POLICIES: dict[str, tuple[str, Callable[[float], Policy]]] = {
    "greedy": (
        "classical depth-reactive baseline: turn to the goal, steer from near returns, slow down",
        lambda hold_s: GreedyPolicy(GreedySettings(period_s=hold_s)),
    ),
}
"""Name -> description and a maker that takes the time an action is held [s]."""


def policy_description(name: str) -> str:
    """Return one line about a policy. Raises UsageError for an unknown one."""
    _check(name)
    return POLICIES[name][0]


def load_policy(name: str, hold_s: float) -> Policy:
    """Return a policy by name. Raises UsageError for an unknown one, listing those that exist.

    Args:
        name: Its name.
        hold_s: How long each of its actions will be held [s].
    """
    _check(name)
    return POLICIES[name][1](hold_s)


def _check(name: str) -> None:
    if name not in POLICIES:
        raise UsageError(f"--policy {name!r}: no such policy; known: {', '.join(POLICIES)}")

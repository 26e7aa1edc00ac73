"""Python call budget of a decision with few environments, independent of machine load."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from airl_mav.envs.navigation_env import NavigationEnv
from airl_mav.envs.vector import NavigationVectorEnv

MOST_CALLS = {1: 60, 16: 68}
"""Number of environments -> calls of Python and C functions in a step; they may only fall."""

STEPS = 30


def calls_of(env: Any, action: Any) -> float:
    """Return the Python and C calls per step of flights in progress."""
    calls = 0

    def count(_frame: Any, event: str, _of: Any) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    env.reset(seed=3)
    env.step(action)
    for _ in range(STEPS):
        sys.setprofile(count)
        _, _, terminated, truncated, _ = env.step(action)
        sys.setprofile(None)
        assert not np.any(terminated | truncated)
    return calls / STEPS


@pytest.mark.parametrize("n", MOST_CALLS)
def test_a_step_takes_few_calls(n: int) -> None:
    env = NavigationEnv() if n == 1 else NavigationVectorEnv(n)
    # Action 2 hovers in place: no flight ends.
    found = calls_of(env, 2 if n == 1 else np.full(n, 2))
    assert found <= MOST_CALLS[n], f"{found:.1f} calls a step; the budget is {MOST_CALLS[n]}"

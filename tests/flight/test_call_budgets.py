"""Python calls per tick stay within scripts/budgets.toml, on a machine with any load."""

from __future__ import annotations

import pytest
from bench_calls import FLIGHTS, calls_per_tick
from check_budgets import BUDGETS, CALLS, excess, read_budgets


@pytest.mark.slow
@pytest.mark.parametrize("name", FLIGHTS)
def test_calls_per_tick(name: str) -> None:
    measured = calls_per_tick(name, FLIGHTS[name]())
    assert excess({CALLS: measured}, read_budgets(BUDGETS)) == []

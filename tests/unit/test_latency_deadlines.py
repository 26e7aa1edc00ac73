"""Deadline misses: which decisions count, and which of them are late."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.latency.stages import ages_at_effect, deadline_miss_ratio
from airl_mav.latency.stamps import NO_STAMP


@given(st.lists(st.floats(0.0, 2e6), min_size=1, max_size=60), st.floats(1.0, 2e6))
def test_the_share_of_late_ones_is_counted(latencies: list[float], deadline: float) -> None:
    late = sum(1 for each in latencies if each > deadline)
    assert deadline_miss_ratio(latencies, deadline) == pytest.approx(late / len(latencies))


def test_on_time_is_on_time_and_never_is_late() -> None:
    assert deadline_miss_ratio([5e5, 5e5 + 1, np.inf, 0.0], 5e5) == 0.5
    assert deadline_miss_ratio([], 5e5) is None
    for nonsense in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="deadline"):
            deadline_miss_ratio([1.0], nonsense)


def test_a_decision_that_was_overtaken_is_infinitely_late() -> None:
    stamps = {
        "capture_us": np.array([0, 1_000, 2_000, NO_STAMP, 4_000, 5_000]),
        "motor_us": np.array([400, NO_STAMP, 2_600, 3_500, 4_700, NO_STAMP]),
    }
    # The fourth saw no frame, the last one was cut off by the end of the flight.
    assert ages_at_effect(stamps).tolist() == [400.0, np.inf, 600.0, 700.0]
    assert deadline_miss_ratio(ages_at_effect(stamps), 500.0) == 0.75


def test_without_motors_nothing_is_judged() -> None:
    frames = np.array([0, 1_000])
    assert ages_at_effect({}).size == 0
    assert ages_at_effect({"capture_us": frames}).size == 0
    never = {"capture_us": frames, "motor_us": np.full(2, NO_STAMP)}
    assert ages_at_effect(never).size == 0

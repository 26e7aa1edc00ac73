"""Statistics of few flights, at the ends of their ranges."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import Agreement, _score, count_agreement, percent_change, wilson


@pytest.mark.parametrize("n", [1, 3, 7, 10, 30, 100])
def test_a_rate_of_all_or_nothing_ends_exactly_there(n: int) -> None:
    assert wilson(0, n).low == 0.0
    assert wilson(n, n).high == 1.0
    none, every = wilson(0, n), wilson(n, n)
    assert none.high is not None
    assert every.low is not None
    assert 0.0 < none.high < 1.0
    assert every.low == pytest.approx(1.0 - none.high)


def test_one_success_keeps_its_interval_off_the_ends() -> None:
    low, high = wilson(1, 10), wilson(9, 10)
    assert low.low == pytest.approx(0.01788, abs=1e-5)
    assert high.high == pytest.approx(1.0 - 0.01788, abs=1e-5)


def test_the_four_kinds_of_pairs_are_counted_apart() -> None:
    def pair(first: bool, second: bool) -> Any:
        ends = (Outcome.COLLISION, Outcome.SUCCESS)
        return tuple(SimpleNamespace(outcome=ends[reached]) for reached in (first, second))

    kinds = [(True, True)] * 1 + [(True, False)] * 2 + [(False, True)] * 3 + [(False, False)] * 4
    assert count_agreement([pair(*kind) for kind in kinds]) == Agreement(1, 2, 3, 4)


def test_the_score_of_no_difference_is_mcnemars() -> None:
    for gained, lost in ((1, 0), (2, 1), (5, 3), (0, 4)):
        expected = (gained - lost) / math.sqrt(gained + lost)
        assert _score(0.0, gained, lost, 20) == pytest.approx(expected)
    assert _score(0.0, 0, 0, 20) == 0.0
    assert _score(0.5, 10, 0, 20) == 0.0


def test_a_change_is_in_percent_of_the_reference() -> None:
    assert percent_change(0.5, 0.75) == pytest.approx(50.0)
    assert percent_change(4.0, 3.0) == pytest.approx(-25.0)
    for reference in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="must be > 0"):
            percent_change(reference, 1.0)

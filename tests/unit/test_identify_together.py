"""Averages over flights of one vehicle, against closed forms and simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from airl_mav.addons.identification.flown import FittedQuantity
from airl_mav.addons.identification.identify import identify_together, pooled, random_effects
from airl_mav.cli.main import main
from airl_mav.core.errors import FieldError
from airl_mav.flight.statistics import QUANTILE


def told(value: float, sigma: float) -> FittedQuantity:
    half = QUANTILE * sigma
    return FittedQuantity("k", "drag", "1/s", value, value - half, value + half, "a log")


def test_flights_that_agree_are_averaged_by_their_variances() -> None:
    mean, error = random_effects(np.array([1.0, 1.1, 0.9]), np.array([0.3, 0.3, 0.3]))
    assert mean == pytest.approx(1.0) and error == pytest.approx(0.3 / np.sqrt(3.0))
    mean, _ = random_effects(np.array([1.0, 1.2]), np.array([0.2, 0.4]))
    assert mean == pytest.approx((1.0 / 0.04 + 1.2 / 0.16) / (1.0 / 0.04 + 1.0 / 0.16))


def test_flights_that_disagree_are_known_as_well_as_they_scatter() -> None:
    """Far apart beside their own errors, they weigh the same: the mean's error is s / sqrt(n)."""
    values = np.array([1.0, 2.0, 3.0, 4.0])
    mean, error = random_effects(values, np.full(4, 1e-3))
    assert mean == pytest.approx(2.5)
    assert error == pytest.approx(values.std(ddof=1) / 2.0, rel=1e-3)


def test_intervals_hold_the_truth_where_flights_differ() -> None:
    rng = np.random.default_rng(5)
    inside = 0
    for _ in range(1_000):
        sigma = rng.uniform(0.5, 1.5, 12)
        values = 3.0 + rng.normal(0.0, 1.0, 12) + sigma * rng.standard_normal(12)
        mean, error = random_effects(values, sigma)
        inside += abs(mean - 3.0) < QUANTILE * error
    # The normal quantile is somewhat narrow for a spread that twelve flights show.
    assert 0.90 <= inside / 1_000 <= 0.97


def test_what_one_flight_tells_is_known_and_what_none_tells_is_not() -> None:
    nothing = FittedQuantity("k", "drag", "1/s", unobservable="too slow", profile=0.2)
    one = pooled([nothing, told(0.3, 0.01)])
    assert (one.value, one.half_width) == pytest.approx((0.3, QUANTILE * 0.01))
    assert one.source == "1 of 2 flights: a log"
    none = pooled([nothing, replace(nothing, unobservable="too short")])
    assert not none.observed and none.unobservable == "in none of 2: too slow"
    assert none.profile == 0.2


def test_what_cannot_be_fitted_together_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(FieldError, match=r"a\.mcap': accepted: vehicle's logs"):
        identify_together([tmp_path / "a.mcap", tmp_path / "b.ulg"])
    with pytest.raises(FieldError, match="each log once"):
        identify_together([tmp_path / "a.ulg", tmp_path / "a.ulg"])
    words = ["identify", "a.ulg", "b.ulg", "--ulg", "c.ulg", "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "--ulg" in capsys.readouterr().err

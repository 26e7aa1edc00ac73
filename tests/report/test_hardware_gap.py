"""The definition of the hardware gap, against hand-made values, scipy and the paper's tables."""

from __future__ import annotations

from dataclasses import astuple, fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import (
    Change,
    PairedComparison,
    compare_medians,
    compare_pairs,
    median_ratio,
    percent_change,
)
from airl_mav.flight.trajectory import Leg, Quality
from airl_mav.profiles.loading import PublishedRun, load_published, published_gap

# --- one gap


def flight(
    seed: int, outcome: Outcome, time_s: float = 1.0, energy_j: float = 100.0, watts: float = 2.0
) -> EpisodeRecord:
    return EpisodeRecord(
        index=seed,
        seed=seed,
        arena="a",
        arena_seed=seed,
        outcome=outcome,
        reason="",
        goal=(1.0, 2.0),
        goal_radius_m=3.0,
        time_limit_s=120.0,
        started_us=0,
        navigation_us=0,
        ended_us=int(1e6 * time_s),
        wall_s=None,
        slipped_us=0,
        battery_remaining=0.5,
        quality=Quality(
            flight_time_s=time_s,
            distance_m=3.0 * time_s,
            energy_j=energy_j,
            computer_energy_j=watts * time_s,
            mean_speed_m_s=3.0,
            max_speed_m_s=4.0,
            takeoff=Leg(0.0, 0.0, 0.0),
        ),
    )


GOOD, HIT = Outcome.SUCCESS, Outcome.COLLISION

REFERENCE = [
    flight(1, GOOD, 10.0, 1000.0, 5.0),
    flight(2, GOOD, 20.0, 3000.0, 5.0),
    flight(3, GOOD, 30.0, 9000.0, 5.0),
    flight(4, HIT, 5.0),
    replace(flight(5, GOOD, 1.0), invalid=("the host was busy",)),
    flight(6, GOOD, 90.0, 9000.0, 5.0),
]
TARGET = [
    flight(1, GOOD, 15.0, 1100.0, 2.0),
    flight(2, GOOD, 21.0, 3900.0, 2.0),
    flight(3, HIT, 2.0),
    flight(4, GOOD, 50.0),
    flight(5, GOOD, 50.0),
    flight(6, HIT, 2.0),
]


def test_a_gap_worked_out_by_hand() -> None:
    gap = compare_pairs(REFERENCE, TARGET)
    # Seeds 1, 2, 3, 4, 6 make pairs; 5 was invalid. Both reached the goal with 1 and 2 alone.
    assert astuple(gap.agreement) == (2, 2, 1, 0)
    success = gap.success_rate
    assert (success.reference, success.other) == (0.8, 0.6)
    assert success.difference.value == pytest.approx(-20.0)  # points, not percent
    assert success.difference.n == 5
    time = gap.flight_time_s
    assert (time.reference, time.other) == (15.0, 18.0)
    assert time.difference.value == pytest.approx(27.5)  # between +50 and +5 %
    assert time.difference.n == 2
    assert gap.distance_m.difference.value == pytest.approx(27.5)
    assert gap.energy_j.difference.value == pytest.approx(20.0)  # between +10 and +30 %
    computer = gap.computer_energy_j
    assert (computer.reference, computer.other) == (75.0, 36.0)
    assert computer.difference.value == pytest.approx(100.0 * ((30 / 50 + 42 / 100) / 2 - 1))
    total = gap.total_energy_j
    assert (total.reference, total.other) == (2075.0, 2536.0)
    assert total.difference.value == pytest.approx(100.0 * ((1130 / 1050 + 3942 / 3100) / 2 - 1))


def test_the_other_way_round_is_another_gap() -> None:
    back = compare_pairs(TARGET, REFERENCE)
    assert back.success_rate.difference.value == pytest.approx(20.0)
    assert back.flight_time_s.difference.value == pytest.approx(
        100.0 * ((10 / 15 + 20 / 21) / 2 - 1)
    )


def test_nothing_in_common_is_no_gap() -> None:
    gap = compare_pairs([flight(1, GOOD)], [flight(1, HIT)])
    assert gap.success_rate.difference.value == -100.0
    for field in fields(PairedComparison):
        metric = getattr(gap, field.name)
        if isinstance(metric, Change) and metric is not gap.success_rate:
            assert metric.difference.value is None
            assert metric.difference.n == 0
    none = compare_pairs([], [])
    assert none.success_rate.difference.value is None


def test_a_computer_without_watts_has_medians_and_no_gap() -> None:
    free, other = [flight(1, GOOD, watts=0.0)], [flight(1, GOOD, time_s=2.0)]
    computer = compare_pairs(free, other).computer_energy_j
    assert (computer.reference, computer.other) == (0.0, 4.0)
    assert computer.difference.value is None
    assert compare_pairs(free, other).total_energy_j.difference.value is not None


# --- intervals


@pytest.mark.parametrize("n", [2, 5, 6, 7, 20, 101, 1000])
def test_the_interval_of_the_median_is_within_that_of_scipys_quantile_test(n: int) -> None:
    rng = np.random.default_rng(n)
    first = rng.gamma(5.0, 2.0, n)
    second = first * rng.lognormal(0.1, 0.2, n)
    percent = np.sort(100.0 * (second - first) / first)
    expected: Any = stats.quantile_test(percent, p=0.5).confidence_interval(0.95)
    found = median_ratio(first, second)
    assert found.value == pytest.approx(np.median(percent))
    assert found.n == n
    if n < 6:
        assert np.isnan(expected.low) or np.isnan(expected.high)
        assert found.low is found.high is None
    else:
        # scipy's interval ends at values and covers more than 95 %: ours ends before its next one.
        below, above = (int(np.searchsorted(percent, end)) for end in (expected.low, expected.high))
        assert percent[below] - 1e-9 <= (found.low or 0.0) <= percent[below + 1]
        assert percent[above - 1] <= (found.high or 0.0) <= percent[above] + 1e-9


def test_one_long_flight_does_not_move_the_gap() -> None:
    first = np.full(50, 8.0)
    second = np.full(50, 8.0)
    second[7] = 70.0
    gap = compare_medians(first, second).difference
    assert (gap.low, gap.value, gap.high) == (0.0, 0.0, 0.0)


@given(
    st.lists(st.tuples(st.floats(0.1, 1e3), st.floats(0.1, 1e3)), min_size=1, max_size=12),
    st.floats(0.01, 100.0),
)
def test_a_gap_has_no_unit(pairs: list[tuple[float, float]], scale: float) -> None:
    first, second = np.array(pairs).T
    plain, scaled = compare_medians(first, second), compare_medians(scale * first, scale * second)
    assert scaled.difference.value == pytest.approx(plain.difference.value, abs=1e-9)


def test_a_gap_of_two_figures() -> None:
    assert percent_change(11.0, 396.0) == pytest.approx(3500.0)
    assert percent_change(100.0, 87.0) == pytest.approx(-13.0)
    with pytest.raises(ValueError, match="must be > 0"):
        percent_change(0.0, 1.0)


# --- published figures

PUBLISHED = load_published()
MITIGATION = PUBLISHED.tables[0]
SYSTEM = {table.arena: table for table in PUBLISHED.tables[1:]}


@pytest.mark.parametrize("arena", sorted(SYSTEM))
def test_the_papers_system_evaluation_follows_from_its_columns(arena: str) -> None:
    """Verify the copied figures and our definition of the gap; success is in points."""
    table = SYSTEM[arena]
    found = published_gap(table.columns["reference"], table.columns["target"])
    printed = table.printed["target"]
    assert found.latency_percent == pytest.approx(printed.latency_percent, rel=1e-4)
    assert found.flight_time_percent == pytest.approx(printed.flight_time_percent, abs=0.05)
    assert found.distance_percent == pytest.approx(printed.distance_percent, abs=0.1)
    assert found.energy_percent == pytest.approx(printed.energy_percent, abs=0.05)
    assert -found.success == printed.success


def test_the_papers_mitigation_is_measured_from_the_delay_trained_policy() -> None:
    m = MITIGATION.columns
    without = published_gap(m["training"], m["target"])
    assert without.flight_time_percent == pytest.approx(37.73, abs=0.02)
    assert without.distance_percent == pytest.approx(16.03, abs=0.02)
    assert without.energy_percent == pytest.approx(15.49, abs=0.02)
    mitigated = published_gap(m["training"], m["mitigated"])
    assert abs(mitigated.flight_time_percent) == pytest.approx(0.5, abs=0.06)
    assert abs(mitigated.distance_percent) == pytest.approx(1.37, abs=0.02)
    assert abs(mitigated.energy_percent) == pytest.approx(0.1, abs=0.02)
    undelayed = published_gap(m["reference"], m["target"])
    assert undelayed.flight_time_percent == pytest.approx(86.6, abs=0.05)
    assert undelayed.distance_percent == pytest.approx(33.2, abs=0.05)
    assert undelayed.energy_percent == pytest.approx(48.8, abs=0.05)
    both = published_gap(m["reference"], m["mitigated"])
    assert both.flight_time_percent == pytest.approx(34.7, abs=0.05)


def test_the_papers_success_gaps_there_are_percent_of_the_target() -> None:
    m = MITIGATION.columns

    def of_target(target: PublishedRun) -> float:
        trained = m["training"].success_percent
        assert trained is not None
        assert target.success_percent is not None
        return percent_change(target.success_percent, trained)

    for role in ("mitigated", "target"):
        printed = MITIGATION.printed[role].success
        assert of_target(m[role]) == pytest.approx(printed, abs=0.01)
    assert published_gap(m["training"], m["mitigated"]).success == -2.0
    assert published_gap(m["training"], m["target"]).success == -12.0


def test_the_paper_agrees_with_itself_where_it_does() -> None:
    """The texts: +97 % time, +21 % distance, +43 % energy at 300 ms; the same best networks."""
    curve = PUBLISHED.degradation
    worst = published_gap(curve[0], curve[-1])
    assert worst.flight_time_percent == pytest.approx(97.0, abs=1.0)
    assert worst.distance_percent == pytest.approx(21.0, abs=1.0)
    assert worst.energy_percent == pytest.approx(43.0, abs=0.2)
    assert curve[0].flight_time_s == MITIGATION.columns["reference"].flight_time_s
    for arena, best in PUBLISHED.best_networks.items():
        assert SYSTEM[arena].columns["reference"].success_percent == best.success_percent
        assert PUBLISHED.ablation[arena]["none"] == best.success_percent
    for trained, rates in PUBLISHED.generalisation.items():
        assert rates[trained] == PUBLISHED.best_networks[trained].success_percent

"""Requirements: parsing, and decisions from flights."""

from __future__ import annotations

from dataclasses import replace

import pytest

from airl_mav.core.errors import FieldError
from airl_mav.flight.judge import Outcome
from airl_mav.flight.requirements import (
    MEASURES,
    Requirement,
    RequirementDecision,
    find,
    parse_requirement,
    settle,
)
from airl_mav.flight.statistics import (
    NO_ESTIMATE,
    Aggregate,
    Agreement,
    Change,
    Estimate,
    PairedComparison,
    wilson,
)

QUALITY = Aggregate(
    success_rate=wilson(87, 100),
    flight_time_s=Estimate(8.0, 7.5, 8.5, 87),
    distance_m=Estimate(26.0, 25.0, 27.0, 87),
    energy_j=Estimate(3400.0, 3300.0, 3500.0, 87),
    computer_energy_j=NO_ESTIMATE,
    total_energy_j=Estimate(3400.0, 3300.0, 3500.0, 87),
    mean_speed_m_s=NO_ESTIMATE,
    outcomes=dict.fromkeys(Outcome, 0),
)
UNKNOWN = Change(None, None, NO_ESTIMATE)
AGAINST = PairedComparison(
    agreement=Agreement(85, 10, 2, 3),
    success_rate=Change(0.95, 0.87, Estimate(-8.0, -12.0, -4.0, 100)),
    flight_time_s=Change(5.5, 8.0, Estimate(44.6, 41.3, 49.8, 85)),
    distance_m=UNKNOWN,
    energy_j=UNKNOWN,
    computer_energy_j=UNKNOWN,
    total_energy_j=UNKNOWN,
)


@pytest.mark.parametrize(
    ("text", "requirement"),
    [
        ("success >= 95 %", Requirement("success", False, ">=", 95.0)),
        ("success>=95", Requirement("success", False, ">=", 95.0)),
        (" flight_time gap <= 10 % ", Requirement("flight_time", True, "<=", 10.0)),
        ("success gap >= -1 points", Requirement("success", True, ">=", -1.0)),
        ("energy <= 3.5 kJ", Requirement("energy", False, "<=", 3.5)),
        ("flight_time <= 1e1 s", Requirement("flight_time", False, "<=", 10.0)),
        ("deadline_misses <= 1 %", Requirement("deadline_misses", False, "<=", 1.0)),
        ("jerk <= 12 m/s3", Requirement("jerk", False, "<=", 12.0)),
        ("command_step <= 2.5 m/s", Requirement("command_step", False, "<=", 2.5)),
    ],
)
def test_what_is_read(text: str, requirement: Requirement) -> None:
    assert parse_requirement(text) == requirement
    assert parse_requirement(str(requirement)) == requirement


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("", "MEASURE"),
        ("success > 95 %", "MEASURE"),
        ("speed >= 5", "MEASURE"),
        ("success >= 1.2.3", "MEASURE"),
        ("success >= 0 %", "above 0 %"),
        ("success >= 101 %", "up to 100 %"),
        ("flight_time <= 10 %", "the unit s"),
        ("success gap >= -1 %", "the unit points"),
        ("jerk gap <= 10 %", "jerk without gap"),
        ("jerk <= 12 m/s", "the unit m/s3"),
    ],
)
def test_what_is_refused(text: str, hint: str) -> None:
    with pytest.raises(FieldError, match="require") as refused:
        parse_requirement(text)
    assert hint in str(refused.value)


@pytest.mark.parametrize(
    ("text", "decision"),
    [
        # Wilson's interval of 87 in 100: 79.0 to 92.2 %.
        ("success >= 95 %", RequirementDecision.NOT_MET),
        ("success >= 93 %", RequirementDecision.NOT_MET),
        ("success >= 90 %", RequirementDecision.UNDECIDED),
        ("success >= 80 %", RequirementDecision.UNDECIDED),
        ("success >= 75 %", RequirementDecision.MET),
        ("success <= 95 %", RequirementDecision.MET),
        ("flight_time <= 8.5 s", RequirementDecision.MET),
        ("flight_time <= 8.4 s", RequirementDecision.UNDECIDED),
        ("flight_time <= 7.4 s", RequirementDecision.NOT_MET),
        ("energy <= 3.6 kJ", RequirementDecision.MET),
        ("flight_time gap <= 10 %", RequirementDecision.NOT_MET),
        ("flight_time gap <= 50 %", RequirementDecision.MET),
        ("success gap >= -10 points", RequirementDecision.UNDECIDED),
        ("distance gap <= 10 %", RequirementDecision.UNDECIDED),
    ],
)
def test_it_is_decided_on_the_interval(text: str, decision: RequirementDecision) -> None:
    finding = find(parse_requirement(text), QUALITY, AGAINST)
    assert finding.decision is decision
    assert finding.sentence().startswith(decision.value)


@pytest.mark.parametrize("rate", [0.90, 0.93, 0.97, 1.0])
def test_so_many_more_flights_of_that_rate_decide(rate: float) -> None:
    requirement = parse_requirement("success >= 95 %")
    quality = replace(QUALITY, success_rate=wilson(round(40 * rate), 40))
    finding = find(requirement, quality, None)
    assert finding.decision is RequirementDecision.UNDECIDED
    assert finding.more_flights is not None
    n = 40 + finding.more_flights
    value = round(40 * rate) / 40
    later = replace(QUALITY, success_rate=wilson(round(value * n), n))
    assert find(requirement, later, None).decision is not RequirementDecision.UNDECIDED


def test_means_need_as_many_as_shrinks_their_interval() -> None:
    finding = find(parse_requirement("flight_time <= 8.25 s"), QUALITY, None)
    # Half as wide an interval needs four times the 87 flights.
    assert finding.more_flights == pytest.approx(3 * 87, abs=1)


def test_at_the_threshold_no_number_would_tell() -> None:
    quality = replace(QUALITY, success_rate=wilson(95, 100))
    finding = find(parse_requirement("success >= 95 %"), quality, None)
    assert (finding.decision, finding.more_flights) == (RequirementDecision.UNDECIDED, None)
    assert "no number of flights in reach" in finding.sentence()


def test_nothing_flown_decides_nothing() -> None:
    quality = replace(QUALITY, success_rate=NO_ESTIMATE)
    finding = find(parse_requirement("success >= 95 %"), quality, None)
    assert finding.decision is RequirementDecision.UNDECIDED
    assert "no flight" in finding.sentence()


def test_a_gap_needs_a_reference() -> None:
    with pytest.raises(FieldError, match="airl hardware-gap"):
        find(parse_requirement("flight_time gap <= 10 %"), QUALITY, None)


def test_every_measure_is_a_figure_of_runs_and_of_pairs() -> None:
    for word, measure in MEASURES.items():
        assert isinstance(getattr(QUALITY, measure.attribute), Estimate), word
        if measure.gap_unit is not None:
            assert isinstance(getattr(AGAINST, measure.attribute), Change), word


def test_late_decisions_are_judged_as_a_share() -> None:
    quality = replace(QUALITY, deadline_misses=Estimate(0.02, 0.015, 0.03, 100))
    finding = find(parse_requirement("deadline_misses <= 1 %"), quality, None)
    assert finding.decision is RequirementDecision.NOT_MET
    assert finding.sentence().endswith("(2.0 % [1.5, 3.0], n = 100)")


def test_a_minimum_success_rate_alone_is_tested_sequentially() -> None:
    rate = parse_requirement("success >= 80 %")
    assert rate.least_rate
    assert rate.test().threshold == pytest.approx(0.8)
    for text in ("success <= 80 %", "success gap >= -1 points", "energy >= 3 kJ"):
        assert not parse_requirement(text).least_rate
    with pytest.raises(FieldError, match="below 100 %"):
        parse_requirement("success >= 100 %").test()


def test_a_sequential_finding_takes_its_decision_from_the_flights_in_order() -> None:
    undecided = find(parse_requirement("success >= 85 %"), QUALITY, None)
    met = settle(undecided, [True] * 100)
    assert met.decision is RequirementDecision.MET
    assert met.more_flights is None
    # Of the flights up to the decision.
    assert met.estimate.n < 100
    assert met.estimate.low is not None
    assert met.estimate.low > 85.0
    assert settle(undecided, [False] * 100).decision is RequirementDecision.NOT_MET
    early = settle(undecided, [True] * 10)
    assert early.decision is RequirementDecision.UNDECIDED
    needed = undecided.requirement.test().flights_needed(1.0, 10)
    assert needed is not None
    assert early.more_flights == needed - 10
    assert settle(undecided, []).more_flights is None
    other = find(parse_requirement("flight_time <= 9 s"), QUALITY, None)
    assert settle(other, [True]) is other


@pytest.mark.parametrize(("limit", "more"), [(7.0, 1500), (8.5, 300)])
def test_the_flights_to_a_decision_count_the_near_half_of_an_interval(
    limit: float, more: int
) -> None:
    """The half towards the limit decides: 4 s below the value, 1 s above."""
    quality = replace(QUALITY, flight_time_s=Estimate(8.0, 4.0, 9.0, 100))
    finding = find(Requirement("flight_time", False, "<=", limit), quality, None)
    assert finding.decision is RequirementDecision.UNDECIDED
    assert finding.more_flights == more

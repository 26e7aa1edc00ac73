"""Requirements of a policy, and their test on flights.

A requirement is decided on the 95 % interval of its figure, never on the figure alone. It is met if
the whole interval fulfils it, not met if no part does, and undecided between.

A minimum success rate is tested sequentially, while flights come in. Repeated evaluation of an
ordinary interval, with a stop at its decision, increases the error. A group-sequential test
distributes the error over planned interim analyses, the looks (Lan & DeMets, Biometrika 70, 1983;
Jennison & Turnbull, Group Sequential Methods with Applications to Clinical Trials, 2000, chapters
7, 8 and 12). Flights are counted, so the error is exact, from binomial sums instead of a normal
approximation. A gap of success rates is tested on an interval that holds at any stop.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
import scipy

from airl_mav.core.errors import FieldError
from airl_mav.flight import statistics
from airl_mav.flight.statistics import Aggregate, Estimate, PairedComparison, wilson

MOST_FLIGHTS = 1_000_000
"""Maximum number of flights for a decision; beyond, it is out of reach."""


class Measure(NamedTuple):
    """Figure that can be required."""

    title: str
    unit: str
    per_unit: float
    """Factor from this unit to the stored unit: 0.01 for percent, 1000 for kJ."""
    attribute: str
    """Attribute of `Aggregate` and of `PairedComparison`."""
    gap_unit: str | None = "%"
    """Unit of a required gap; None: a gap is not supported."""


MEASURES: dict[str, Measure] = {
    "success": Measure("success rate", "%", 0.01, "success_rate", "points"),
    "flight_time": Measure("flight time", "s", 1.0, "flight_time_s"),
    "distance": Measure("distance", "m", 1.0, "distance_m"),
    "energy": Measure("energy", "kJ", 1e3, "energy_j"),
    "total_energy": Measure("energy with computer", "kJ", 1e3, "total_energy_j"),
    "deadline_misses": Measure("deadline misses", "%", 0.01, "deadline_misses", None),
    "jerk": Measure("jerk, flown, RMS", "m/s3", 1.0, "jerk_rms_m_s3", None),
    "command_step": Measure("step of the command", "m/s", 1.0, "command_step_m_s", None),
}
"""Measures by their name in a requirement."""

ACCEPTED = (
    f"MEASURE [gap] >= or <= NUMBER [UNIT], with MEASURE one of {', '.join(MEASURES)}: as"
    " 'success >= 95 %' or 'flight_time gap <= 10 %'"
)

_REQUIREMENT = re.compile(
    r"\s*(?P<measure>[a-z_]+)(?P<gap>\s+gap)?\s*(?P<sense>>=|<=)\s*"
    r"(?P<limit>[-+]?[0-9.]+(?:e[-+]?[0-9]+)?)\s*(?P<unit>%|[a-zA-Z][a-zA-Z0-9/]*)?\s*"
)


@dataclass(frozen=True)
class Requirement:
    """Bound on a figure of a run, or on its difference from a reference."""

    measure: str
    """Key of `MEASURES`."""
    gap: bool
    """True to bound the difference from the reference, False for the figure itself."""
    sense: Literal[">=", "<="]
    limit: float
    """Limit in `unit`."""

    @property
    def unit(self) -> str:
        """Unit of the limit: for a gap percent, for a rate's gap percentage points."""
        measure = MEASURES[self.measure]
        return (measure.gap_unit or "") if self.gap else measure.unit

    def __str__(self) -> str:
        """Return the requirement in its text format."""
        gap = " gap" if self.gap else ""
        return f"{self.measure}{gap} {self.sense} {self.limit:g} {self.unit}"

    @property
    def least_rate(self) -> bool:
        """True for a minimum success rate, which allows a group-sequential test."""
        return (self.measure, self.gap, self.sense) == ("success", False, ">=")

    @property
    def rate_gap(self) -> bool:
        """True for a gap of the success rate, which allows a sequential test over pairs."""
        return self.measure == "success" and self.gap

    def test(self) -> RateTest:
        """Return the test of a minimum success rate. Raises FieldError for 100 %."""
        if self.limit >= 100.0:
            raise FieldError(
                "require", str(self), "a success rate below 100 %: no number of flights shows it"
            )
        return RateTest(0.01 * self.limit)

    def fulfilled_by(self, value: float) -> bool:
        """Return True if a value, in `unit`, keeps within the bound."""
        return value >= self.limit if self.sense == ">=" else value <= self.limit


@dataclass(frozen=True)
class Finding:
    """Requirement with its decision."""

    requirement: Requirement
    decision: RequirementDecision
    estimate: Estimate
    """Figure in the requirement's unit."""
    more_flights: int | None = None
    """Additional flights for a decision at the same figure; None if decided or out of reach."""

    def sentence(self) -> str:
        """Return the finding as one line."""
        estimate, unit = self.estimate, self.requirement.unit
        if estimate.value is None:
            return f"{self.decision.value}: {self.requirement} (no flight to judge it by)"
        seen = f"{estimate.value:.1f} {unit}"
        if estimate.low is not None and estimate.high is not None:
            seen += f" [{estimate.low:.1f}, {estimate.high:.1f}]"
        line = f"{self.decision.value}: {self.requirement} ({seen}, n = {estimate.n:,}"
        if self.decision is RequirementDecision.UNDECIDED:
            line += (
                f"; about {self.more_flights:,} more flights would tell"
                if self.more_flights is not None
                else "; no number of flights in reach would tell"
            )
        return line + ")"


def parse_requirement(text: str) -> Requirement:
    """Read `success >= 95 %` or `flight_time gap <= 10 %`. Raises FieldError if invalid."""
    found = _REQUIREMENT.fullmatch(text)
    if found is None or found["measure"] not in MEASURES:
        raise FieldError("require", text, ACCEPTED)
    try:
        limit = float(found["limit"])
    except ValueError:
        raise FieldError("require", text, ACCEPTED) from None
    sense: Literal[">=", "<="] = ">=" if found["sense"] == ">=" else "<="
    requirement = Requirement(found["measure"], found["gap"] is not None, sense, limit)
    if requirement.gap and MEASURES[requirement.measure].gap_unit is None:
        raise FieldError("require", text, f"{requirement.measure} without gap")
    if found["unit"] not in (None, requirement.unit):
        raise FieldError("require", text, f"the unit {requirement.unit}")
    if requirement.measure == "success" and not requirement.gap and not 0.0 < limit <= 100.0:
        raise FieldError("require", text, "a success rate above 0 % and up to 100 %")
    return requirement


def find(requirement: Requirement, quality: Aggregate, against: PairedComparison | None) -> Finding:
    """Judge a requirement by a run, a gap against its reference; FieldError without any."""
    measure = MEASURES[requirement.measure]
    if requirement.gap:
        if against is None:
            raise FieldError(
                "require",
                str(requirement),
                "a gap only with a reference: airl hardware-gap",
            )
        # Both in percent, or in percentage points.
        estimate: Estimate = getattr(against, measure.attribute).difference
    else:
        estimate = getattr(quality, measure.attribute).scaled(1.0 / measure.per_unit)
    decision = decide(requirement, estimate)
    more = None
    if decision is RequirementDecision.UNDECIDED:
        rate = requirement.measure == "success" and not requirement.gap
        more = _more_flights(requirement, estimate, wilson_percent if rate else None)
    return Finding(requirement, decision, estimate, more)


def settle(finding: Finding, reached: Sequence[bool]) -> Finding:
    """Return a finding for flights added until a minimum success rate was decided.

    Repeated looks make the interval's error exceed its nominal 5 %. The estimate is the one of the
    deciding look, with an interval that holds at its stop. `reached` are the flights in the order
    of their seeds. Findings of other requirements stay.
    """
    if not finding.requirement.least_rate:
        return finding
    test, n = finding.requirement.test(), len(reached)
    decision, more = test.decide(reached), None
    if decision is RequirementDecision.UNDECIDED and n:
        needed = test.flights_needed(sum(reached) / n, n)
        more = None if needed is None else needed - n
    return Finding(finding.requirement, decision, test.estimate(reached).scaled(100.0), more)


def all_decided(
    requirements: Sequence[Requirement],
    reached: Sequence[bool],
    pairs: Sequence[statistics.Pair] = (),
) -> bool:
    """Return True if every minimum success rate and every gap of it is decided.

    Args:
        requirements: Requirements; the others do not count.
        reached: Goals reached (n,), in the order of the seeds.
        pairs: Flights of the reference and of the run, for a gap.
    """
    gap = statistics.anytime_gap(statistics.count_agreement(pairs))
    decisions = [each.test().decide(reached) for each in requirements if each.least_rate]
    decisions += [decide(each, gap) for each in requirements if each.rate_gap]
    return RequirementDecision.UNDECIDED not in decisions


def decide(requirement: Requirement, estimate: Estimate) -> RequirementDecision:
    """Return the decision of an estimate in the requirement's unit."""
    if estimate.low is None or estimate.high is None:
        return RequirementDecision.UNDECIDED
    kept = {requirement.fulfilled_by(end) for end in (estimate.low, estimate.high)}
    if len(kept) == 2:
        return RequirementDecision.UNDECIDED
    return RequirementDecision.MET if kept == {True} else RequirementDecision.NOT_MET


def wilson_percent(rate: float, n: int) -> Estimate:
    """Return the estimate that n flights of a success rate [%] would give."""
    return wilson(round(0.01 * rate * n), n).scaled(100.0)


def _more_flights(
    requirement: Requirement, estimate: Estimate, project: Callable[[float, int], Estimate] | None
) -> int | None:
    """Return the additional flights for a decision at the same figure; None: out of reach.

    `project` gives the estimate of n flights; without it, the interval shrinks with the root of n.
    """
    value, low, high = estimate.value, estimate.low, estimate.high
    if value is None:
        return None
    if project is None:
        away = abs(value - requirement.limit)
        if low is None or high is None or away == 0.0:
            return None
        half = value - low if value > requirement.limit else high - value
        needed = math.ceil(estimate.n * (half / away) ** 2)
        return needed - estimate.n if needed <= MOST_FLIGHTS else None
    n = max(1, estimate.n)
    while decide(requirement, project(value, n)) is RequirementDecision.UNDECIDED:
        n = math.ceil(1.02 * n) + 1
        if n > MOST_FLIGHTS:
            return None
    return n - estimate.n


ALPHA = 0.05
"""Maximum probability of a false verdict over all looks. Half of it is for "meets" with a low rate,
half for "does not meet" with a sufficient rate, as in a 95 % interval."""

LOOKS = (
    *(20, 40, 60, 80),
    *(scale * step for scale in (10, 100, 1000) for step in (10, 15, 20, 30, 40, 50, 70)),
    100_000,
)
"""Numbers of flights after which the test is evaluated."""

HALF_SPENT = 100
"""Number of flights that spends half of the error: a typical length of a decision.
`benchmarks/bench_verdict.py` compares the flights needed with this and other spending functions."""


class RequirementDecision(str, Enum):
    """Decision on a requirement."""

    MET = "meets"
    NOT_MET = "does not meet"
    UNDECIDED = "too few flights to tell"


def error_spent(flights: int) -> float:
    """Return the cumulative error allowed on either side after a number of flights.

    It always grows and never reaches half of `ALPHA`. The maximum number of flights need not be
    known beforehand.
    """
    return 0.5 * ALPHA * flights / (flights + HALF_SPENT)


@dataclass(frozen=True)
class InterimAnalysis:
    """Decision bounds after a number of flights."""

    flights: int
    few: int
    """Maximum number of failures for "meets"; -1: impossible."""
    many: int
    """Minimum number of failures for "does not meet"."""

    def decide(self, failures: int) -> RequirementDecision:
        """Return the decision for a number of failures."""
        if failures <= self.few:
            return RequirementDecision.MET
        return (
            RequirementDecision.NOT_MET if failures >= self.many else RequirementDecision.UNDECIDED
        )


def plan_looks(
    threshold: float, looks: Sequence[int] = LOOKS, spent: Callable[[int], float] = error_spent
) -> Iterator[InterimAnalysis]:
    """Yield the looks of a test in order.

    Both errors are at their maximum at the threshold. There, the distribution of failures among
    undecided campaigns is carried from look to look. At each look, the outermost counts within the
    allowance `spent` decide. Their probability is the error of either side.
    """
    undecided, fewest, before = np.ones(1), 0, 0
    error_few = error_many = 0.0
    for flights in looks:
        step = flights - before
        new = scipy.stats.binom.pmf(np.arange(step + 1), step, 1.0 - threshold)
        undecided, before = np.convolve(undecided, new), flights
        left_few = spent(flights) - error_few
        left_many = spent(flights) - error_many
        n_few = int(np.searchsorted(np.cumsum(undecided), left_few, side="right"))
        n_many = int(np.searchsorted(np.cumsum(undecided[::-1]), left_many, side="right"))
        kept = undecided.size - n_many
        error_few += float(undecided[:n_few].sum())
        error_many += float(undecided[kept:].sum())
        # The minimum possible count of failures is 0, or one more than decided before.
        yield InterimAnalysis(flights, fewest + n_few - 1, fewest + kept)
        undecided, fewest = undecided[n_few:kept], fewest + n_few


@cache
def _planned(threshold: float, looks: int) -> tuple[InterimAnalysis, ...]:
    return tuple(plan_looks(threshold, LOOKS[:looks]))


@dataclass(frozen=True)
class RateTest:
    """Test of a success rate against a threshold, evaluated after each of `LOOKS`."""

    threshold: float
    """Threshold between 0 and 1, both excluded."""

    def __post_init__(self) -> None:
        """Raise ValueError for a threshold that no number of flights can show."""
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold={self.threshold}: must be > 0 and < 1")

    def decide(self, reached: Sequence[bool]) -> RequirementDecision:
        """Return the decision of the first deciding look; later flights do not change it."""
        look, failures = self._analyses(reached)[-1]
        return look.decide(failures)

    def estimate(self, reached: Sequence[bool]) -> Estimate:
        """Return the success rate at the last look, with an interval valid at that stop.

        Results are ordered by stage: the earlier "meets", the better. The interval contains the
        rates at which results as good as this one, and as bad, have over 2.5 % probability each
        (Jennison & Turnbull, section 8.4). The threshold is outside exactly if the test decides.
        The flights after the deciding look do not count. Before the first look, there is none.
        """
        looks, failed = zip(*self._analyses(reached), strict=True)
        n, failures = looks[-1].flights, failed[-1]
        if n == 0:
            return statistics.NO_ESTIMATE
        if n < LOOKS[0]:
            return Estimate(1.0 - failures / n, None, None, n)
        decided = looks[-1].decide(failures) is not RequirementDecision.UNDECIDED
        # An undecided test may resume: the error of later looks is not spent yet.
        allowed = 0.5 * ALPHA if decided else error_spent(n)

        def end(side: int) -> float:
            if failures == (n, 0)[side]:
                return float(side)
            inside, outside = 1.0 - failures / n, float(side)
            while abs(outside - inside) > RATE_PRECISION:
                rate = 0.5 * (inside + outside)
                if _stagewise(looks, failures, rate)[side] > allowed:
                    inside = rate
                else:
                    outside = rate
            return outside

        return Estimate(1.0 - failures / n, end(0), end(1), n)

    def _analyses(self, reached: Sequence[bool]) -> list[tuple[InterimAnalysis, int]]:
        """Return the looks up to the deciding one, with failures; before the first, all flights."""
        analyses = []
        for look in _planned(self.threshold, sum(look <= len(reached) for look in LOOKS)):
            analyses.append((look, look.flights - sum(reached[: look.flights])))
            if look.decide(analyses[-1][1]) is not RequirementDecision.UNDECIDED:
                break
        n = len(reached)
        return analyses or [(InterimAnalysis(n, -1, n + 1), n - sum(reached))]

    def flights_needed(self, rate: float, flown: int = 0) -> int | None:
        """Return the number of flights at which a rate would decide; None: not within `LOOKS`."""
        for look in plan_looks(self.threshold):
            failures = round((1.0 - rate) * look.flights)
            if look.flights > flown and look.decide(failures) is not RequirementDecision.UNDECIDED:
                return look.flights
        return None


RATE_PRECISION = 1e-7
"""Precision of the ends of a sequential test's interval, found by bisection."""


def _stagewise(looks: Sequence[InterimAnalysis], failures: int, rate: float) -> tuple[float, float]:
    """Return the probabilities, at a success rate, of ending as good as at a look, and as bad.

    Args:
        looks: Analyses up to the last one, which ended the test.
        failures: Number of failures at the last look.
        rate: Success rate, 0 to 1.
    """
    undecided, fewest, before = np.ones(1), 0, 0
    good = bad = 0.0
    for look in looks:
        step = look.flights - before
        new = scipy.stats.binom.pmf(np.arange(step + 1), step, 1.0 - rate)
        undecided, before = np.convolve(undecided, new), look.flights
        if look is looks[-1]:
            break
        few, many = look.few + 1 - fewest, look.many - fewest
        good += float(undecided[:few].sum())
        bad += float(undecided[many:].sum())
        undecided, fewest = undecided[few:many], fewest + few
    at = failures - fewest
    return good + float(undecided[: at + 1].sum()), bad + float(undecided[at:].sum())

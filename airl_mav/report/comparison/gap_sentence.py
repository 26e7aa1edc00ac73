"""The gap of an arena in a sentence, and the names of the gaps that it tells."""

from __future__ import annotations

from pathlib import Path

from airl_mav.core.constants import US_PER_MS
from airl_mav.flight.statistics import Estimate
from airl_mav.report.comparison.model import ComparedRun, Comparison, Contrast
from airl_mav.report.measures import FLIGHT_TIME, interval_of

WITHOUT, WITH = "without-mitigation", "with-mitigation"
WITH_TRAINED, WITHOUT_TRAINED = "with-mitigation-trained", "without-mitigation-trained"
COMPENSATED = "compensated"


def gap_sentence(comparison: Comparison, arena: str) -> str:
    """Return what the gap of an arena is; empty without its reference or its target."""
    gaps = {c.entry.key: c for c in reversed(comparison.contrasts_of(arena))}
    if (gap := gaps.get(WITHOUT)) is None:
        return ""
    target, reference = comparison.pair(gap)
    place = "" if len(comparison.groups) == 1 else f" in {Path(arena).stem}"
    sentence = (
        f"On {_computer(target)}{place} {target.setup.policy.name} flies {_longer(gap)} than on "
        f"{_computer(reference)} and reaches {_rate(target)} of its goals, not {_rate(reference)}."
    )
    if (compensated := gaps.get(COMPENSATED)) is not None:
        rate = _rate(comparison.run(compensated.entry.target))
        sentence += (
            f" With its latency compensated it flies {_longer(compensated)} there and reaches"
            f" {rate}."
        )
    if (mitigated := gaps.get(WITH)) is None:
        return sentence
    other = comparison.run(mitigated.entry.target)
    sentence += (
        f" {other.setup.policy.name} there flies {_longer(mitigated)} than that and reaches "
        f"{_rate(other)}"
    )
    if (trained := gaps.get(WITH_TRAINED)) is not None:
        difference = trained.paired.flight_time_s.difference
        told = "with no common success"
        if difference.value is not None:
            told = f"{difference.value:+.1f} %{_interval(difference)}"
        sentence += f"; against the conditions of its own training that is {told} of flight time"
    return f"{sentence}."


def _computer(run: ComparedRun) -> str:
    """Return a run's computer with its latency."""
    name, mean = Path(run.setup.computer.name).stem, run.stages["t2"].mean
    if mean is None:
        return name
    return f"{name} (t2 {mean / US_PER_MS:,.{0 if mean >= 10.0 * US_PER_MS else 1}f} ms)"


def _longer(contrast: Contrast) -> str:
    """Return a gap of the flight time as a comparative, without its `than`."""
    difference = FLIGHT_TIME.change(contrast.paired).difference
    if difference.value is None:
        return "(no goal that both reached) longer"
    comparative = "shorter" if difference.value < 0.0 else "longer"
    return f"{abs(difference.value):.1f} % {comparative}{_interval(difference)}"


def _interval(difference: Estimate) -> str:
    text = interval_of(difference, 1, "+")
    return f" ({text})" if text else ""


def _rate(run: ComparedRun) -> str:
    rate = run.quality.success_rate
    return "none" if rate.value is None else f"{100.0 * rate.value:.1f} %"

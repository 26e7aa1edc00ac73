"""What a hardware gap says, in one sentence an arena."""

from __future__ import annotations

from pathlib import Path

from airl_mav.flight.statistics import Estimate
from airl_mav.report.gap.build import WITH, WITH_TRAINED, WITHOUT, ArenaGap, Flown, GapStudy
from airl_mav.report.tables import US_PER_MS


def answers(study: GapStudy) -> list[str]:
    """Return the answer of each arena that has both the reference and the target."""
    told = [answer(study, arena) for arena in study.arenas]
    return [sentence for sentence in told if sentence]


def answer(study: GapStudy, arena: ArenaGap) -> str:
    """Return what the gap of an arena is; empty without its reference or its target."""
    gap = arena.gap(WITHOUT)
    if gap is None:
        return ""
    target, reference = gap.target, gap.reference
    place = "" if len(study.arenas) == 1 else f" in {Path(arena.arena).stem}"
    sentence = (
        f"{_where(target)}{place} {target.setup.policy.name} flies "
        f"{_longer(gap.gap.flight_time_s.change.difference)} than {_there(reference)} and reaches "
        f"{_rate(target)} of its goals, not {_rate(reference)}"
    )
    sentence = f"{sentence}."
    mitigated = arena.gap(WITH)
    if mitigated is None:
        return sentence
    other = mitigated.target
    sentence += (
        f" {other.setup.policy.name} there flies "
        f"{_longer(mitigated.gap.flight_time_s.change.difference)} than that and reaches "
        f"{_rate(other)}"
    )
    trained = arena.gap(WITH_TRAINED)
    if trained is not None:
        told = _signed(trained.gap.flight_time_s.change.difference)
        sentence += f"; against the conditions of its own training that is {told} of flight time"
    return f"{sentence}."


def _where(column: Flown) -> str:
    """Return a column's computer and latency at the beginning of a sentence."""
    return f"On {_computer(column)}"


def _there(column: Flown) -> str:
    return f"on {_computer(column)}"


def _computer(column: Flown) -> str:
    mean = column.t2.mean
    late = "" if mean is None else f" (t2 {mean / US_PER_MS:,.{_digits(mean)}f} ms)"
    return f"{Path(column.setup.computer.name).stem}{late}"


def _digits(mean_us: float) -> int:
    return 0 if mean_us >= 10.0 * US_PER_MS else 1


def _longer(difference: Estimate) -> str:
    """Return a gap of the flight time as a comparative, without its `than`."""
    if difference.value is None:
        return "(no goal that both reached) longer"
    word = "shorter" if difference.value < 0.0 else "longer"
    return f"{abs(difference.value):.1f} % {word}{_interval(difference)}"


def _signed(difference: Estimate) -> str:
    if difference.value is None:
        return "with no common success"
    return f"{difference.value:+.1f} %{_interval(difference)}"


def _interval(difference: Estimate) -> str:
    if difference.low is None or difference.high is None:
        return ""
    return f" ({difference.low:+.1f} … {difference.high:+.1f})"


def _rate(column: Flown) -> str:
    rate = column.quality.success_rate
    return "none" if rate.value is None else f"{100.0 * rate.value:.1f} %"

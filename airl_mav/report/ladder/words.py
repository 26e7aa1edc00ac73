"""What else differs between the levels of a ladder, in words: facts from stamps and paths."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median

from airl_mav.flight.judge import Outcome
from airl_mav.flight.paired import Comparison, pair_by_seed
from airl_mav.report.ladder.build import Ladder, Level
from airl_mav.report.ladder.tables import successes_in_words
from airl_mav.report.tables import ms

WIDEST = 3
"""Pairs that are named for differing most."""


def differences_in_words(ladder: Ladder) -> list[str]:
    """Return what else differs between the levels: facts from the stamps and the paths."""
    lines = [
        _across(ladder, "Decision period", lambda level: _stage_ms(level, "period")),
        _across(ladder, "Frame to motors", lambda level: _stage_ms(level, "end_to_end")),
        _across(ladder, "Start of navigation", _start_in_words),
        _across(ladder, "Error of the estimated position", _error_in_words),
    ]
    for level, comparison in zip(ladder.levels[1:], ladder.comparisons, strict=True):
        lines.append(_pace_in_words(ladder.reference.name, level.name, comparison))
        lines.append(_widest_in_words(ladder.reference, level))
    lines += [
        f"The host could not keep pace at {level.name}: {ms(level.slipped_us, 0)} ms of simulated "
        f"time given up over {len(level.episodes):,} flights."
        for level in ladder.levels
        if level.slipped_us
    ]
    return [line for line in lines if line]


def _across(ladder: Ladder, what: str, words: Callable[[Level], str | None]) -> str:
    """Return one sentence over all levels that have something to say; empty when none has."""
    told = [(level.name, words(level)) for level in ladder.levels]
    parts = [f"{text} at {name}" for name, text in told if text is not None]
    return f"{what}: {'; '.join(parts)}." if parts else ""


def _stage_ms(level: Level, key: str) -> str | None:
    mean = level.stages[key].mean
    return None if mean is None else f"{ms(mean, 1)} ms"


def _start_in_words(level: Level) -> str | None:
    start = level.start
    if start is None:
        return None
    after = f"after {start.takeoff_s:.1f} s of take-off" if start.takeoff_s else "without take-off"
    return (
        f"{after}, {start.aside_m:.2f} m aside, {start.height_m:.2f} m high, "
        f"{start.speed_m_s:.2f} m/s"
    )


def _error_in_words(level: Level) -> str | None:
    error = level.position_error_m
    return None if error is None else f"{error:.2f} m"


def _pace_in_words(reference: str, level: str, comparison: Comparison) -> str:
    """Return mean speed and mean power of both on the common successes; empty without any."""
    time, distance, energy = comparison.flight_time_s, comparison.distance_m, comparison.energy_j
    parts = [
        f"{metres / seconds:.2f} m/s and {joules / seconds:.0f} W at {name}"
        for name, seconds, metres, joules in (
            (reference, time.reference, distance.reference, energy.reference),
            (level, time.other, distance.other, energy.other),
        )
        if seconds and metres is not None and joules is not None
    ]
    if not parts:
        return ""
    return f"Speed and power on {successes_in_words(time.difference.n)}: {'; '.join(parts)}."


def _widest_in_words(reference: Level, level: Level) -> str:
    """Return whether a few seeds make a difference, or all of them; empty without three pairs."""
    percent = {
        first.seed: 100.0 * (second.quality.flight_time_s / first.quality.flight_time_s - 1.0)
        for first, second in pair_by_seed(reference.episodes, level.episodes)
        if first.outcome is second.outcome is Outcome.SUCCESS and first.quality and second.quality
    }
    if len(percent) < WIDEST:
        return ""
    widest = sorted(percent, key=lambda seed: -abs(percent[seed]))[:WIDEST]
    told = ", ".join(f"{percent[seed]:+.1f} % with seed {seed}" for seed in widest)
    return (
        f"Flight time at {level.name} by pairs: median {median(percent.values()):+.1f} %; "
        f"widest {told}."
    )

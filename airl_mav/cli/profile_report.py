"""What `airl profile` says of what it measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from airl_mav.cli.profile_plan import Measured, ProfilePlan
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.machine import NOT_OFFERED, MachineState
from airl_mav.latency.autocorrelation import autocorrelation, independent_below, integrated_time
from airl_mav.latency.coordinated_omission import (
    CommandAges,
    ages_in_closed_loop,
    command_ages,
    corrected,
)
from airl_mav.latency.percentiles import MIN_SAMPLES, Summary, summarize
from airl_mav.latency.stages import SHOWN_STAGES, Samples, pool, stage_samples
from airl_mav.profiles.computer import load_computer

PERCENTILES = (50.0, 90.0, 99.0, 99.9)
TOO_FEW_CELL = "too few"
LAGS = (1, 2, 3, 5, 10, 20, 50)

PAPER_COMPUTER, PAPER_WORKLOAD = "ras-pi-4", "template-5x32"
"""The paper's gap: its onboard computer with its smallest policy."""

NO_GAP, SMALL_GAP = 0.01, 0.1
"""t2 as a share of the decision period below which it adds no gap, or a small one."""


ROUND_TRIP = "mavlink_round_trip"
"""Key of the TIMESYNC exchanges in flight."""

T1_UNCERTAINTY = "t1_uncertainty"
"""Key of how far t1 of each decision may be off, either way."""


def stages_of(measured: Measured) -> dict[str, Samples]:
    """Return the durations [µs] of each stage, all flights together.

    Where the simulator's clock was asked for (level hil) also `ROUND_TRIP`, and `T1_UNCERTAINTY` if
    the clocks could be related.
    """
    stages = pool(stage_samples(flight) for flight in measured.flights)
    if all("exchange_sent_us" in flight for flight in measured.flights):
        stages[ROUND_TRIP] = np.concatenate(
            [part["exchange_received_us"] - part["exchange_sent_us"] for part in measured.flights]
        )
    if all("capture_uncertainty_us" in flight for flight in measured.flights):
        stages[T1_UNCERTAINTY] = np.concatenate(
            [flight["capture_uncertainty_us"] for flight in measured.flights]
        )
    return stages


def ages_of(plan: ProfilePlan, measured: Measured) -> CommandAges:
    """Return how old the flown command was: as flown, or bare as it would be with the card's t3."""
    if measured.seen is None:
        t2 = stages_of(measured)["t2"]
        return ages_in_closed_loop(t2, round(plan.card.hold_s * US_PER_S))
    parts = measured.flights
    flight = np.repeat(np.arange(len(parts)), [len(part["sent_us"]) for part in parts])
    seen, sent = (
        np.concatenate([part[key] for part in parts]) for key in (measured.seen, "sent_us")
    )
    return command_ages(seen, sent, flight)


def print_measured(
    plan: ProfilePlan,
    measured: Measured,
    states: tuple[MachineState, MachineState],
    machine: Mapping[str, Any],
    console: Console,
) -> None:
    """Print everything."""
    stages = stages_of(measured)
    _print_machine(plan, states, machine, console)
    console.print(_stage_table(plan, measured, stages))
    console.print(_time_table(plan, measured, stages["t2"]))
    say(
        console,
        "The loop is closed: a decision begins when the last one has ended, so a slow one keeps "
        "others from being counted. The second table puts the time back: see docs/profile.md.",
    )
    say(console, correlation_line(stages["t2"]))
    for remark in measured.remarks:
        say(console, f"- {remark}")
    say(console, verdict(plan, stages["t2"]), style="bold")


def say(console: Console, text: str, style: str | None = None) -> None:
    """Print a line of words."""
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _print_machine(
    plan: ProfilePlan,
    states: tuple[MachineState, MachineState],
    machine: Mapping[str, Any],
    console: Console,
) -> None:
    table = Table("machine", "before", "after", title=plan.label)
    table.add_row("processor", plan.cpu, "")
    table.add_row("usable cores", f"{machine['cores_usable']}", "")
    table.add_row("system", f"{machine['os']}, {machine['architecture']}, {machine['python']}", "")
    table.add_row("runtime", plan.runtime, "")
    for (name, before), (_, after) in zip(states[0].rows(), states[1].rows(), strict=True):
        table.add_row(name, before, "" if before == after == NOT_OFFERED else after)
    console.print(table)


def _stage_table(plan: ProfilePlan, measured: Measured, stages: dict[str, Samples]) -> Table:
    title = (
        f"{plan.card.name}: {plan.card.parameters:,} parameters, "
        f"{plan.card.macs:,} multiply-accumulates"
    )
    caption = (
        f"ms. Left out as warm-up: the first {plan.command.warm_up} decisions of a flight. Opening "
        f"the network took {ms(measured.load_us)} ms, the first inference {ms(measured.first_us)} "
        f"ms. A p90 needs {MIN_SAMPLES[90.0]} samples, a p99 {MIN_SAMPLES[99.0]:,}, a p99.9 "
        f"{MIN_SAMPLES[99.9]:,}."
    )
    table = _percentile_table("stage", title, caption, "n")
    for stage in SHOWN_STAGES:
        if not stages[stage.key].size and plan.command.level == "bare":
            continue
        s = summarize(stages[stage.key])
        title = stage.title
        if stage.key == "t1" and T1_UNCERTAINTY in stages:
            title = f"{title} ±{ms(float(stages[T1_UNCERTAINTY].max()))}"
        table.add_row(title, f"{s.n:,}" if s.n else "-", *_cells(s))
    if ROUND_TRIP in stages:
        s = summarize(stages[ROUND_TRIP])
        table.add_row("MAVLink round trip", f"{s.n:,}" if s.n else "-", *_cells(s))
    return table


def _time_table(plan: ProfilePlan, measured: Measured, t2: Samples) -> Table:
    hold_s = plan.hold_s if measured.seen else plan.card.hold_s
    expected = f"{hold_s:g} s"
    ages = ages_of(plan, measured)
    flown = "" if measured.seen else f", as it would be flown with a hold of {expected}"
    seen = "decoded (t1 comes on top)" if measured.seen == "decoded_us" else "seen"
    table = _percentile_table(
        "over time",
        "What the flight feels: a stall weighs as long as it lasts",
        f"ms. Age of the command: since its image was {seen}, at a random moment of the flight"
        f"{flown}. t2 put back: with the decisions that were due every {expected} meanwhile.",
        "n",
    )
    s = summarize(t2)
    table.add_row("t2 a decision", f"{s.n:,}", *_cells(s))
    interval_us = round(hold_s * US_PER_S)
    if interval_us:
        s = summarize(corrected(t2, interval_us))
        table.add_row("t2 put back", f"{s.n:,}", *_cells(s))
    n = ages.youngest_us.size
    cells = (_tail(ages.percentile(p), n) for p in PERCENTILES)
    most = float(ages.oldest_us.max()) if n else None
    table.add_row("age of the command", f"{n:,}", ms(ages.mean), *cells, ms(most))
    return table


def _percentile_table(first: str, title: str, caption: str, count: str) -> Table:
    table = Table(title=title, caption=caption, caption_justify="left")
    table.add_column(first, no_wrap=True)
    for name in (count, "mean", "p50", "p90", "p99", "p99.9", "max"):
        table.add_column(name, justify="right")
    return table


def _cells(s: Summary) -> tuple[str, ...]:
    tails = (_tail(value, s.n) for value in (s.p50, s.p90, s.p99, s.p999))
    return (ms(s.mean), *tails, ms(s.max))


def _tail(value_us: float | None, n: int) -> str:
    return TOO_FEW_CELL if value_us is None and n else ms(value_us)


def ms(value_us: float | None) -> str:
    """Return a time in ms with three figures or more, "-" for none."""
    if value_us is None:
        return "-"
    value = value_us / US_PER_MS
    return f"{value:.3f}" if value < 10.0 else f"{value:.2f}" if value < 100.0 else f"{value:.1f}"


def correlation_line(t2: NDArray[np.int64]) -> str:
    """Return in words whether slow decisions come in runs."""
    lags = [lag for lag in LAGS if lag < t2.size]
    rho = autocorrelation(t2, lags[-1])
    bound, time = independent_below(t2.size), integrated_time(t2)
    values = ", ".join(f"{rho[lag]:+.2f} at {lag}" for lag in lags)
    runs = float(np.abs(rho[1:4]).max()) > bound
    meaning = (
        "slow decisions come in runs: the order of the samples matters, and is replayed"
        if runs
        else "no more than of independent samples: their order hardly matters"
    )
    return (
        f"autocorrelation of t2 by lag: {values} (independent: within ±{bound:.2f}); integrated "
        f"time {time:.1f} decisions: {meaning}"
    )


def verdict(plan: ProfilePlan, t2: NDArray[np.int64]) -> str:
    """Return in a sentence whether this computer adds a gap for this policy."""
    s = summarize(t2)
    hold_s = plan.card.hold_s
    period_us = hold_s * US_PER_S
    high, name = (s.max, "greatest") if s.p99 is None else (s.p99, "p99")
    assert s.p50 is not None and high is not None  # noqa: S101 (there are samples)
    paper = load_computer(PAPER_COMPUTER).workloads[PAPER_WORKLOAD]
    paper_ms = paper.latency.mean_ms or 0.0
    network = plan.network
    if (network.parameters, network.macs) == (paper.network.parameters, paper.network.macs):
        factor = paper_ms * US_PER_MS / s.p50
        return (
            f"t2 is {ms(s.p50)} ms (p50; {name} {ms(high)} ms) for the network that took the "
            f"paper's Raspberry Pi 4 {paper_ms:g} ms: {factor:.3g} times as long as here"
        )
    if not period_us:
        return f"t2 is {ms(s.p50)} ms (p50; {name} {ms(high)} ms); the policy's card has no hold"
    share, high_share = s.p50 / period_us, high / period_us
    if high_share < NO_GAP:
        head = "this computer adds no gap for this policy"
    elif high_share < SMALL_GAP:
        head = "this computer adds a small gap for this policy at most"
    else:
        head = "this computer adds a gap for this policy"
    return (
        f"{head}: t2 is {share:.2%} of its decision period of {hold_s:g} s (p50; {name} "
        f"{high_share:.2%}); the paper's {paper_ms:g} ms are a network of "
        f"{paper.network.parameters / 1e6:.0f} million parameters, and would be "
        f"{paper_ms * US_PER_MS / period_us:.0%} of it: airl profile --network 5x32 "
        "--image 256x154 times that one here"
    )

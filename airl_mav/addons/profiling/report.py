"""Terminal report of a measurement: machine, stages, command age, verdict."""

from __future__ import annotations

import shlex

from rich.console import Console

from airl_mav.addons.profiling.measurement import ROUND_TRIP, T1_UNCERTAINTY, ComputerMeasurement
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.machine import NOT_OFFERED
from airl_mav.latency.stages import (
    MIN_SAMPLES,
    SHOWN_STAGES,
    Samples,
    corrected,
    summarize,
)
from airl_mav.policy.card import PolicyCard
from airl_mav.profiles.computer import load_computer
from airl_mav.report.document import TOO_FEW_CELL, Column, TableView, print_table
from airl_mav.scenario.model import DEFAULT_POLICY

PERCENTILES = (50.0, 90.0, 99.0, 99.9)
PERCENTILE_COLUMNS = (
    Column("duration", "ms", number=False),
    *(Column(title) for title in ("n", "mean", "p50", "p90", "p99", "p99.9", "max")),
)

PAPER_COMPUTER, PAPER_WORKLOAD = "ras-pi-4", "template-5x32"
"""The paper's gap: its onboard computer with its smallest policy."""

NO_GAP, SMALL_GAP = 0.01, 0.1
"""Maximum t2 as a share of the decision period for no gap, and for a small gap."""


def print_measurement(measured: ComputerMeasurement, console: Console) -> None:
    """Print all results and the written files."""
    print_table(_machine_table(measured), console, wrap=True)
    print_table(_stage_table(measured), console)
    print_table(_time_table(measured), console)
    for remark in measured.recording.remarks:
        _say(console, f"- {remark}")
    _say(console, verdict(measured.card, measured.t2_us), style="bold")
    if measured.soak is not None:
        _say(console, measured.soak.sentence(), style="bold")
    for path in measured.files:
        _say(console, f"written    {path}")
    if measured.files:
        request = measured.request
        policy = shlex.quote(request.policy or DEFAULT_POLICY)
        _say(
            console,
            f"fly as it  airl evaluate {policy if request.network is None else 'POLICY'} "
            f"--computer {shlex.quote(str(measured.files[0]))} --workload {measured.workload}",
        )


def _say(console: Console, text: str, style: str | None = None) -> None:
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _machine_table(measured: ComputerMeasurement) -> TableView:
    machine = measured.machine
    rows = [
        ("processor", measured.profile.cpu, ""),
        ("usable cores", f"{machine['cores_usable']}", ""),
        ("system", f"{machine['os']}, {machine['architecture']}, {machine['python']}", ""),
        ("runtime", measured.network.runtime, ""),
    ]
    states = zip(measured.before.rows(), measured.after.rows(), strict=True)
    for (name, before), (_, after) in states:
        rows.append((name, before, "" if before == after == NOT_OFFERED else after))
    rows.append(("power", f"{measured.power}", ""))
    columns = tuple(Column(title, number=False) for title in ("machine", "before", "after"))
    return TableView("machine", measured.computer, columns, tuple(rows))


def _stage_table(measured: ComputerMeasurement) -> TableView:
    card, recording, stages = measured.card, measured.recording, measured.stages
    rows = []
    for stage in SHOWN_STAGES:
        samples, title = stages[stage.key], stage.title
        if not samples.size and measured.request.level == "bare":
            continue
        if stage.key == "t1" and T1_UNCERTAINTY in stages:
            title = f"{title} ±{_ms(float(stages[T1_UNCERTAINTY].max()))}"
        rows.append(_summary_row(title, samples))
    if ROUND_TRIP in stages:
        rows.append(_summary_row("MAVLink round trip", stages[ROUND_TRIP]))
    return TableView(
        "stages",
        f"{card.name}: {card.parameters:,} parameters, {card.macs:,} multiply-accumulates",
        PERCENTILE_COLUMNS,
        tuple(rows),
        (
            f"Left out as warm-up: the first {measured.request.warm_up} decisions of a flight. "
            f"Opening the network took {_ms(recording.load_us)} ms, the first inference "
            f"{_ms(recording.first_us)} ms. A p90 needs {MIN_SAMPLES[90.0]} samples, a p99 "
            f"{MIN_SAMPLES[99.0]:,}, a p99.9 {MIN_SAMPLES[99.9]:,}.",
        ),
    )


def _time_table(measured: ComputerMeasurement) -> TableView:
    recording = measured.recording
    hold_s, flown = measured.request.hold_s, ""
    if recording.exposure is None:
        hold_s = measured.card.hold_s
        flown = f", as it would be flown with a hold of {hold_s:g} s"
    start = "decoded (t1 comes on top)" if recording.exposure == "decoded_us" else "exposed"
    ages = recording.command_ages(hold_s)
    n = ages.youngest_us.size
    tails = (_percentile(ages.percentile(p), n) for p in PERCENTILES)
    oldest_us = float(ages.oldest_us.max()) if n else None
    rows = [_summary_row("t2 per decision", measured.t2_us)]
    if interval_us := round(hold_s * US_PER_S):
        rows.append(_summary_row("t2 corrected", corrected(measured.t2_us, interval_us)))
    rows.append(("age of the command", f"{n:,}", _ms(ages.mean), *tails, _ms(oldest_us)))
    return TableView(
        "time",
        "What the flight feels: a stall weighs as long as it lasts",
        PERCENTILE_COLUMNS,
        tuple(rows),
        (
            f"Age of the command: since its image was {start}, at a random moment of the flight"
            f"{flown}. t2 corrected: with the decisions that were due every {hold_s:g} s "
            "meanwhile.",
            "The loop is closed: each decision waits for the last one, so slow decisions are "
            "undercounted. Corrected samples compensate for that.",
        ),
    )


def _summary_row(title: str, samples: Samples) -> tuple[str, ...]:
    s = summarize(samples)
    tails = (_percentile(value, s.n) for value in (s.p50, s.p90, s.p99, s.p999))
    return title, f"{s.n:,}" if s.n else "-", _ms(s.mean), *tails, _ms(s.max)


def _percentile(value_us: float | None, n: int) -> str:
    return TOO_FEW_CELL if value_us is None and n else _ms(value_us)


def _ms(value_us: float | None) -> str:
    """Return a time in ms with three figures or more, "-" for None."""
    if value_us is None:
        return "-"
    value = value_us / US_PER_MS
    return f"{value:.3f}" if value < 10.0 else f"{value:.2f}" if value < 100.0 else f"{value:.1f}"


def verdict(card: PolicyCard, t2_us: Samples) -> str:
    """Return a sentence on the gap that this computer adds for a policy."""
    s = summarize(t2_us)
    period_us = card.hold_s * US_PER_S
    high, name = (s.max, "greatest") if s.p99 is None else (s.p99, "p99")
    assert s.p50 is not None and high is not None  # noqa: S101 (there are samples)
    paper = load_computer(PAPER_COMPUTER).workloads[PAPER_WORKLOAD]
    paper_ms = paper.latency.mean_ms or 0.0
    if (card.parameters, card.macs) == (paper.network.parameters, paper.network.macs):
        factor = paper_ms * US_PER_MS / s.p50
        return (
            f"t2 is {_ms(s.p50)} ms (p50; {name} {_ms(high)} ms) for the network that took the "
            f"paper's Raspberry Pi 4 {paper_ms:g} ms: {factor:.3g} times as long as here"
        )
    if not period_us:
        return f"t2 is {_ms(s.p50)} ms (p50; {name} {_ms(high)} ms); the policy's card has no hold"
    share, high_share = s.p50 / period_us, high / period_us
    if high_share < NO_GAP:
        gap = "this computer adds no gap for this policy"
    elif high_share < SMALL_GAP:
        gap = "this computer adds a small gap for this policy at most"
    else:
        gap = "this computer adds a gap for this policy"
    return (
        f"{gap}: t2 is {share:.2%} of its decision period of {card.hold_s:g} s (p50; {name} "
        f"{high_share:.2%}); the paper's {paper_ms:g} ms are a network of "
        f"{paper.network.parameters / 1e6:.0f} million parameters, and would be "
        f"{paper_ms * US_PER_MS / period_us:.0%} of it: airl profile --network 5x32 "
        "--image 256x154 times that one here"
    )

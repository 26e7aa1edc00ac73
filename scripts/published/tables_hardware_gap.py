"""Tables of the hardware gap: with mitigation, in three arenas, by growing latency."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.profiles.loading import PublishedRun, PublishedTable, load_published, published_gap
from published.blocks import DEFAULT, Records, Render, block
from published.record import MEASURES, FlownRun, Gap, Record
from published.text import (
    both,
    change,
    energy_kj,
    interval_cell,
    number,
    percent,
    rate,
    table,
)

# --- the gap


def _letters(records: Records) -> dict[str, FlownRun]:
    roles = ("reference", "target", "mitigated", "training", "mitigated-reference")
    runs = records["hardware-gap"].runs
    return {letter: runs[f"{DEFAULT}-{role}"] for letter, role in zip("abcde", roles, strict=True)}


def _gap(record: Record, target: str, reference: str, arena: str = DEFAULT) -> Gap:
    return record.gaps[f"{arena}-{target} against {arena}-{reference}"]


@block("evidence", "hardware-gap", "levels-fast")
def evidence(records: Records) -> str:
    """Return the results of the README as a list: latency of a computer, and fidelity levels."""
    gap, levels = records["hardware-gap"], records["levels-fast"]
    a, b, compensated = (
        gap.runs[f"{DEFAULT}-{role}"] for role in ("reference", "target", "compensated")
    )
    late, mended = (_gap(gap, role, "reference") for role in ("target", "compensated"))
    level = next(iter(levels.gaps.values()))
    return (
        f"- At the decision latency of a Raspberry Pi 4 ({b.t2_ms:.0f} ms instead of "
        f"{a.t2_ms:.0f} ms), success falls from {_success(a)} to {_success(b)} %. "
        f"Medians: {_costs(late)}. Compensated in flight: {_success(compensated)} %. "
        f"Medians: {_costs(mended)}.\n"
        f"- The vectorized simulator and flights through MAVLink and MAVSDK differ by "
        f"{number(level.flight_time_s, 1, '+')} % in flight time on {level.flight_time_s.n} seeds."
    )


def _success(run: FlownRun) -> str:
    return number(run.success_rate, 1, scale=100.0)


def _costs(gap: Gap) -> str:
    """Return the relative changes of time, with its interval, of distance and of energy."""
    figures = {"distance": gap.distance_m, "energy": gap.energy_j}
    rest = (f"{name} {number(figure, 0, '+')} %" for name, figure in figures.items())
    return ", ".join((f"time {percent(gap.flight_time_s)}", *rest))


def _changes(gap: Gap) -> tuple[str, ...]:
    figures = (gap.flight_time_s, gap.distance_m, gap.energy_j)
    return (*(percent(each) for each in figures), f"{gap.flight_time_s.n}")


@block("mitigation-runs", "hardware-gap")
def mitigation_runs(records: Records) -> str:
    runs = _letters(records)
    told = _mitigation_paper().columns
    columns = [told[role] for role in ("reference", "target", "mitigated", "training")]
    ours = tuple(runs.values())
    shown: tuple[tuple[str, Callable[[FlownRun], str], Callable[[PublishedRun], str]], ...] = (
        ("t2, mean [ms]", lambda run: f"{run.t2_ms:.1f}", lambda told: f"{told.latency_ms:g}"),
        ("success [%]", rate, lambda told: f"{told.success_percent:g}"),
        (
            "flight time [s]",
            lambda run: number(run.flight_time_s, 2),
            lambda told: f"{told.flight_time_s:.2f}",
        ),
        (
            "distance [m]",
            lambda run: number(run.distance_m, 2),
            lambda told: f"{told.distance_m:.2f}",
        ),
        ("energy, vehicle [kJ]", energy_kj, lambda told: f"{told.energy_kj:.2f}"),
    )
    rows = [(title, *map(mine, ours), *map(theirs, columns)) for title, mine, theirs in shown]
    return table(("", *runs, "paper a", "b", "c", "d"), rows, 9)


_GAPS = (
    ("without mitigation, reference undelayed (b, a)", "target", "reference"),
    ("compensated in flight, reference undelayed", "compensated", "reference"),
    ("... decisions pipelined", "compensated-pipelined", "reference"),
    ("mitigated and compensated, reference undelayed", "mitigated-compensated", "reference"),
    ("with mitigation, reference undelayed (c, a)", "mitigated", "reference"),
    ("without mitigation, reference delay-trained (b, d)", "target", "training"),
    ("with mitigation, reference delay-trained (c, d)", "mitigated", "training"),
    ("mitigated policy where nothing is late (e, a)", "mitigated-reference", "reference"),
)


def _mitigation_paper() -> PublishedTable:
    return next(t for t in load_published().tables if {"mitigated", "training"} <= {*t.columns})


def _told(target: str, reference: str) -> tuple[str, ...]:
    """Return a gap of the paper: as printed, or calculated from its columns (◦)."""
    paper = _mitigation_paper()
    worked_out = published_gap(paper.columns[reference], paper.columns[target])
    own = [getattr(worked_out, field) for field in _GAP_FIELDS]
    if reference != "training":
        return ("the paper ◦", *(f"{value:+.{0 if i == 0 else 1}f}" for i, value in enumerate(own)))
    printed = [getattr(paper.printed[target], field) for field in _GAP_FIELDS]
    cells = [f"{printed[0]:g} ({own[0]:+.0f} points ◦)"]
    for said, value in zip(printed[1:], own[1:], strict=True):
        same = abs(said - value) < SAME_PERCENT
        cells.append(f"{said:g}" if same else f"{said:g} ({value:+.1f} ◦)")
    return ("the paper", *cells)


_GAP_FIELDS = ("success", "flight_time_percent", "distance_percent", "energy_percent")
SAME_PERCENT = 0.05
"""Maximum difference of gaps [%] that count as equal to the printed ones."""


@block("mitigation-gaps", "hardware-gap")
def mitigation_gaps(records: Records) -> str:
    rows = []
    for title, target, reference in _GAPS:
        gap = _gap(records["hardware-gap"], target, reference)
        cells = (both(getattr(gap, measure), 1, "+") for measure in MEASURES)
        rows.append((title, "ours", *cells, f"{gap.flight_time_s.n}"))
        if {target, reference} <= {*_mitigation_paper().columns}:
            rows.append(("", *_told(target, reference), ""))
    heads = ("success [points]", "flight time [%]", "distance [%]", "energy [%]", "pairs")
    return table(("gap", "", *heads), rows, 5)


@block("intervals", "hardware-gap", "hardware-gap-lockstep")
def intervals(records: Records) -> str:
    rows = []
    for name in ("hardware-gap-lockstep", "hardware-gap"):
        gap = _gap(records[name], "target", "reference")
        level = records[name].runs[gap.target].level
        change_of = gap.flight_time_s
        rows.append(
            (
                f"{change_of.n} (`{level}`)",
                f"{number(change_of, 1, '+')} %",
                interval_cell(change_of),
            )
        )
    return table(("pairs", "difference in flight time", "95 % interval"), rows)


# --- system evaluation


def _system(arena: str) -> Render:
    def render(records: Records) -> str:
        record = records["system"]
        runs = [record.runs[f"{arena}-{role}"] for role in ("reference", "target")]
        gap = _gap(record, "target", "reference", arena)
        # Select the table of a network; the other table of its arena is of mitigation.
        told = next(t for t in load_published().tables if t.arena == arena and t.policy)
        paper, printed = told.columns, told.printed["target"]
        a, b = paper["reference"], paper["target"]
        rows = [
            (
                "t2 [ms]",
                *(f"{run.t2_ms:.1f}" for run in runs),
                f"{gap.t2_percent:+,.0f} %",
                *(f"{each.latency_ms:g}" for each in (a, b)),
                f"{printed.latency_percent:g} %",
            ),
            (
                "success [%]",
                *(rate(run) for run in runs),
                f"{both(gap.success_rate, 1, '+')} points",
                *(f"{each.success_percent:g}" for each in (a, b)),
                f"{printed.success:g} points",
            ),
        ]
        for title, field, digits, scale, theirs, printed_field in (
            ("flight time [s]", "flight_time_s", 2, 1.0, "flight_time_s", "flight_time_percent"),
            ("distance [m]", "distance_m", 2, 1.0, "distance_m", "distance_percent"),
            ("energy, vehicle [kJ]", "energy_j", 2, 1e-3, "energy_kj", "energy_percent"),
        ):
            rows.append(
                (
                    title,
                    *(number(getattr(run, field), digits, scale=scale) for run in runs),
                    percent(getattr(gap, field)),
                    *(f"{getattr(each, theirs):.2f}" for each in (a, b)),
                    f"{getattr(printed, printed_field):g} %",
                )
            )
        rows.append(("pairs", "", "", f"{gap.flight_time_s.n}", "", "", ""))
        heads = (arena, "workstation", "Ras-Pi 4", "gap", "the paper: i9", "Ras-Pi 4", "gap")
        return table(heads, rows, 6)

    return render


for _arena in ("no-obstacles", "static-obstacles", "dynamic-obstacles"):
    block(f"system-{_arena}", "system")(_system(_arena))


# --- roofline


@block("roofline", "roofline")
def roofline(records: Records) -> str:
    printed = records["roofline"].printed
    assert printed is not None
    return table(printed.columns, printed.rows, 8)


# --- degradation

_LATENCIES = (
    ("1 ms", "native"),
    ("150 ms", "150ms"),
    ("300 ms", "300ms"),
    ("400 ms", "400ms"),
    ("950 ms", "950ms"),
)


@block("degradation", "degradation")
def degradation(records: Records) -> str:
    record, paper = records["degradation"], load_published().degradation
    told = {f"{each.latency_ms:g} ms": each for each in paper}
    first, rows = paper[0], []
    for late, name in _LATENCIES:
        if late == "1 ms" or late in told:
            theirs = first if late == "1 ms" else told[late]
            rows.append((f"{theirs.latency_ms:g} ms", "the paper", "", *_theirs(theirs, first)))
        run = record.runs[f"{DEFAULT}-{name}"]
        figures = (
            f"{number(run.flight_time_s, 2)} s",
            f"{number(run.distance_m, 2)} m",
            f"{energy_kj(run)} kJ",
        )
        if name == "native":
            rows.append((late, "ours", f"{rate(run)} %", *figures, ""))
            continue
        gap = record.gaps[f"{DEFAULT}-{name} against {DEFAULT}-native"]
        *changes, pairs = _changes(gap)
        cells = (f"{f}, {c}" for f, c in zip(figures, changes, strict=True))
        rows.append(("" if late in told else late, "ours", f"{rate(run)} %", *cells, pairs))
    heads = ("success", "flight time", "distance", "energy", "pairs")
    return table(("t2", "", *heads), rows, 5)


def _theirs(each: PublishedRun, first: PublishedRun) -> tuple[str, ...]:
    cells = []
    for field, unit in (("flight_time_s", "s"), ("distance_m", "m"), ("energy_kj", "kJ")):
        more = "" if each is first else f" ({change(each, first, field):+.0f} % ◦)"
        cells.append(f"{getattr(each, field):.2f} {unit}{more}")
    return (*cells, "")

"""Tables that compare two levels, or two networks, on the same seeds."""

from __future__ import annotations

from published.blocks import Records, block
from published.record import MEASURES, Figure, Record
from published.text import NONE, both, interval_cell, number, percent, rate, table

# --- levels


@block("ladder", "ladder")
def ladder(records: Records) -> str:
    return _levels((("", records["ladder"]),))


@block("ladder-fast", "ladder-fast")
def ladder_fast(records: Records) -> str:
    return _levels((("", records["ladder-fast"]),))


@block("ladder-conditions", "ladder-wind", "ladder-spread", "ladder-dense")
def ladder_conditions(records: Records) -> str:
    parts = (
        ("wind, 200 seeds", "ladder-wind"),
        ("spread and depth noise, 100 seeds", "ladder-spread"),
        ("all of it, in `dense-obstacles`, 160 seeds", "ladder-dense"),
    )
    return _levels(tuple((title, records[name]) for title, name in parts))


@block("ladder-late", "ladder-late", "ladder-mitigated")
def ladder_late(records: Records) -> str:
    rows = []
    for title, name in (
        ("`static-obstacles`", "ladder-late"),
        ("mitigated policy", "ladder-mitigated"),
    ):
        (gap,) = records[name].gaps.values()
        cells = (both(getattr(gap, measure), 1, "+") for measure in MEASURES)
        rows.append((f"{title}, {gap.success_rate.n} seeds", *cells))
    heads = ("success [points]", "flight time [%]", "distance [%]", "energy [%]")
    return table(("gym to lockstep, 396 ms", *heads), rows, 4)


@block("ladder-crowded", "ladder-crowded")
def ladder_crowded(records: Records) -> str:
    return _levels((("", records["ladder-crowded"]),))


@block("ladder-empty", "ladder-empty")
def ladder_empty(records: Records) -> str:
    return _levels((("", records["ladder-empty"]),))


@block("ladder-one-arena", "ladder-one-arena")
def ladder_one_arena(records: Records) -> str:
    return _levels((("", records["ladder-one-arena"]),))


@block("sitl", "sitl")
def sitl(records: Records) -> str:
    return _levels((("", records["sitl"]),), "sitl")


_PREDICTED = {"`static-obstacles`": "predicted"}
"""Results with flights predicted from a file of latencies, by policy."""


@block("predicted", *_PREDICTED.values())
def predicted(records: Records) -> str:
    rows = []
    for title, name in _PREDICTED.items():
        record = records[name]
        (gap,) = record.gaps.values()
        pair = [record.runs[run] for run in (gap.reference, gap.target)]
        rows.append(
            (
                title,
                *(f"{number(run.flight_time_s, 2)} s" for run in pair),
                percent(gap.flight_time_s),
                *(f"{rate(run)} %" for run in pair),
                f"{gap.flight_time_s.n}",
            )
        )
    heads = ("flight time at gym, predicted", "in lockstep", "difference")
    return table(("", *heads, "success, predicted", "in lockstep", "pairs"), rows, 6)


@block("quantisation", "quantisation")
def quantisation(records: Records) -> str:
    record, rows = records["quantisation"], []
    for gap in record.gaps.values():
        floats, integers = record.runs[gap.reference], record.runs[gap.target]
        rows.append(
            (
                f"`{floats.policy}`",
                *(f"{rate(run)} %" for run in (floats, integers)),
                f"{both(gap.success_rate, 1, '+')} points",
                *(percent(each) for each in (gap.flight_time_s, gap.distance_m, gap.energy_j)),
            )
        )
    heads = ("success, floats", "success, int8", "difference", "flight time", "distance", "energy")
    return table(("policy", *heads), rows, 6)


def _levels(parts: tuple[tuple[str, Record], ...], target_level: str = "lockstep") -> str:
    """Return the runs of two levels side by side, and their differences over the pairs."""
    rows = []
    for title, record in parts:
        (gap,) = record.gaps.values()
        reference, target = record.runs[gap.reference], record.runs[gap.target]
        head = f"{title}: " if title else ""
        rows.append(
            (
                f"{head}success",
                *(f"{rate(run)} %" for run in (reference, target)),
                f"{number(gap.success_rate, 1, '+')} points",
                interval_cell(gap.success_rate),
            )
        )
        for name, field, unit, scale in (
            ("flight time", "flight_time_s", "s", 1.0),
            ("distance", "distance_m", "m", 1.0),
            ("energy", "energy_j", "kJ", 1e-3),
        ):
            change_of: Figure = getattr(gap, field)
            rows.append(
                (
                    name,
                    *(
                        f"{number(getattr(r, field), 2, scale=scale)} {unit}"
                        for r in (reference, target)
                    ),
                    f"{number(change_of, 1, '+')} %",
                    interval_cell(change_of),
                )
            )
            if field == "flight_time_s":
                # One long flight can dominate a mean.
                median = gap.median_flight_time
                change = f"{number(median, 1, '+')} %"
                rows.append(("its median by pairs", NONE, NONE, change, interval_cell(median)))
    return table(("same seeds", "gym", target_level, "difference", "95 % interval"), rows)

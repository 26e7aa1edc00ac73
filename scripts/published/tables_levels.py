"""Tables that compare two levels, or two networks, on the same seeds."""

from __future__ import annotations

from published.blocks import Records, block
from published.record import MEASURES, Figure, Record
from published.text import NONE, both, interval_cell, number, percent, rate, table

# --- levels


_COMPARED = {
    "levels-fast": "`static-obstacles-fast`",
    "levels": "`static-obstacles`",
    "levels-one-arena": "`static-obstacles`, arena seed 431 alone",
    "levels-wind": "`static-obstacles`, wind",
    "levels-spread": "`static-obstacles`, domain randomization, noisy depth",
    "levels-dense": "`static-obstacles`, all of these in `dense-obstacles`",
    "levels-empty": "`crowded` in `no-obstacles`",
    "levels-crowded": "`crowded`, moving obstacles",
}
"""Results that compare gym and lockstep, with their titles."""


@block("levels", *_COMPARED)
def levels(records: Records) -> str:
    rows = []
    for name, title in _COMPARED.items():
        record = records[name]
        (gap,) = record.gaps.values()
        pair = [record.runs[run] for run in (gap.reference, gap.target)]
        changes = (gap.flight_time_s, gap.median_flight_time, gap.distance_m, gap.energy_j)
        rows.append(
            (
                title,
                f"{gap.success_rate.n}",
                *(f"{number(run.success_rate, 1, scale=100.0)}" for run in pair),
                both(gap.success_rate, 1, "+"),
                *(both(change, 1, "+") for change in changes),
            )
        )
    heads = ("seeds", "success, gym [%]", "success, lockstep [%]", "difference [points]")
    changed = ("flight time [%]", "its median [%]", "distance [%]", "energy [%]")
    return table(("policy and conditions", *heads, *changed), rows, 8)


@block("levels-fast", "levels-fast")
def levels_fast(records: Records) -> str:
    return _levels(records["levels-fast"])


@block("levels-late", "levels-late", "levels-mitigated")
def levels_late(records: Records) -> str:
    rows = []
    for title, name in (
        ("`static-obstacles`", "levels-late"),
        ("mitigated policy", "levels-mitigated"),
    ):
        (gap,) = records[name].gaps.values()
        cells = (both(getattr(gap, measure), 1, "+") for measure in MEASURES)
        rows.append((f"{title}, {gap.success_rate.n} seeds", *cells))
    heads = ("success [points]", "flight time [%]", "distance [%]", "energy [%]")
    return table(("gym to lockstep, 396 ms", *heads), rows, 4)


@block("sitl", "sitl")
def sitl(records: Records) -> str:
    return _levels(records["sitl"], "sitl")


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


def _levels(record: Record, target_level: str = "lockstep") -> str:
    """Return the runs of two levels side by side, and their differences over the pairs."""
    (gap,) = record.gaps.values()
    pair = [record.runs[run] for run in (gap.reference, gap.target)]
    rows = [
        (
            "success",
            *(f"{rate(run)} %" for run in pair),
            f"{number(gap.success_rate, 1, '+')} points",
            interval_cell(gap.success_rate),
        )
    ]
    for name, field, unit, scale in (
        ("flight time", "flight_time_s", "s", 1.0),
        ("distance", "distance_m", "m", 1.0),
        ("energy", "energy_j", "kJ", 1e-3),
    ):
        change: Figure = getattr(gap, field)
        values = (f"{number(getattr(run, field), 2, scale=scale)} {unit}" for run in pair)
        rows.append((name, *values, f"{number(change, 1, '+')} %", interval_cell(change)))
        if field == "flight_time_s":
            # One long flight can dominate a mean.
            median = gap.median_flight_time
            percents = f"{number(median, 1, '+')} %"
            rows.append(("its median by pairs", NONE, NONE, percents, interval_cell(median)))
    return table(("same seeds", "gym", target_level, "difference", "95 % interval"), rows)

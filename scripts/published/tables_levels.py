"""Tables that compare two levels, or two networks, on the same seeds."""

from __future__ import annotations

from published.blocks import Records, block
from published.text import both, number, percent, rate, table

# --- levels


_COMPARED = {
    "levels-fast": "`static-obstacles-fast`",
    "levels": "`static-obstacles`",
    "levels-wind": "`static-obstacles`, wind",
    "levels-dense": "`static-obstacles`, wind, randomized, noisy, in `dense-obstacles`",
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
        changes = (gap.flight_time_s, gap.distance_m, gap.energy_j)
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
    changed = ("flight time [%]", "distance [%]", "energy [%]")
    return table(("policy and conditions", *heads, *changed), rows, 7)


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

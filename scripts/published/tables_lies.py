"""Table of the false telemetry that the companion does not find in time."""

from __future__ import annotations

from published.blocks import Records, block
from published.text import table


@block("telemetry-lies", "telemetry-lies")
def telemetry_lies(records: Records) -> str:
    """Return the lies by reason; the whole matrix is in the result's file."""
    printed = records["telemetry-lies"].printed
    assert printed is not None
    lies: dict[str, list[str]] = {}
    farthest_m: dict[str, float] = {}
    for what, how, *cells, reason in printed.rows:
        if not reason:
            continue
        lies.setdefault(reason, []).append(f"{what} {how}")
        moved_m = max(float(cell.split("; ")[1].removesuffix(" m")) for cell in cells if cell)
        farthest_m[reason] = max(moved_m, farthest_m.get(reason, 0.0))
    rows = [(why, ", ".join(names), f"{farthest_m[why]:.1f}") for why, names in lies.items()]
    found = len(printed.rows) - sum(map(len, lies.values()))
    return f"Found in time, or harmless: {found} of {len(printed.rows)}. The others:\n\n" + table(
        ("reason", "false values", "off the path [m]"), rows, 1
    )

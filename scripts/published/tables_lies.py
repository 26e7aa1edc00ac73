"""Table of the false telemetry that the companion does not find in time."""

from __future__ import annotations

from published.blocks import Records, block
from published.text import table


@block("telemetry-lies", "telemetry-lies")
def telemetry_lies(records: Records) -> str:
    """Return the lies by reason; the whole matrix is in the result's file."""
    printed = records["telemetry-lies"].printed
    assert printed is not None
    lies: dict[str, dict[str, list[str]]] = {}
    farthest_m: dict[str, float] = {}
    for what, how, *cells, reason in printed.rows:
        if not reason:
            continue
        lies.setdefault(reason, {}).setdefault(what, []).append(how)
        moved_m = max(float(cell.split("; ")[1].removesuffix(" m")) for cell in cells if cell)
        farthest_m[reason] = max(moved_m, farthest_m.get(reason, 0.0))
    rows = []
    for why, values in lies.items():
        listed = "; ".join(f"{what} {', '.join(hows)}" for what, hows in values.items())
        rows.append((why, listed, f"{farthest_m[why]:.1f}"))
    others = sum(len(hows) for values in lies.values() for hows in values.values())
    return (
        f"Found in time, or harmless: {len(printed.rows) - others} of {len(printed.rows)}."
        " The others:\n\n" + table(("reason", "false values", "off the path [m]"), rows, 1)
    )

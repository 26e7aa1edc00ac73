"""Tables of the path from a velocity setpoint to the velocity."""

from __future__ import annotations

from airl_mav.addons.conformance.result import Reference
from airl_mav.core.constants import MS_PER_S
from airl_mav.profiles.loading import load_profile
from published.blocks import Records, block
from published.text import NONE, table

MOVED_M_S = 0.05
"""Reaction threshold (`scripts/response_taken_apart.py`)."""


@block("client-latency", "mavsdk-latency")
def client_latency(records: Records) -> str:
    """Return each MAVLink client's median, idle, and 99th percentile, busy."""
    flown = records["mavsdk-latency"].printed
    assert flown is not None
    rows: dict[str, list[str]] = {}
    for row in flown.rows:
        of = dict(zip(flown.columns, row, strict=True))
        shown = of["p50, ms"] if of["load"] == "undisturbed" else of["p99, ms"]
        rows.setdefault(of["client"], []).append(shown)
    heads = ("setpoint: p50 [ms]", "p99, busy", "telemetry: p50 [ms]", "p99, busy")
    return table(("client", *heads), ((name, *cells) for name, cells in rows.items()), 4)


@block("setpoint-response", "response-taken-apart")
def setpoint_response(records: Records) -> str:
    """Return the stages of the built-in vehicle, then PX4's."""
    flown = records["response-taken-apart"].printed
    assert flown is not None
    rows = [[f"built-in: {stage}", *cells] for stage, *cells in flown.rows]
    steps = load_profile("conformance", "px4-1.16", Reference).steps
    north, up = steps["north-2"], steps["up-2"]
    rows.append([f"PX4: estimated velocity moved by {1e3 * MOVED_M_S:g} mm/s"])
    rows[-1] += [_ms(north.latency_s), _ms(up.latency_s)]
    rows.append(["PX4: half of the step, estimated", _ms(north.t50_s), _ms(up.t50_s)])
    return table(flown.columns, rows, 2)


def _ms(seconds: float | None) -> str:
    return NONE if seconds is None else f"{MS_PER_S * seconds:.0f}"

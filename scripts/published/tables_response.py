"""Table of the stages between a velocity setpoint and the velocity."""

from __future__ import annotations

import math

from airl_mav.addons.conformance.result import Reference
from airl_mav.core.constants import MS_PER_S
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from published.blocks import Records, block
from published.text import NONE, table

STEP_M_S, MOVED_M_S = 2.0, 0.05
"""Step size, and reaction threshold (`scripts/response_taken_apart.py`)."""


@block("setpoint-response", "response-taken-apart")
def setpoint_response(records: Records) -> str:
    """Return the stages of the built-in vehicle, then PX4's and the fitted model's."""
    flown = records["response-taken-apart"].printed
    assert flown is not None
    rows = [[f"built-in: {stage}", *cells] for stage, *cells in flown.rows]
    steps = load_profile("conformance", "px4", Reference).steps
    north, up = steps["north-2"], steps["up-2"]
    rows.append([f"PX4: estimated velocity moved by {1e3 * MOVED_M_S:g} mm/s"])
    rows[-1] += [_ms(north.latency_s), _ms(up.latency_s)]
    rows.append(["PX4: half of the step, estimated", _ms(north.t50_s), _ms(up.t50_s)])
    for what, share in (
        (f"velocity moved by {1e3 * MOVED_M_S:g} mm/s", MOVED_M_S / STEP_M_S),
        ("half of the step", 0.5),
    ):
        rows.append([f"model `[response]`: {what}", _ms(_modelled_s(share)), NONE])
    return table(flown.columns, rows, 2)


def _modelled_s(share: float) -> float:
    """Return the time at which the quad's first-order model has covered a share of a step [s]."""
    model = load_vehicle("quad").response
    assert model is not None
    return model.dead_time_s - model.velocity_time_s * math.log(1.0 - share)


def _ms(seconds: float | None) -> str:
    return NONE if seconds is None else f"{MS_PER_S * seconds:.0f}"

"""First-order response of a vehicle to velocity setpoints, from its step responses.

After a dead time d a first-order lag with time constant T has completed the share p of a step at d
- T ln(1 - p). Dead times and time constants are least-squares fits to the times of 10 and 50 % of
the velocity, and of 10, 50 and 90 % of the yaw rate in the flown steps: a policy sends its next
setpoint before the velocity reaches 90 %.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, TypeAdapter

from airl_mav.addons.conformance.result import SCHEMA, Reference, StoredStep
from airl_mav.addons.conformance.telemetry import StepName
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.core.files import read_typed
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import Response, VehicleProfile

VELOCITY_STEPS: tuple[StepName, ...] = (
    "north-2",
    "north-2-stop",
    "north-5",
    "north-5-stop",
    "east-2",
    "forward-2",
)
"""Horizontal steps: policies command only these."""

YAW_RATE_STEP: StepName = "yawspeed-30"

DIGITS = 3
"""Decimals of the times [s] and of the drag, limited by telemetry."""


class _FlownStep(BaseModel):
    """Required fields of a flown step."""

    name: StepName
    median: dict[str, float | None]


class _Flown(BaseModel):
    """Required fields of a result of `airl conformance`."""

    steps: list[_FlownStep]


def load_steps(source: str) -> Mapping[StepName, StoredStep]:
    """Return the steps of a stored reference (name, .toml) or result (.json). Raises UsageError."""
    path = Path(source)
    if path.suffix != ".json":
        return load_profile("conformance", source, Reference).steps
    found = read_typed(path, TypeAdapter(_Flown), SCHEMA, "result of airl conformance")
    return {
        step.name: validated(
            StoredStep,
            {name: step.median.get(name) for name in ("t10_s", "t50_s", "rise_s")},
            f"{path}: {step.name}",
        )
        for step in found.steps
    }


def fit_response(steps: Mapping[StepName, StoredStep], vehicle: VehicleProfile) -> Response:
    """Return the response of a vehicle from its steps.

    Lean at constant velocity gives the linear drag.

    Raises:
        UsageError: No velocity step reached 50 %, or the yaw rate's not 90 %.
    """
    dead_s, lag_s = _lag(steps, VELOCITY_STEPS, (0.1, 0.5))
    turn_dead_s, turn_lag_s = _lag(steps, (YAW_RATE_STEP,), (0.1, 0.5, 0.9))
    return validated(
        Response,
        {
            "dead_time_s": round(dead_s, DIGITS),
            "velocity_time_s": round(lag_s, DIGITS),
            "yaw_rate_dead_time_s": round(turn_dead_s, DIGITS),
            "yaw_rate_time_s": round(turn_lag_s, DIGITS),
            "drag_1_s": round(vehicle.drag.linear_n_s_m / vehicle.body.mass_kg, DIGITS),
        },
        "steps",
    )


def _lag(
    steps: Mapping[StepName, StoredStep], names: Sequence[StepName], shares: Sequence[float]
) -> tuple[float, float]:
    """Return dead time and time constant [s] of the named steps, from the times of the shares."""
    lags: list[float] = []
    times_s: list[float] = []
    for name in names:
        step = steps.get(name, StoredStep())
        t10_s, t50_s, rise_s = (
            math.nan if time_s is None else time_s
            for time_s in (step.t10_s, step.t50_s, step.rise_s)
        )
        known_s = {0.1: t10_s, 0.5: t50_s, 0.9: t10_s + rise_s}
        if all(math.isfinite(known_s[share]) for share in shares):
            lags += [-math.log(1.0 - share) for share in shares]
            times_s += [known_s[share] for share in shares]
    if not lags:
        reached = f"up to {max(shares):.0%} of it"
        raise UsageError(f"steps: accepted: with {' or '.join(names)}, {reached}")
    dead_s, lag_s = np.linalg.lstsq(np.vander(lags, 2, increasing=True), times_s, rcond=None)[0]
    return float(dead_s), float(lag_s)

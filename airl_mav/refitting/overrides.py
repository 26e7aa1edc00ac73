"""What of a vehicle profile a flight says otherwise, each value with where it comes from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from airl_mav.core.fields import validated
from airl_mav.profiles.parameters import SPECS, parameter_values
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.refitting.air import Air
from airl_mav.refitting.quantity import FittedQuantity
from airl_mav.refitting.response import ResponseFit
from airl_mav.refitting.thrust import Thrust

DIGITS = 4
"""Significant digits of what is written: no interval is narrower."""

TUNED = ("MC_", "MPC_")
"""Parameters that decide how a vehicle flies begin so."""


@dataclass(frozen=True)
class Override:
    """A field of a profile."""

    table: str
    key: str
    value: float
    remark: str


def overrides_of(
    profile: VehicleProfile,
    flying: VehicleProfile,
    response: ResponseFit,
    thrust: Thrust,
    air: Air,
    logged: Mapping[str, float],
) -> tuple[Override, ...]:
    """Return the parameters in which a flight differs from its profile.

    Args:
        profile: The profile.
        flying: The profile with the computer that flew along.
        response: Fitted response.
        thrust: Fitted thrust.
        air: Fitted drag and wind.
        logged: Parameters of the flight controller from its log.
    """
    found: list[Override] = []
    carried_kg = flying.body.mass_kg - profile.body.mass_kg
    mass_kg = flying.body.mass_kg
    if thrust.mass_kg.value is not None:
        mass_kg = thrust.mass_kg.value
        remark = _remark(thrust.mass_kg)
        if carried_kg > 0.0:
            remark += f"; without the computer's {carried_kg:.3f} kg"
        found.append(Override("body", "mass_kg", _round(mass_kg - carried_kg), remark))
    if thrust.thrust_max_n.value is not None:
        value = thrust.thrust_max_n.value
        found.append(Override("rotor", "thrust_max_n", _round(value), _remark(thrust.thrust_max_n)))
    drag_1_s = profile.drag.linear_n_s_m / flying.body.mass_kg
    if air.drag_1_s.value is not None:
        drag_1_s = air.drag_1_s.value
        remark = f"{_remark(air.drag_1_s)}; times {mass_kg:.3f} kg"
        found.append(Override("drag", "linear_n_s_m", _round(drag_1_s * mass_kg), remark))
    table = response.response(drag_1_s, profile.response)
    if table is not None:
        fitted: dict[str, FittedQuantity] = {
            "dead_time_s": response.dead_time_s,
            "velocity_time_s": response.velocity_time_s,
            "yaw_rate_time_s": response.yaw_rate_time_s,
            "drag_1_s": air.drag_1_s,
        }
        for key, value in table.model_dump().items():
            found.append(Override("response", key, _round(value), _remark(fitted[key])))
    return (*found, *_parameters(profile, logged))


def refitted(profile: VehicleProfile, overrides: Sequence[Override]) -> VehicleProfile:
    """Return a profile with what a flight says otherwise. Raises FieldError if it cannot fly."""
    data: dict[str, Any] = profile.model_dump()
    for each in overrides:
        data[each.table] = {**(data[each.table] or {}), each.key: each.value}
    return validated(VehicleProfile, data)


def _parameters(profile: VehicleProfile, logged: Mapping[str, float]) -> list[Override]:
    """Return the flight controller's gains and limits that differ, except out-of-range values."""
    held = parameter_values(profile.parameters)
    remark = "as the flight controller's log has it"
    return [
        Override("parameters", spec.name, _round(logged[spec.name]), remark)
        for spec in SPECS
        if spec.is_used
        and spec.name.startswith(TUNED)
        and spec.low <= logged.get(spec.name, math.nan) <= spec.high
        and abs(logged[spec.name] - held[spec.name]) > 1e-6 * max(1.0, abs(held[spec.name]))
    ]


def _remark(estimate: FittedQuantity) -> str:
    if estimate.value is None:
        return f"not observable in this flight, as it was: {estimate.unobservable}"
    return (
        f"95 %: {_round(estimate.low):g} to {_round(estimate.high):g} {estimate.unit}, from"
        f" {estimate.source}"
    )


def _round(value: float | None) -> float:
    return float(f"{value or 0.0:.{DIGITS}g}")

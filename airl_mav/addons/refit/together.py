"""Joint fit of a vehicle's profile to several flights' logs.

Each flight is fitted alone, and a random-effects model joins the results. A flight's value differs
from the vehicle's by the flight's error and by a variance common to all flights (DerSimonian and
Laird, Meta-analysis in clinical trials, Controlled Clinical Trials 7, 1986).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from airl_mav.addons.refit.air import WIND, Air
from airl_mav.addons.refit.files import overrides_of, refitted, vehicle_toml, write_refit
from airl_mav.addons.refit.quantity import Array, FittedQuantity
from airl_mav.addons.refit.refit import LOG_SUFFIX, Refit, check_out, no_latencies, refit
from airl_mav.addons.refit.response import TIMES, ResponseFit
from airl_mav.addons.refit.thrust import Known, thrust_of
from airl_mav.core.errors import FieldError
from airl_mav.flight.statistics import QUANTILE
from airl_mav.profiles.vehicle import load_vehicle

OWN_WIND = "each flight has its own"


def refit_together(
    logs: Sequence[Path],
    *,
    vehicle: str | None = None,
    known: Known = "thrust",
    out: Path | None = None,
    seed: int = 1,
) -> Refit:
    """Fit the vehicle that flew several logged flights.

    Args:
        logs: Two or more logs (.ulg), the newest last; gains are taken from it.
        vehicle: Profile to refit: name or path; None = `quad`.
        known: Quantity to take from the profile: a flight shows only thrust per mass.
        out: New folder for `vehicle.toml`, `scenario.toml` and `refit.json`; None = no files.
        seed: Seed of the intervals' resamples.

    Raises:
        UsageError: A file cannot be read, or contains no flight. `FieldError`s name the field.
    """
    check_out(out)
    for path in logs:
        if path.suffix.lower() != LOG_SUFFIX:
            accepted = "vehicle's logs (.ulg) where there are several; a black box (.mcap) alone"
            raise FieldError("flights", f"{path}", accepted)
    if len(set(logs)) < len(logs):
        raise FieldError("flights", f"{logs[0]}...", "each log once")
    flights = tuple(refit(path, vehicle=vehicle, known=known, seed=seed) for path in logs)
    base = flights[0].base
    profile = load_vehicle(base)
    response = ResponseFit(
        *(pooled([getattr(each.response, name) for each in flights]) for name in TIMES)
    )
    thrust = thrust_of(pooled([each.thrust.ratio_m_s2 for each in flights]), profile, known)
    north, east = (each.without(OWN_WIND) for each in WIND)
    drag = pooled([each.air.drag_1_s for each in flights])
    air = Air(drag, north, east, flights[0].air.quadratic_1_m)
    parameters = flights[-1].parameters
    overrides = overrides_of(profile, profile, response, thrust, air, parameters)
    changed = sorted(
        each.key
        for each in overrides
        if each.table == "parameters"
        and len({flight.parameters.get(each.key) for flight in flights}) > 1
    )
    notes = [f"fitted to {len(logs)} flights together; a flight's wind is its own"]
    if changed:
        notes.append(f"of {logs[-1].name}, as other logs have others: {', '.join(changed)}")
    found = Refit(
        black_box=None,
        ulg=None,
        base=base,
        known=known,
        vehicle=refitted(profile, overrides),
        overrides=overrides,
        response=response,
        thrust=thrust,
        air=air,
        latencies=no_latencies(),
        notes=tuple(notes),
        parameters=parameters,
        flights=flights,
    )
    if out is not None:
        remarks = (f"airl refit {' '.join(path.name for path in logs)}", *notes)
        description = f"{base}, refitted to {len(logs)} flights"
        text = vehicle_toml(base, description, overrides, remarks)
        write_refit(out, found.as_json(), text, None, (), remarks)
    return found


def pooled(alone: Sequence[FittedQuantity]) -> FittedQuantity:
    """Return a vehicle's quantity, pooled from several flights."""
    told = [each for each in alone if each.value is not None and each.half_width]
    if not told:
        return replace(alone[0], unobservable=f"in none of {len(alone)}: {alone[0].unobservable}")
    values = np.array([each.value for each in told])
    sigma = np.array([each.half_width for each in told]) / QUANTILE
    value, error = random_effects(values, sigma)
    half = QUANTILE * error
    source = f"{len(told)} of {len(alone)} flights: {told[0].source}"
    return told[0].found((value, value - half, value + half), source)


def random_effects(values: Array, sigma: Array) -> tuple[float, float]:
    """Return mean and standard error of values (n,) with standard deviations (n,)."""
    weight = sigma**-2.0
    mean = float(np.sum(weight * values) / np.sum(weight))
    spread = float(np.sum(weight * (values - mean) ** 2)) - (len(values) - 1)
    scale = float(np.sum(weight) - np.sum(weight**2) / np.sum(weight))
    between = max(0.0, spread / scale) if len(values) > 1 else 0.0
    weight = 1.0 / (sigma**2 + between)
    total = float(np.sum(weight))
    return float(np.sum(weight * values) / total), math.sqrt(1.0 / total)

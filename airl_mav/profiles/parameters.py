"""PX4 parameters from `parameters.csv`: names, types, defaults, ranges and limits in flight.

The rehearsal's flight controller serves them over MAVLink; training reads its gains from them.
Source of names, types, units, ranges and defaults: PX4 1.16, its parameter reference; the defaults
were measured in PX4's SITL with airframe 10016. PX4 leaves the rotor positions (CA_ROTORn_PX, _PY)
to the airframe: here as in vehicles/quad.

PX4 also stores values out of range, as does this flight controller. The control code uses the
stored value clamped to safe bounds (`ParameterSpec.flown`).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from airl_mav.core.errors import UsageError

OFF = "0|"
"""Prefix of a lower flown bound: zero is also allowed and turns the function off."""


class ParameterSpec(NamedTuple):
    """One parameter: its type follows from the default (int = INT32, float = FLOAT)."""

    name: str
    default: int | float
    low: float
    """Range in PX4; -inf and inf = no limit."""
    high: float
    unit: str
    flown_low: float
    """Bounds of the value in flight. They may be wider or narrower than PX4's range."""
    flown_high: float
    zero_is_off: bool
    """True if zero is used although it is below `flown_low`."""
    meaning: str
    """Effect in this simulator; empty = stored and returned without effect."""

    def flown(self, value: float) -> float:
        """Return the value used in flight for a stored `value`."""
        if value == 0.0 and self.zero_is_off:
            return 0.0
        return min(self.flown_high, max(self.flown_low, float(value)))

    @property
    def is_used(self) -> bool:
        """True if the parameter has an effect in this simulator."""
        return bool(self.meaning)


def _spec(row: Mapping[str, str]) -> ParameterSpec:
    number = int if row["type"] == "INT32" else float
    low = float(row["min"] or -math.inf)
    high = float(row["max"] or math.inf)
    flown_min = row["flown_min"]
    return ParameterSpec(
        name=row["name"],
        default=number(row["default"]),
        low=low,
        high=high,
        unit=row["unit"],
        flown_low=float(flown_min.removeprefix(OFF) or low),
        flown_high=float(row["flown_max"] or high),
        zero_is_off=flown_min.startswith(OFF),
        meaning=row["meaning"],
    )


def _read(path: Path) -> tuple[ParameterSpec, ...]:
    with path.open(newline="", encoding="utf-8") as file:
        return tuple(map(_spec, csv.DictReader(file)))


SPECS = _read(Path(__file__).with_suffix(".csv"))
"""Parameters in ascending order of the names."""

SPEC_BY_NAME: Mapping[str, ParameterSpec] = {spec.name: spec for spec in SPECS}

_DEFAULTS = {spec.name: spec.default for spec in SPECS}
_FLOWN_DEFAULTS = {spec.name: spec.flown(spec.default) for spec in SPECS}


def parameter_values(overrides: Mapping[str, int | float]) -> dict[str, int | float]:
    """Return all parameters, with a vehicle profile's overrides. Raises UsageError."""
    values = dict(_DEFAULTS)
    for name, value in overrides.items():
        spec = SPEC_BY_NAME.get(name)
        if spec is None:
            raise UsageError(f"parameters.{name}: no such parameter")
        if not (math.isfinite(value) and spec.low <= value <= spec.high):
            raise UsageError(
                f"parameters.{name} = {value}: accepted: "
                f"{spec.low:g} <= value <= {spec.high:g} {spec.unit}".rstrip()
            )
        if isinstance(spec.default, int) and value != int(value):
            raise UsageError(f"parameters.{name} = {value}: accepted: a whole number")
        values[name] = type(spec.default)(value)
    return values


def flown_values(overrides: Mapping[str, int | float]) -> dict[str, float]:
    """Return the values in flight of `parameter_values`; raises as it does."""
    stored = parameter_values(overrides)
    flown = {name: SPEC_BY_NAME[name].flown(stored[name]) for name in overrides}
    return _FLOWN_DEFAULTS | flown

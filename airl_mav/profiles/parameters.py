"""PX4-named parameters of the flight controller, from `parameters.toml`: names, defaults, ranges.

The rehearsal's flight controller serves them over MAVLink; training reads its gains from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.errors import UsageError
from airl_mav.profiles.loading import read_toml


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter: its type follows from the default (int = INT32, float = REAL32)."""

    name: str
    default: int | float
    low: float
    high: float
    unit: str
    meaning: str


SPECS = tuple(
    ParameterSpec(name, *rest)
    for name, rest in read_toml(Path(__file__).with_suffix(".toml")).items()
)
"""In ascending order of the names."""


def parameter_values(overrides: Mapping[str, int | float]) -> dict[str, int | float]:
    """Return the values of all parameters: the defaults, and a vehicle profile's overrides.

    Raises UsageError for an override that is unknown or out of range.
    """
    values = {spec.name: spec.default for spec in SPECS}
    specs = {spec.name: spec for spec in SPECS}
    for name, value in overrides.items():
        spec = specs.get(name)
        if spec is None:
            raise UsageError(f"parameters.{name}: no such parameter")
        if not spec.low <= value <= spec.high:
            raise UsageError(
                f"parameters.{name} = {value}: accepted: "
                f"{spec.low:g} <= value <= {spec.high:g} {spec.unit}".rstrip()
            )
        if isinstance(spec.default, int) and value != int(value):
            raise UsageError(f"parameters.{name} = {value}: accepted: a whole number")
        values[name] = type(spec.default)(value)
    return values

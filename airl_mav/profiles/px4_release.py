"""PX4 releases that the built-in flight controller emulates, from `profiles/px4`.

Each folder is one release: `release.toml` has its version and its source, `parameters.csv` its
parameters, both written by `scripts/px4_release.py` from PX4. The current release lists all
parameters; another release lists only the rows that differ, and a name alone for a parameter that
it lacks. `effects.csv` has this simulator's own columns: limits in flight and the effect.

PX4 also stores values out of range, as does this flight controller. The control code uses the
stored value clamped to safe bounds (`ParameterSpec.flown`).
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from airl_mav.core.errors import UsageError
from airl_mav.profiles.loading import list_profiles, profiles_dir, read_toml

PX4ReleaseName = Literal["1.16", "1.17", "1.18"]

CURRENT: PX4ReleaseName = "1.17"
"""Current stable release. Flight code uses its parameter names."""

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
    current_name: str
    """Name in the current release, by which flight code reads the value."""
    absent: float
    """Value in flight of a release that lacks the parameter."""

    def flown(self, value: float) -> float:
        """Return the value used in flight for a stored `value`."""
        if value == 0.0 and self.zero_is_off:
            return 0.0
        return min(self.flown_high, max(self.flown_low, float(value)))

    @property
    def is_used(self) -> bool:
        """True if the parameter has an effect in this simulator."""
        return bool(self.meaning)


_NO_EFFECT = {"flown_min": "", "flown_max": "", "meaning": "", "absent": ""}


def _spec(row: Mapping[str, str], current_name: str) -> ParameterSpec:
    number = int if row["type"] == "INT32" else float
    low = float(row["min"] or -math.inf)
    high = float(row["max"] or math.inf)
    effect = _effects().get(current_name, _NO_EFFECT)
    flown_min = effect["flown_min"]
    default = number(row["default"])
    spec = ParameterSpec(
        name=row["name"],
        default=default,
        low=low,
        high=high,
        unit=row["unit"],
        flown_low=float(flown_min.removeprefix(OFF) or low),
        flown_high=float(effect["flown_max"] or high),
        zero_is_off=flown_min.startswith(OFF),
        meaning=effect["meaning"],
        current_name=current_name,
        absent=float(effect["absent"] or math.nan),
    )
    # A missing parameter is flown with another release's default, unless effects.csv has a value.
    return spec if effect["absent"] else spec._replace(absent=spec.flown(default))


class FailsafeRules(NamedTuple):
    """Differences of the failsafes between releases."""

    fallback_needs_pilot: bool
    """True if NAV_RCL_ACT replaces a fallback to a piloted mode without manual control."""
    exceptions_cover_auto_modes: bool
    """True if bit 1 of COM_RCL_EXCEPT and COM_DLL_EXCEPT covers all automatic modes."""
    gcs_loss_needs_arming: bool
    """True if the loss of the ground station counts in an armed vehicle only."""
    takeover_needs_action: bool
    """True if a mode selection takes over from any action, False from an unchanged one."""
    delays_from: int
    """Lowest action that waits in Hold: 0 none, 1 warning, 2 fallback."""
    orbit_ends_at_once: bool
    """True if the beginning of a failsafe turns Orbit into Hold, False its end."""
    warning_has_text: bool
    """True if a warning has a text, False an event alone."""


@dataclass(frozen=True)
class Px4Release:
    """PX4 release: version, source and parameters."""

    name: PX4ReleaseName
    version: str
    """Version that the flight controller reports, as 1.17.0."""
    source: str
    """Tag, commit and date of PX4's source that the data are from."""
    unknown_commands: frozenset[int]
    """Commands (MAV_CMD) of other releases that this release does not support."""
    unknown_mode: str
    """Answer to a mode that PX4 does not know, a MAV_RESULT."""
    mission_state: bool
    """True if MISSION_CURRENT has the mission's state, and a return at its end completes it."""
    failsafes: FailsafeRules
    unknown_events: frozenset[str]
    """Events of other releases that this release does not send."""
    events: Mapping[str, Mapping[str, str]]
    """Events and texts that differ from the current release, by the event's name there."""
    specs: tuple[ParameterSpec, ...]
    """Parameters in ascending order of the names."""

    @property
    def flight_sw_version(self) -> int:
        """Version as in AUTOPILOT_VERSION, a byte each: major, minor, patch, 255 (official)."""
        return int.from_bytes((*map(int, self.version.split(".")), 255), "big")

    @cached_property
    def spec_by_name(self) -> Mapping[str, ParameterSpec]:
        """Parameters by name."""
        return {spec.name: spec for spec in self.specs}

    @cached_property
    def _flown_defaults(self) -> Mapping[str, float]:
        others = [px4_release(name) for name in get_args(PX4ReleaseName) if name != self.name]
        absent = {spec.current_name: spec.absent for other in others for spec in other.specs}
        return absent | {spec.current_name: spec.flown(spec.default) for spec in self.specs}

    def parameter_values(self, overrides: Mapping[str, int | float]) -> dict[str, int | float]:
        """Return all parameters, with a vehicle profile's overrides. Raises UsageError."""
        values = {spec.name: spec.default for spec in self.specs}
        for name, value in overrides.items():
            spec = self.spec_by_name.get(name)
            if spec is None:
                raise UsageError(f"parameters.{name}: no such parameter in PX4 {self.name}")
            if not (math.isfinite(value) and spec.low <= value <= spec.high):
                raise UsageError(
                    f"parameters.{name} = {value}: accepted: "
                    f"{spec.low:g} <= value <= {spec.high:g} {spec.unit}".rstrip()
                )
            if isinstance(spec.default, int) and value != int(value):
                raise UsageError(f"parameters.{name} = {value}: accepted: a whole number")
            values[name] = type(spec.default)(value)
        return values

    def flown_values(self, overrides: Mapping[str, int | float]) -> dict[str, float]:
        """Return the values in flight by the names of the current release.

        Raises:
            UsageError: As `parameter_values`.
        """
        stored = self.parameter_values(overrides)
        specs = [self.spec_by_name[name] for name in overrides]
        flown = {spec.current_name: spec.flown(stored[spec.name]) for spec in specs}
        return {**self._flown_defaults, **flown}


@cache
def px4_release(name: PX4ReleaseName = CURRENT) -> Px4Release:
    """Return a release by name."""
    facts = read_toml(_folder(name) / "release.toml")
    current_names = {own: current for current, own in facts["renamed"].items()}
    rows = _rows(_folder(CURRENT) / "parameters.csv") | _rows(_folder(name) / "parameters.csv")
    specs = (_spec(r, current_names.get(n, n)) for n, r in sorted(rows.items()) if r["type"])
    unknown, absent = facts["unknown_commands"].values(), facts["unknown_events"]
    return Px4Release(
        *(name, facts["version"], facts["source"], frozenset(unknown), facts["unknown_mode"]),
        *(facts["mission_state"], FailsafeRules(**facts["failsafes"]), frozenset(absent)),
        *(facts["events"], tuple(specs)),
    )


def version_name(flight_sw_version: int) -> str:
    """Return AUTOPILOT_VERSION.flight_sw_version as 1.16.0 alpha; its last byte is the stage."""
    major, minor, patch, stage = flight_sw_version.to_bytes(4, "big")
    stages = ((255, ""), (192, " rc"), (128, " beta"), (64, " alpha"), (0, " dev"))
    return f"{major}.{minor}.{patch}" + next(name for least, name in stages if stage >= least)


def stored_release(firmware: str, flight_sw_version: int) -> tuple[str, str]:
    """Return the column of a release of PX4 or ArduPilot, or the nearest one, and a title."""
    title = f"{firmware} {version_name(flight_sw_version)}"
    distances = {}
    for name in list_profiles("conformance"):
        if found := re.fullmatch(rf"{firmware.lower()}-(\d+)\.(\d+)", name):
            release = int(found[1]) << 8 | int(found[2])
            distances[name] = abs(release - (flight_sw_version >> 16))
    nearest = min(distances, key=distances.__getitem__, default="")
    if not distances.get(nearest):
        return nearest, title
    return nearest, f"{title}: no column; compared with {nearest.rpartition('-')[2]}"


def _folder(name: str) -> Path:
    return profiles_dir() / "px4" / name


@cache
def _effects() -> Mapping[str, Mapping[str, str]]:
    return _rows(profiles_dir() / "px4" / "effects.csv")


def _rows(path: Path) -> dict[str, dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return {row["name"]: row for row in csv.DictReader(file)}

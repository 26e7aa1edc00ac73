"""Published result: its figures, and their provenance."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from airl_mav.core.fields import ProfileModel, quantity, validated
from airl_mav.core.files import read_json, write_json
from airl_mav.flight.statistics import Estimate
from airl_mav.policy.registry import POLICIES, find_policy, policy_names
from airl_mav.training.config import check_seeds
from published.behaviour import read_behaviour
from published.changes import read_changes, stands

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"
BEHAVIOUR_FILE = RESULTS / "behaviour.json"
"""Samples of today's code; `results.py fingerprint` compares against them."""

CHANGES_FILE = RESULTS / "changes.toml"
"""Effects of the changes from earlier behaviour fingerprintes to today's."""

SCHEMA = 1

MEASURES = ("success_rate", "flight_time_s", "distance_m", "energy_j")


class Figure(ProfileModel):
    """Figure with its 95 % interval."""

    value: float | None = Field(description="None: nothing to work it out from")
    low: float | None = None
    high: float | None = None
    n: int = quantity("flights or pairs behind it", "1", ge=0)

    @classmethod
    def of(cls, estimate: Estimate) -> Figure:
        """Return an estimate, in numbers of readable length."""
        value, low, high = (
            None if each is None else float(f"{each:.7g}")
            for each in (estimate.value, estimate.low, estimate.high)
        )
        return cls(value=value, low=low, high=high, n=estimate.n)


class FlownRun(ProfileModel):
    """Flights of a policy under one set of conditions."""

    policy: str
    arena: str
    level: str
    latency: str | None = Field(description="source of t2, as a card names it; None: native")
    seed: int = Field(description="of the first episode; each has the next")
    t2_ms: float | None = Field(description="mean latency of a decision [ms]")
    success_rate: Figure = Field(description="fraction, with Wilson's interval")
    flight_time_s: Figure = Field(description="this and the following: flights with success")
    distance_m: Figure
    energy_j: Figure = Field(description="of the vehicle, without its computer")

    @model_validator(mode="after")
    def _seeds_are_not_held_out(self) -> FlownRun:
        check_seeds(self.seed, self.success_rate.n)
        return self


class Gap(ProfileModel):
    """Comparison of a run with a reference, over pairs of flights of the same seed."""

    target: str = Field(description="name of the run")
    reference: str
    success_rate: Figure = Field(description="percentage points, Tango's interval")
    flight_time_s: Figure = Field(description="percent, median over the common successes")
    distance_m: Figure = Field(description="this and the following: as the record's averages")
    energy_j: Figure
    t2_percent: float | None = Field(description="of the mean t2 of all decisions, not paired")


class Printed(ProfileModel):
    """Table as printed: its data are not stored, or are no run of a policy."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @model_validator(mode="after")
    def _is_a_table(self) -> Printed:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError(f"rows: accepted: {len(self.columns)} cells each")
        return self


class Made(ProfileModel):
    """Provenance of figures."""

    command: str = Field(description="as a person types it")
    date: str = Field(pattern=r"^\d{4}-\d{2}-\d{2}$", description="when it was flown, UTC")
    version: str = Field(description="of airl-mav")
    commit: str | None = Field(description="of the checkout; None: not written down")
    changed: bool | None = Field(description="True if the checkout had local changes")
    cpu: str
    versions: dict[str, str] = Field(description="packages by name")
    behaviour: str | None = Field(
        description="fingerprint of the flight behaviour; None: flown before there was one"
    )
    policies: dict[str, str] = Field(
        default_factory=dict, description="SHA-256 of each shipped policy's file"
    )


class Record(ProfileModel):
    """Complete record of a result."""

    name: str
    what: str = Field(description="one line for people")
    made: Made
    averages: Literal["medians", "means"] = Field(
        default="medians",
        description="kind of times, distances and energies; means of older results have no"
        " interval, and their paired flight times are medians",
    )
    runs: dict[str, FlownRun] = Field(default_factory=dict)
    gaps: dict[str, Gap] = Field(default_factory=dict)
    printed: Printed | None = None


def file_of(name: str, folder: Path = RESULTS) -> Path:
    """Return the file of a result."""
    return folder / f"{name}.json"


def read_record(name: str, folder: Path = RESULTS) -> Record:
    """Read a result. Raises UsageError if missing or damaged."""
    path = file_of(name, folder)
    data = read_json(path, SCHEMA, "result")
    del data["schema"]
    return validated(Record, data, path)


def write_record(record: Record, folder: Path = RESULTS) -> Path:
    """Write a result atomically; return its path."""
    path = file_of(record.name, folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, {"schema": SCHEMA, **record.model_dump(mode="json")})
    return path


def all_records(folder: Path = RESULTS) -> dict[str, Record]:
    """Read all results, by name. Raises UsageError."""
    names = sorted(path.stem for path in folder.glob("*.json") if path != BEHAVIOUR_FILE)
    return {name: read_record(name, folder) for name in names}


@cache
def behaviour_today() -> str:
    """Return the behaviour fingerprint of today's code. Raises UsageError."""
    return read_behaviour(BEHAVIOUR_FILE).digest


@cache
def shipped_policies() -> Mapping[str, str]:
    """Return the SHA-256 of every built-in policy's file, by name."""
    known = {name: find_policy(name).sha256 for name in policy_names() if name not in POLICIES}
    return {name: sha256 for name, sha256 in known.items() if sha256 is not None}


def out_of_date(record: Record) -> str:
    """Return a sentence on why figures are outdated; empty: up to date."""
    made, runs = record.made, [(run.level, run.arena) for run in record.runs.values()]
    flown = f"Flown on {made.date} with version {made.version}"
    changes = read_changes(CHANGES_FILE)
    if not stands(made.behaviour, behaviour_today(), changes, record.name, runs):
        return f"{flown}. Flights have changed since."
    shipped = shipped_policies()
    others = [name for name, sha256 in made.policies.items() if shipped.get(name) != sha256]
    if others:
        return f"{flown}, with another file of {', '.join(f'`{name}`' for name in others)}."
    return ""

"""Rehearsals of a recorded flight with its fitted parameters, all together and part by part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, TypeAdapter

from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_typed, write_json
from airl_mav.experiments.refly import Changes, Reflight, refly
from airl_mav.profiles.conditions import WindSettings
from airl_mav.refitting.files import REFIT_FILE, VEHICLE_FILE
from airl_mav.refitting.refit import SCHEMA

PARTS_FOLDER, PARTS_FILE = "parts", "parts.json"
"""Folder of the rehearsals with one part each, and file of their results."""

NOTHING, LATENCY, VEHICLE, WIND, ALL = "nothing", "latency", "vehicle", "wind", "all"
"""Parts of a refit in a rehearsal; `nothing`: profile, calm air, no injected latency."""

PARTS_SCHEMA = 1


@dataclass(frozen=True)
class _Wind:
    """Wind in `refit.json`."""

    north_m_s: Annotated[float, Field(ge=-50, le=50)]
    east_m_s: Annotated[float, Field(ge=-50, le=50)]


@dataclass(frozen=True)
class _Refit:
    """Fields of `refit.json` that rehearsals need."""

    vehicle: str
    wind: _Wind | None


@dataclass(frozen=True)
class PartFlown:
    """Rehearsals with a part of a refit, compared with the flight."""

    part: str
    rehearsals: int
    reached: int
    time_s: float | None
    """Median time of the successful rehearsals [s]; None = no success."""
    time_share: float | None
    """Difference from the flight's time, as a share of the flight's time; None = no success."""
    apart_m: float
    """Median distance of the flown path from a rehearsed path [m], median of the rehearsals."""


def changes_of(folder: Path) -> Changes:
    """Return the changes by a refit. Raises UsageError if the folder does not contain a refit."""
    told = _read(folder)
    wind = None if told.wind is None else WindSettings(**vars(told.wind))
    return Changes(vehicle=str(folder / VEHICLE_FILE), wind=wind)


def refly_parts(
    path: Path,
    out: Path,
    folder: Path,
    *,
    arena: str | None = None,
    arena_seed: int | None = None,
    episodes: int = 20,
    policy: str | None = None,
    trust: bool = False,
    progress: bool = False,
) -> tuple[Reflight, tuple[PartFlown, ...]]:
    """Rehearse a recorded flight with a whole refit, each part of it, and none, on equal seeds.

    The change made by one part alone is the contribution of that part. Contributions need not add
    up. `out` gets `parts` beside the folders of `refly`; see there for the other arguments.
    """
    everything, base = changes_of(folder), _read(folder).vehicle
    nothing = Changes(vehicle=base, prompt=True)
    parts = {
        NOTHING: nothing,
        LATENCY: replace(nothing, prompt=False),
        VEHICLE: replace(nothing, vehicle=everything.vehicle),
        WIND: replace(nothing, wind=everything.wind),
    }

    def flown(into: Path, changes: Changes) -> Reflight:
        return refly(
            path,
            into,
            arena=arena,
            arena_seed=arena_seed,
            episodes=episodes,
            policy=policy,
            trust=trust,
            changes=changes,
            progress=progress,
        )

    whole = flown(out, everything)
    found = [
        _figures(part, flown(out / PARTS_FOLDER / part, changes)) for part, changes in parts.items()
    ]
    figures = (*found, _figures(ALL, whole))
    data = {
        "schema": PARTS_SCHEMA,
        "flown_s": whole.flown_s,
        "parts": [vars(each) for each in figures],
    }
    write_json(out / PARTS_FILE, data)
    return whole, figures


def _read(folder: Path) -> _Refit:
    told = read_typed(folder / REFIT_FILE, TypeAdapter(_Refit), SCHEMA, "refit of a flight")
    if not (folder / VEHICLE_FILE).is_file():
        raise UsageError(f"{folder}: accepted: the folder of a refit, with {VEHICLE_FILE}")
    return told


def _figures(part: str, flown: Reflight) -> PartFlown:
    time_s = flown.rehearsed_time_s
    return PartFlown(
        part=part,
        rehearsals=flown.rehearsals,
        reached=len(flown.rehearsed_s),
        time_s=time_s,
        time_share=None if time_s is None else (time_s - flown.flown_s) / flown.flown_s,
        apart_m=float(np.median(flown.each_apart_m)),
    )

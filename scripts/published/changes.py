"""Accepted changes of the flight behaviour, and the results that they do not affect.

A change that only affects flights among moving obstacles in lockstep does not invalidate a table of
flights among static ones. `results/changes.toml` lists the levels and arenas affected by each
change; `results.py fingerprint` shows the differing flights.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from pydantic import Field

from airl_mav.core.fields import ProfileModel, validated
from airl_mav.profiles.loading import read_toml

DIGEST = r"^[0-9a-f]{16}$"


class Change(ProfileModel):
    """Change from one behaviour fingerprint to the next, with its effects."""

    before: str = Field(pattern=DIGEST, description="fingerprint of the code before")
    after: str = Field(pattern=DIGEST, description="fingerprint of the code with the change")
    why: str = Field(min_length=1, description="description of the change")
    flights: tuple[str, ...] = Field(min_length=1, description="of the fingerprint, that differ")
    levels: tuple[str, ...] = Field(min_length=1, description="levels that fly otherwise")
    arenas: tuple[str, ...] = Field(min_length=1, description="arenas that are flown otherwise")
    untouched: tuple[str, ...] = Field(
        default=(),
        description="results that are tables as printed, of other levels or arenas alone",
    )

    def touches(self, name: str, flown: Iterable[tuple[str, str]]) -> bool:
        """Return True if a result may change.

        Args:
            name: Name of the result.
            flown: Level and arena of each of its runs; empty: only its table is stored.
        """
        runs = list(flown)
        if not runs:
            return name not in self.untouched
        return any(level in self.levels and arena in self.arenas for level, arena in runs)


class _Changes(ProfileModel):
    change: tuple[Change, ...] = ()


@cache
def read_changes(path: Path) -> Mapping[str, Change]:
    """Return the accepted changes by the previous fingerprint. Raises UsageError if damaged."""
    return {each.before: each for each in validated(_Changes, read_toml(path), path).change}


def stands(
    behaviour: str | None,
    today: str,
    changes: Mapping[str, Change],
    name: str,
    flown: Iterable[tuple[str, str]],
) -> bool:
    """Return True if a result would be equal with today's code.

    Args:
        behaviour: Behaviour fingerprint of the result's flights; None: missing.
        today: Behaviour fingerprint of today's code.
        changes: All accepted changes, by the previous fingerprint.
        name: Name of the result.
        flown: Level and arena of each of its runs.
    """
    runs, seen = list(flown), set()
    while behaviour != today:
        change = None if behaviour is None else changes.get(behaviour)
        if change is None or change.before in seen or change.touches(name, runs):
            return False
        seen.add(change.before)
        behaviour = change.after
    return True

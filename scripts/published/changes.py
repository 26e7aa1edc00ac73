"""Accepted changes of the flight behaviour, and which results they leave as they were.

A change that moves only flights among moving obstacles in lockstep says nothing against a table of
flights among standing ones. `results/changes.toml` says of each change which levels and arenas it
touches; `results.py fingerprint` shows the flights by which that was found.
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
    """From one fingerprint to the next, where what changed is known."""

    before: str = Field(pattern=DIGEST, description="fingerprint of the code before")
    after: str = Field(pattern=DIGEST, description="fingerprint of the code with the change")
    why: str = Field(min_length=1, description="what was changed")
    flights: tuple[str, ...] = Field(min_length=1, description="of the fingerprint, that differ")
    levels: tuple[str, ...] = Field(min_length=1, description="levels that fly otherwise")
    arenas: tuple[str, ...] = Field(min_length=1, description="arenas that are flown otherwise")
    untouched: tuple[str, ...] = Field(
        default=(),
        description="results that are tables as printed, of other levels or arenas alone",
    )

    def touches(self, name: str, flown: Iterable[tuple[str, str]]) -> bool:
        """Return whether a result may come out otherwise.

        Args:
            name: Of the result.
            flown: Level and arena of each of its runs; none: only its table is kept.
        """
        runs = list(flown)
        if not runs:
            return name not in self.untouched
        return any(level in self.levels and arena in self.arenas for level, arena in runs)


class _Changes(ProfileModel):
    change: tuple[Change, ...] = ()


@cache
def read_changes(path: Path) -> Mapping[str, Change]:
    """Return the accepted changes by the fingerprint before. Raises UsageError: damaged."""
    return {each.before: each for each in validated(_Changes, read_toml(path), path).change}


def stands(
    behaviour: str | None,
    today: str,
    changes: Mapping[str, Change],
    name: str,
    flown: Iterable[tuple[str, str]],
) -> bool:
    """Return whether a result would come out alike with today's code.

    Args:
        behaviour: Fingerprint that it was flown with; None: there was none.
        today: That of today's code.
        changes: All that were accepted, by the fingerprint before.
        name: Of the result.
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

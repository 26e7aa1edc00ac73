"""What was flown on what, and the record of one episode: one JSON line of `episodes.jsonl`."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core.constants import US_PER_S, Level
from airl_mav.core.files import typed
from airl_mav.core.goals import Goal
from airl_mav.core.process_use import ProcessUse
from airl_mav.flight.judge import Outcome
from airl_mav.flight.quality import Quality
from airl_mav.latency.injection import Injection

BUILT_IN = "built-in"
"""The firmware of all levels but one."""


@dataclass(frozen=True)
class Part:
    """One part of a rehearsal: the vehicle, the arena, the policy, the computer."""

    name: str
    description: str = ""


@dataclass(frozen=True)
class Setup:
    """The parts of a rehearsal, in words."""

    level: Level
    """Rung of the fidelity ladder."""
    vehicle: Part
    arena: Part
    policy: Part
    computer: Part
    computer_watts: float
    """What the computer draws from the aircraft's pack [W]; 0 of one that stays on the ground."""
    injection: Injection
    """The decision latency t2: measured, injected or estimated."""
    speed: float | None
    """Simulated seconds per wall second; None where time is not paced (lockstep)."""
    between_commands: str
    """What the vehicle does between commands: `persist`, `hover-after 60 ms`."""
    firmware: str = BUILT_IN
    """What flew: the built-in autopilot, or the name of real firmware."""
    computer_on_ground: bool = False
    """The computer is ground equipment: the aircraft carries and feeds none."""
    conditions: str = ""
    """Wind, load, spread, noise, charge and renderer, where not the defaults: `wind.east_m_s 4`."""


SCHEMA = 1
"""Version of the line's schema; docs/run-folder.md describes it."""

NO_ARENA = ""
"""The arena of a flight outside of all arenas."""


@dataclass(frozen=True)
class FaultActed:
    """A fault that has acted in a flight."""

    fault: str
    """In words (docs/how-to/faults.md)."""
    from_us: int
    """Simulated time at which it began [µs]."""
    to_us: int
    """Simulated time at which it ended, or the record does [µs]."""


@dataclass(frozen=True)
class EpisodeRecord:
    """What is kept of an episode beside its raw arrays."""

    index: int
    """Number of the episode in its run, from 0; names its arrays and its tlog."""
    seed: int
    """Seed of the episode: sensors, wind, latencies."""
    arena: str
    """`NO_ARENA`: what stood where it flew is not known."""
    arena_seed: int
    outcome: Outcome
    reason: str
    goal: Goal
    """North, east [m]."""
    goal_radius_m: float
    time_limit_s: float
    started_us: int
    """Simulated time of the reset [µs]: moving obstacles count from here, see `tours_s`."""
    navigation_us: int | None
    """Simulated time at which the policy took over [µs]; None when it never did."""
    ended_us: int
    """Simulated time of the verdict [µs]."""
    wall_s: float | None
    """Wall time from reset to verdict [s]; None where time is not paced (lockstep)."""
    slipped_us: int
    """Simulated time given up because the host could not keep pace [µs]."""
    battery_remaining: float | None
    """Charge left at the end, 1 to 0."""
    quality: Quality | None
    """None when navigation never began."""
    notes: tuple[str, ...] = ()
    """What else happened: failsafes, watchdog trips."""
    invalid: tuple[str, ...] = ()
    """Why the flight is no test of the policy (`flight.validity`): the host disturbed it in every
    attempt. Empty: it is one."""
    companion_use: ProcessUse | None = None
    """What the companion process took of its machine for the flight, from arming to the ground;
    None where it is no process of its own (gym, lockstep), and in older records."""
    faults: tuple[FaultActed, ...] = ()
    """What failed, as asked for or as a client injected it, in the order of its beginning."""
    zone: int | None = None
    """Curriculum zone that the goal was drawn in; None: the whole arena."""
    tours_s: float = 0.0
    """When, after the reset, moving obstacles are where the seed's tours begin [s]; 0 in older
    records, whose obstacles began them at the reset."""
    sha256: dict[str, str] | None = None
    """Fingerprints by lane, and of the whole `flight`; None where flights are never the same."""
    schema: int = SCHEMA

    @property
    def zero_us(self) -> int:
        """Start of navigation, or of the episode where navigation never began [µs]."""
        return self.started_us if self.navigation_us is None else self.navigation_us

    def navigates(self, time_us: int) -> bool:
        """Return whether the vehicle navigates at a time [µs]."""
        return self.navigation_us is not None and (self.navigation_us <= time_us < self.ended_us)

    def fault_spans_s(self) -> list[tuple[float, float]]:
        """Return from when to when each fault acted [s], as time counts from `zero_us`."""
        return [
            ((each.from_us - self.zero_us) / US_PER_S, (each.to_us - self.zero_us) / US_PER_S)
            for each in self.faults
        ]

    def as_data(self) -> dict[str, Any]:
        """Return the object of a line."""
        return asdict(self)

    @classmethod
    def from_data(cls, data: Mapping[str, Any], source: object) -> EpisodeRecord:
        """Return the record that an object holds. Raises UsageError, with the source, for none."""
        return typed(_ADAPTER, data, source)


def run_sha256(episodes: Sequence[EpisodeRecord]) -> str | None:
    """Return the fingerprint of a run: equal when all its flights are equal, bit by bit.

    It is the SHA-256, hexadecimal, of the flights' own fingerprints in the order of their index,
    each a line with its newline; None when there is none of a flight.
    """
    lines = []
    for record in sorted(episodes, key=lambda record: record.index):
        if record.sha256 is None:
            return None
        lines.append(f"{record.sha256['flight']}\n")
    return hashlib.sha256("".join(lines).encode()).hexdigest() if lines else None


_ADAPTER = TypeAdapter(EpisodeRecord)

"""Setup of a flight, the record of one episode (a line of `episodes.jsonl`), and its ranking."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from airl_mav.core.constants import US_PER_S, Level
from airl_mav.core.files import typed
from airl_mav.core.frames import Goal
from airl_mav.core.resource_use import ProcessUse
from airl_mav.flight import judge, trajectory
from airl_mav.latency.injection import Injection

BUILT_IN = "built-in"
"""Firmware of all levels but one."""


@dataclass(frozen=True)
class Part:
    """Part of a rehearsal: vehicle, arena, policy or computer."""

    name: str
    description: str = ""


@dataclass(frozen=True)
class Setup:
    """Parts of a rehearsal, as text."""

    level: Level
    """Fidelity level."""
    vehicle: Part
    arena: Part
    policy: Part
    computer: Part
    computer_watts: float
    """Power that the computer draws from the aircraft's pack [W]; 0 for a computer on the
    ground."""
    injection: Injection
    """Decision latency t2: measured, injected or estimated."""
    speed: float | None
    """Simulated seconds per wall second; None without pacing (lockstep)."""
    between_commands: str
    """Behaviour between commands: `persist`, `hover-after 60 ms`."""
    firmware: str = BUILT_IN
    """Built-in autopilot, or the name of real firmware."""
    computer_on_ground: bool = False
    """True if the computer is ground equipment: the aircraft carries and powers none."""
    conditions: str = ""
    """Non-default wind, load, spread, noise and charge: `wind.east_m_s 4`."""


SCHEMA = 1
"""Version of the line's schema; docs/reference/run-folder.md describes it."""

NO_ARENA = ""
"""Arena name of a flight outside of all arenas."""


@dataclass(frozen=True)
class FaultActed:
    """Fault that acted in a flight."""

    fault: str
    """Fault specification as text (docs/how-to/faults.md)."""
    from_us: int
    """Simulated start time [µs]."""
    to_us: int
    """Simulated end time [µs], or the record's end."""


@dataclass(frozen=True)
class EpisodeRecord:
    """Record of an episode, without its raw arrays."""

    index: int
    """Index of the episode in its run, from 0; names its arrays and its tlog."""
    seed: int
    """Seed of the episode: sensors, wind, latencies."""
    arena: str
    """Arena name; `NO_ARENA`: unknown."""
    arena_seed: int
    outcome: judge.Outcome
    reason: str
    goal: Goal
    """North, east [m]."""
    goal_radius_m: float
    time_limit_s: float
    started_us: int
    """Simulated time of the reset [µs]: moving obstacles count from here, see `tours_s`."""
    navigation_us: int | None
    """Simulated time at which the policy took over [µs]; None without navigation."""
    ended_us: int
    """Simulated time of the verdict [µs]."""
    wall_s: float | None
    """Wall time from reset to verdict [s]; None without pacing (lockstep)."""
    slipped_us: int
    """Simulated time skipped because the host could not keep up [µs]."""
    battery_remaining: float | None
    """Remaining charge at the end, 1 to 0."""
    quality: trajectory.Quality | None
    """Flight quality; None without navigation."""
    notes: tuple[str, ...] = ()
    """Other events: failsafes, watchdog trips."""
    invalid: tuple[str, ...] = ()
    """Reasons why the flight is no test of the policy (`flight.judge`): the host or another sender
    disturbed every attempt. Empty: valid."""
    effects: tuple[judge.Effect, ...] = ()
    """Messages that took effect on the built-in flight controller, by sender."""
    companion_use: ProcessUse | None = None
    """Resources used by the companion process, from arming to the ground; None without a
    separate process (gym, lockstep), and in older records."""
    faults: tuple[FaultActed, ...] = ()
    """Requested or injected faults, in order of their start."""
    zone: int | None = None
    """Curriculum zone of the goal; None: the whole arena."""
    tours_s: float = 0.0
    """Time after the reset at which moving obstacles start their tours [s]; 0 in older records,
    whose obstacles started at the reset."""
    sha256: dict[str, str] | None = None
    """Hashes by lane, and of the whole `flight`; None if flights are not reproducible."""
    firmware: str = ""
    """Name and version of real firmware; empty for the built-in autopilot."""
    code: str | None = None
    """Identity of the code that flew it (`core.machine.code_of`); None for recorded flights."""
    schema: int = SCHEMA

    @property
    def zero_us(self) -> int:
        """Start of navigation, or of the episode without navigation [µs]."""
        return self.started_us if self.navigation_us is None else self.navigation_us

    def navigates(self, time_us: int) -> bool:
        """Return True if the vehicle navigates at a time [µs]."""
        return self.navigation_us is not None and (self.navigation_us <= time_us < self.ended_us)

    def fault_spans_s(self) -> list[tuple[float, float]]:
        """Return start and end of each fault [s], relative to `zero_us`."""
        return [
            ((each.from_us - self.zero_us) / US_PER_S, (each.to_us - self.zero_us) / US_PER_S)
            for each in self.faults
        ]

    def as_data(self) -> dict[str, Any]:
        """Return the object of a line."""
        return asdict(self)

    @classmethod
    def from_data(cls, data: Mapping[str, Any], source: object) -> EpisodeRecord:
        """Return the record of a parsed line. Raises UsageError, with the source, if invalid."""
        return typed(_ADAPTER, data, source)


def run_sha256(episodes: Sequence[EpisodeRecord]) -> str | None:
    """Return the hash of a run: equal for runs whose flights are all bit-identical.

    SHA-256, hexadecimal, of the flights' hashes in the order of their index, each a line with its
    newline; None if a flight has no hash.
    """
    lines = []
    for record in sorted(episodes, key=lambda record: record.index):
        if record.sha256 is None:
            return None
        lines.append(f"{record.sha256['flight']}\n")
    return hashlib.sha256("".join(lines).encode()).hexdigest() if lines else None


_ADAPTER = TypeAdapter(EpisodeRecord)


@dataclass(frozen=True)
class UsualFlight:
    """Medians of a run over the flights that reached the goal."""

    pace_s_m: float | None
    """Flight time per metre of the straight line to the goal's edge."""
    path_ratio: float | None
    """Ratio of the flown distance to the straight line."""
    speed_m_s: float | None
    """Mean speed of a flight."""


def straight_m(record: EpisodeRecord) -> float:
    """Return the horizontal straight distance from the start to the goal's edge [m]."""
    return max(0.1, math.hypot(*record.goal[:2]) - record.goal_radius_m)


def usual_flight(records: Sequence[EpisodeRecord]) -> UsualFlight:
    """Return the medians of a run; all None if no flight reached the goal."""
    good = [(r, r.quality) for r in records if r.outcome is judge.Outcome.SUCCESS and r.quality]
    if not good:
        return UsualFlight(None, None, None)
    return UsualFlight(
        float(np.median([q.flight_time_s / straight_m(r) for r, q in good])),
        float(np.median([q.distance_m / straight_m(r) for r, q in good])),
        float(np.median([q.mean_speed_m_s for _, q in good])),
    )


def time_lost_s(record: EpisodeRecord, usual: UsualFlight) -> float | None:
    """Return the time lost relative to the run's median pace [s]."""
    if record.quality is None or usual.pace_s_m is None:
        return None
    return record.quality.flight_time_s - usual.pace_s_m * straight_m(record)


def path_excess(record: EpisodeRecord) -> float | None:
    """Return the excess of the flown distance over the straight line, as a fraction."""
    if record.quality is None:
        return None
    return record.quality.distance_m / straight_m(record) - 1.0


def ranked(episodes: Sequence[EpisodeRecord]) -> list[EpisodeRecord]:
    """Return all flights, worst first: failures, then successes, each by time lost."""
    usual = usual_flight(episodes)

    def key(e: EpisodeRecord) -> tuple[bool, float, int]:
        lost_s = time_lost_s(e, usual)
        if lost_s is None:
            lost_s = 0.0 if e.quality is None else e.quality.flight_time_s
        return (e.outcome is judge.Outcome.SUCCESS, -lost_s, e.index)

    return sorted(episodes, key=key)

"""Behaviour fingerprint: detects changes of the flight behaviour between versions.

A small fixed set of flights, at level gym and in lockstep, with their positions at stated times. A
change of the sources, of a package or of a built-in policy appears as a difference from stored
samples. Published results contain the digest of the samples: the *behaviour* of their flights.

Processors differ in the last bits of their results. Samples are therefore compared within
`TOLERANCES`, not bit by bit: flights that agree within them have the behaviour of the stored
samples. The flights are short and their policies choose among discrete actions or are classical,
which keeps differences of last bits far below a millimetre; a network with continuous actions is
compared for three seconds only.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import ProfileModel, validated
from airl_mav.core.files import read_json, write_json
from airl_mav.experiments.gym_flier import GymFlier
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.scenario.model import LevelName, Scenario
from airl_mav.scenario.resolve import PlannedEpisode, resolve

SCHEMA = 1
"""Version of the samples file."""

ARENAS = ("no-obstacles", "static-obstacles", "dynamic-obstacles", "dense-obstacles", "crowded")
LOCKSTEP_ARENAS = ("static-obstacles", "dynamic-obstacles")
DISCRETE = "static-obstacles"
"""Network that chooses among discrete actions."""

POLICIES = ("greedy", DISCRETE)
"""Classical policy, and a network."""

LATENCIES: Mapping[str, str | None] = {"native": None, "late": "lognormal:396ms,20ms"}
"""A workstation's latency, and the paper's Raspberry Pi's, drawn for each decision."""

LOCKSTEP_LIMIT_S, GYM_LIMIT_S, CONTINUOUS_LIMIT_S = 8.0, 20.0, 3.0
"""Maximum flight times; a shorter flight is sampled to its end."""

GYM_SEEDS, LOCKSTEP_SEEDS = (1, 2, 3), (2,)

CONDITIONS: dict[str, Any] = {
    "policy": "static-obstacles-ras-pi-4",
    "computer": "ras-pi-4",
    "workload": "template-5x32",
    "payload": {"mass_g": 150.0, "forward_m": 0.02},
    "wind": {"east_m_s": 3.0, "gust_m_s": 1.0},
    "spread": {"mass": 0.1, "thrust": 0.05, "drag": 0.1},
    "sensors": {"navigation_noise": 1.5, "depth_noise": 0.02},
}
"""All conditions of aircraft and air together."""

_FLIGHT: dict[str, Any] = {"episodes": 1}

SAMPLE_EVERY_US = 1_000_000
"""Sampling interval, from the start of navigation [µs]."""

DECIMALS = 3
"""Decimals of stored samples: a millimetre and a millisecond."""

TOLERANCES = {"position_m": 0.01, "time_s": 0.021, "energy_share": 0.001}
"""Tolerances of equal behaviour: a centimetre at every stated time, one trajectory sample (20 ms)
in flight time, a thousandth of the energy."""


class FlightSample(ProfileModel):
    """Stored samples of one flight."""

    outcome: str = Field(description="how it ended, in the referee's word")
    time_s: float = Field(description="from the start of navigation to its end [s]")
    energy_j: float = Field(description="drawn from the pack on that way, with the computer's [J]")
    positions: tuple[tuple[float, float, float], ...] = Field(
        description="NED [m] at the stated times, the first at the start of navigation"
    )


class Behaviour(ProfileModel):
    """Flight behaviour of a version."""

    flights: dict[str, FlightSample] = Field(description="by level, arena, policy and latency")

    @property
    def digest(self) -> str:
        """Fingerprint: the first 16 hexadecimal digits of their SHA-256."""
        plain = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(plain.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Difference:
    """Flight that differs from the stored one."""

    flight: str
    what: str
    """Quantity, difference and tolerance."""

    def __str__(self) -> str:
        """Return the difference in one line."""
        return f"{self.flight}: {self.what}"


def scenarios() -> Iterator[tuple[str, Scenario]]:
    """Yield the flights of the behaviour fingerprint: name and scenario of one episode each."""
    levels: tuple[tuple[LevelName, tuple[str, ...], tuple[int, ...], float], ...] = (
        ("gym", ARENAS, GYM_SEEDS, GYM_LIMIT_S),
        ("lockstep", LOCKSTEP_ARENAS, LOCKSTEP_SEEDS, LOCKSTEP_LIMIT_S),
    )
    for level, arenas, seeds, limit_s in levels:
        for arena, policy, seed, (late, t2) in product(arenas, POLICIES, seeds, LATENCIES.items()):
            asked = {"arena": arena, "policy": policy, "latency": t2, "seed": seed}
            name = f"{level}, {arena}, {policy}, {late}, seed {seed}"
            yield name, Scenario(**_FLIGHT, level=level, time_limit_s=limit_s, **asked)
        name = f"{level}, static-obstacles, wind, spread, noise and payload"
        yield name, Scenario(**_FLIGHT, level=level, time_limit_s=limit_s, **CONDITIONS)
    twin: dict[str, Any] = {**_FLIGHT, "level": "gym", "seed": 1}
    name = "gym, static-obstacles, hover after 60 ms"
    flown: dict[str, Any] = {
        "policy": DISCRETE,
        "latency": LATENCIES["late"],
        "watchdog": {"hover_after_s": 0.06},
    }
    yield name, Scenario(**twin, **flown, time_limit_s=GYM_LIMIT_S)
    for policy in ("dynamic-obstacles", "crowded"):
        name = f"gym, {policy}, continuous actions"
        asked = {"arena": policy, "policy": policy}
        yield name, Scenario(**twin, time_limit_s=CONTINUOUS_LIMIT_S, **asked)


def fly_behaviour(only: Sequence[str] = ()) -> Behaviour:
    """Fly the flights of the behaviour fingerprint, or only some of them, by name."""
    flown: dict[str, Any] = {
        name: sample(_fly(scenario)) for name, scenario in scenarios() if not only or name in only
    }
    return Behaviour(flights=flown)


def _fly(scenario: Scenario) -> FlownEpisode:
    resolved = resolve(scenario)
    if scenario.level == "lockstep":
        return fly(resolved, resolved.fresh_policy(scenario.seed), 0, scenario.seed)
    episodes = [PlannedEpisode(0, scenario.seed)]
    # The vectorized simulator writes no logs: its flier ignores the folder.
    (flown,) = GymFlier(resolved).start(RunFolder(Path()), lambda: False)(episodes)
    return flown


def sample(flown: FlownEpisode) -> FlightSample:
    """Return the samples of a flight from the start of navigation to the verdict."""
    record, path = flown.record, flown.trajectory
    start_us = record.zero_us
    times_us = np.arange(start_us, record.ended_us + 1, SAMPLE_EVERY_US)
    columns = [np.interp(times_us, path.time_us, column) for column in path.position.T]
    energy_j = None if record.quality is None else record.quality.total_energy_j
    return FlightSample(
        outcome=record.outcome.value,
        time_s=round((record.ended_us - start_us) / US_PER_S, DECIMALS),
        energy_j=round(energy_j or 0.0, DECIMALS),
        positions=tuple(
            # Avoid -0.0, which would change the digest.
            (round(north, DECIMALS) + 0.0, round(east, DECIMALS) + 0.0, round(down, DECIMALS) + 0.0)
            for north, east, down in zip(*(column.tolist() for column in columns), strict=True)
        ),
    )


def differences(stored: Behaviour, flown: Behaviour) -> tuple[Difference, ...]:
    """Return the flights that differ by more than the tolerances, ordered by name."""
    found = []
    for name in sorted({*stored.flights, *flown.flights}):
        if name not in stored.flights or name not in flown.flights:
            where = "flown now" if name in flown.flights else "stored"
            found.append(Difference(name, f"only {where}"))
        elif what := _difference(stored.flights[name], flown.flights[name]):
            found.append(Difference(name, what))
    return tuple(found)


def _difference(stored: FlightSample, flown: FlightSample) -> str:
    """Return the first difference of a flight; empty without one."""
    a, b = np.array(stored.positions), np.array(flown.positions)
    n = min(len(a), len(b))
    away = np.linalg.norm(a[:n] - b[:n], axis=1)
    beyond = np.flatnonzero(away > TOLERANCES["position_m"])
    if len(beyond):
        first = int(beyond[0])
        return (
            f"{1e3 * away[first]:.0f} mm apart {first * SAMPLE_EVERY_US / US_PER_S:g} s after its "
            f"start, {1e3 * away.max():.0f} mm at most; the same: 10 mm"
        )
    if stored.outcome != flown.outcome:
        return f"outcome {flown.outcome}, was {stored.outcome}"
    if abs(stored.time_s - flown.time_s) > TOLERANCES["time_s"]:
        return f"{flown.time_s:.3f} s, was {stored.time_s:.3f} s; the same: 0.02 s"
    if abs(stored.energy_j - flown.energy_j) > TOLERANCES["energy_share"] * stored.energy_j:
        return f"{flown.energy_j:.1f} J, was {stored.energy_j:.1f} J; the same: 0.1 %"
    return ""


def read_behaviour(path: Path) -> Behaviour:
    """Read the stored samples; UsageError if missing, damaged or with a wrong digest."""
    data = read_json(path, SCHEMA, "behaviour")
    found = validated(Behaviour, {"flights": data.get("flights")}, path)
    if data.get("digest") != found.digest:
        raise UsageError(f"{path}: digest {data.get('digest')}: accepted: {found.digest}")
    return found


def write_behaviour(path: Path, behaviour: Behaviour) -> None:
    """Write samples atomically, with their digest."""
    data = {"schema": SCHEMA, "digest": behaviour.digest, **behaviour.model_dump(mode="json")}
    write_json(path, data)

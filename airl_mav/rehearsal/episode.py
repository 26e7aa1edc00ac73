"""Episode of a rehearsal: state during the flight, and its record."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.machine import code_now
from airl_mav.faults import LINKS, PROCESSES, Fault
from airl_mav.flight import judge
from airl_mav.flight.episode_record import EpisodeRecord, FaultActed
from airl_mav.flight.trajectory import Trajectory, measure_quality
from airl_mav.latency.stamps import NO_STAMP, SETPOINT, STAMPS, setpoint_column
from airl_mav.rehearsal import channel, process_pair, run_folder
from airl_mav.scenario.resolve import ResolvedScenario
from companion.link_interface import CAMERA_SILENT, FRAMES_LATE, LINK_LOST, TELEMETRY_FROZEN

TAKEOFF_LIMIT_S = 90.0
"""Maximum time from the reset to the start of navigation [simulated s]."""

ARRIVAL_S = 10.0
"""Maximum time from reaching the goal radius to the companion's own goal position [simulated s].
After it, the supervisor orders a landing on the spot."""


class Order(Enum):
    """Order to the companion."""

    LAND = "land"
    """Stop and land."""
    ABANDON = "abandon"
    """End the mission; landing is impossible."""


class EpisodeSupervisor:
    """Supervisor of one episode. Pure: no clock, no I/O."""

    def __init__(self, referee: judge.Referee, started_us: int, *, lands: bool = False) -> None:
        """Take the referee and the start of the episode [µs].

        `lands`: a vehicle elsewhere still flies after a collision, and lands.
        """
        self._lands = lands
        self.referee = referee
        self.started_us = started_us
        """Start of the episode [µs]."""
        self._called_off = False

    @property
    def verdict(self) -> judge.Verdict | None:
        """Return the verdict, or None before it."""
        return self.referee.verdict

    @property
    def due_us(self) -> float:
        """Return the time of the next timeout order [µs]; inf = no timeout."""
        referee = self.referee
        if self._called_off:
            return math.inf
        if referee.verdict is not None:
            return referee.verdict.time_us + ARRIVAL_S * US_PER_S + 1.0
        if referee.navigation_us is None:
            return self.started_us + TAKEOFF_LIMIT_S * US_PER_S + 1.0
        return referee.navigation_us + referee.task.time_limit_s * US_PER_S

    def see(self, sample: judge.TruthSample) -> Order | None:
        """Process the next true sample; return an order for the companion, or None."""
        referee = self.referee
        if referee.verdict is not None:
            late_us = sample.time_us - referee.verdict.time_us
            if late_us > ARRIVAL_S * US_PER_S:
                return self._call_off(land=sample.collision is None)
            return None
        verdict = referee.observe(sample)
        elapsed_s = (sample.time_us - self.started_us) / US_PER_S
        if verdict is None and referee.navigation_us is None and elapsed_s > TAKEOFF_LIMIT_S:
            verdict = referee.abort(sample.time_us, "navigation never began")
        if verdict is None or verdict.outcome is judge.Outcome.SUCCESS:
            return None
        crashed = verdict.outcome in (judge.Outcome.COLLISION, judge.Outcome.BATTERY)
        return self._call_off(land=not crashed)

    def _call_off(self, *, land: bool) -> Order | None:
        if self._called_off:
            return None
        self._called_off = True
        return Order.LAND if land or self._lands else Order.ABANDON


SEPARATED = (LINK_LOST, CAMERA_SILENT, TELEMETRY_FROZEN, FRAMES_LATE)
"""Reasons to end a mission when both processes live but lost contact. A process was blocked for
seconds, or the host is overloaded."""

DISTURBING = (*PROCESSES, *LINKS, "camera")
"""Parts whose faults delay the companion's observations or commands, or cut them off."""


@dataclass
class RunningEpisode:
    """State of a running episode."""

    index: int
    seed: int
    loaded: channel.Loaded
    supervisor: EpisodeSupervisor
    stopwatch: WallClock
    faults: process_pair.ProcessFaults
    notes: list[str]
    wall_us: int | None = None
    """Wall time from reset to verdict [µs]."""
    paused_us: int = 0
    """Time that the firmware was suspended by faults during the episode [simulated µs]."""
    state: channel.State | None = None
    verdict_state: channel.State | None = None
    ended: channel.Ended | None = None
    navigating_us: int | None = None
    """Start of navigation by the companion's clock, which does not skip time [µs]."""

    @property
    def referee(self) -> judge.Referee:
        """Return the episode's referee."""
        return self.supervisor.referee

    @property
    def separated(self) -> str | None:
        """Return the end reason if the processes lost contact before the verdict, else None."""
        verdict, ended = self.referee.verdict, self.ended
        if verdict is None or verdict.outcome is not judge.Outcome.ABORTED or ended is None:
            return None
        return ended.reason if ended.reason in SEPARATED else None

    @property
    def slipped_us(self) -> int:
        """Return the simulated time skipped so far [µs]."""
        return 0 if self.state is None else self.state.slipped_us - self.loaded.slipped_us


def join_episode(
    episode: RunningEpisode, scenario: ResolvedScenario, record_path: Path, decisions_path: Path
) -> run_folder.FlownEpisode:
    """Join both processes' outputs of a judged episode; the companion's log may be missing."""
    arrays = _read(record_path)
    trajectory = Trajectory.from_arrays(part_of(arrays, "trajectory"))
    if episode.loaded.poses:
        # The power of a vehicle elsewhere is unknown.
        trajectory.power_w[:] = np.nan
    latency = part_of(arrays, "estimate", keep_prefix=True)
    latency[run_folder.TICK_LATENESS] = arrays["tick/lateness_us"]
    if decisions_path.exists():
        latency |= join_stamps(
            _read(decisions_path), part_of(arrays, "setpoints"), arrays["tick/slips_us"]
        )
    record = _record(episode, scenario, trajectory, latency, arrays["tick/slips_us"])
    record = replace(record, faults=faults_of(arrays))
    wall_s = record.wall_s
    if wall_s is not None and scenario.speed:
        wall_s -= episode.paused_us / US_PER_S / scenario.speed
    figures = judge.host_figures(
        flight_us=record.ended_us - record.started_us,
        slipped_us=max(0, record.slipped_us - episode.paused_us),
        wall_s=wall_s,
        speed=scenario.speed,
        lateness_us=latency[run_folder.TICK_LATENESS],
        decisions=latency,
        frame_period_us=scenario.vehicle.camera.period_us,
        excused=[(each.from_us, each.to_us) for each in disturbances(record.faults)],
    )
    if scenario.scenario.validity:
        record = replace(record, invalid=judge.host_faults(figures))
    effects = [judge.Effect(**json.loads(line)) for line in arrays["commands/effects"].tolist()]
    record = with_effects(record, scenario, effects)
    if episode.ended is not None and episode.ended.by_hand:
        notes, invalid = (*record.notes, judge.BY_HAND), (*record.invalid, judge.BY_HAND)
        record = replace(record, notes=notes, invalid=invalid)
    return run_folder.FlownEpisode(record, trajectory, latency)


def with_effects(
    record: EpisodeRecord, scenario: ResolvedScenario, effects: Sequence[judge.Effect]
) -> EpisodeRecord:
    """Return the record with the messages that took effect on the vehicle.

    An effect before the verdict makes the flight invalid, unless the companion sent the message. If
    the scenario permits the sender, the effect is a note.
    """
    asked, notes, invalid = scenario.scenario, list(record.notes), list(record.invalid)
    for effect in effects:
        if effect.is_companion or effect.first_us >= record.ended_us:
            continue
        permitted = asked.ground_station and effect.link == "gcs"
        if permitted or not asked.validity:
            notes.append(f"commanded by {effect.line(record.started_us)}")
        else:
            invalid.append(f"{judge.STRANGER}: {effect.line(record.started_us)}")
    return replace(record, notes=tuple(notes), invalid=tuple(invalid), effects=tuple(effects))


def _record(
    episode: RunningEpisode,
    scenario: ResolvedScenario,
    trajectory: Trajectory,
    latency: Mapping[str, NDArray[Any]],
    slips: NDArray[np.int64],
) -> EpisodeRecord:
    state, loaded, began_us = episode.verdict_state, episode.loaded, episode.navigating_us
    return judged_record(
        scenario,
        episode.referee,
        trajectory,
        latency,
        # The referee subtracted the skipped time of its newest state in flight, an older value.
        None if began_us is None else int(without_slips(np.array([began_us]), slips)[0]),
        index=episode.index,
        seed=episode.seed,
        goal=loaded.goal,
        firmware=loaded.firmware,
        started_us=loaded.time_us,
        wall_s=None if episode.wall_us is None else episode.wall_us / US_PER_S,
        slipped_us=state.slipped_us - loaded.slipped_us if state else 0,
        battery_remaining=state.battery if state else None,
        notes=tuple(episode.notes),
        companion_use=None if episode.ended is None else episode.ended.use,
    )


def judged_record(
    scenario: ResolvedScenario,
    referee: judge.Referee,
    trajectory: Trajectory,
    latency: Mapping[str, NDArray[Any]],
    navigation_us: int | None,
    *,
    seed: int,
    started_us: int,
    **known: Any,
) -> EpisodeRecord:
    """Return the record of a refereed flight; without a verdict it is aborted.

    `navigation_us` and `started_us` use the trajectory's clock [µs]. `known` contains the fields of
    `EpisodeRecord` that neither scenario nor referee provides.
    """
    verdict = referee.verdict or referee.abort(started_us, "no verdict")
    quality = None
    if navigation_us is not None and verdict.time_us >= navigation_us:
        quality = measure_quality(
            trajectory,
            navigation_us,
            verdict.time_us,
            scenario.computer.onboard_watts,
            scenario.pack_j,
            decisions=latency,
            hold_s=scenario.pilot.hold_s,
        )
    return EpisodeRecord(
        seed=seed,
        arena=scenario.scenario.arena,
        arena_seed=scenario.scenario.arena_seed_of(seed),
        zone=scenario.scenario.zone,
        outcome=verdict.outcome,
        reason=verdict.reason,
        goal_radius_m=referee.task.goal_radius_m,
        time_limit_s=referee.task.time_limit_s,
        started_us=started_us,
        navigation_us=navigation_us,
        ended_us=verdict.time_us,
        tours_s=scenario.takeoff_s,
        quality=quality,
        code=code_now(),
        **known,
    )


def faults_of(arrays: Mapping[str, NDArray[Any]]) -> tuple[FaultActed, ...]:
    """Return the faults that acted in a flight, from the firmware's arrays."""
    told = part_of(arrays, "faults")
    if not told:
        return ()
    lines = zip(*(told[name].tolist() for name in ("fault", "from_us", "to_us")), strict=True)
    return tuple(FaultActed(*line) for line in lines)


def disturbing(faults: Iterable[Fault]) -> list[Fault]:
    """Return the faults that can delay a companion's decisions or crash the vehicle."""
    return [fault for fault in faults if fault.part in DISTURBING]


def disturbances(acted: Sequence[FaultActed]) -> list[FaultActed]:
    """Return the acted faults that can delay a companion's decisions or crash the vehicle."""
    return [each for each in acted if disturbing([Fault.model_validate(each.fault)])]


COMPANION_STAMPS = tuple(name for name in STAMPS if name != "capture_us")
"""Stamps by the companion's clock; the frame's exposure uses the simulator's clock."""


def join_stamps(
    decisions: dict[str, NDArray[Any]],
    setpoints: dict[str, NDArray[Any]],
    slips: NDArray[np.int64],
) -> dict[str, NDArray[Any]]:
    """Return the decision log with the times at which the autopilot accepted and applied each.

    Slips (k, 2) are the times at which simulated time was skipped, and the durations [µs].
    """
    by_simulator = {name: without_slips(decisions[name], slips) for name in COMPANION_STAMPS}
    if not setpoints:
        return {**decisions, **by_simulator}
    index = match_setpoints(
        by_simulator["sent_us"],
        decisions[setpoint_column(decisions) or SETPOINT],
        setpoints["accepted_us"],
        setpoints["setpoint"],
    )
    return {
        **decisions,
        **by_simulator,
        "accepted_us": stamps_of(index, setpoints["accepted_us"]),
        "motor_us": stamps_of(index, setpoints["motor_us"]),
    }


def without_slips(times_us: NDArray[np.int64], slips: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert times (n,) of the companion's clock to the simulator's clock [µs].

    Both clocks agreed at the start of the episode. Each slip set the simulator's clock back to the
    due tick. Times during the slip map to that tick.
    """
    told = times_us.copy()
    given_up_us = 0
    for tick_us, lost_us in slips:
        told -= np.clip(times_us - (tick_us + given_up_us), 0, lost_us)
        given_up_us += lost_us
    return told


def _read(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}


def part_of(
    arrays: Mapping[str, NDArray[Any]], prefix: str, *, keep_prefix: bool = False
) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names begin with `prefix/`, by the rest of their names."""
    cut = 0 if keep_prefix else len(prefix) + 1
    return {k[cut:]: v for k, v in arrays.items() if k.startswith(f"{prefix}/")}


UNMATCHED = -1

SAME_WITHIN = 1e-5
"""Tolerance for equal setpoints, per element [m/s, rad, rad/s]: MAVSDK converts degrees to
radians in float32, which loses the last bits of a yaw."""


def match_setpoints(
    sent_us: ArrayLike,
    sent_values: ArrayLike,
    accepted_us: ArrayLike,
    accepted_values: ArrayLike,
) -> NDArray[np.int64]:
    """Match each sent setpoint (n, 4) with the first accepted copy of it.

    MAVSDK sends a setpoint at once, and again at 20 Hz until the next one. A copy counts if it was
    accepted at or after the sending, before the next one was sent, and contains the same four
    numbers (NaN, an unused field, equals NaN). If a decision repeats the previous one, a late
    resend of the previous setpoint also counts: it commands the same. Return the index (n,) into
    the accepted setpoints, `UNMATCHED` without a match.
    """
    sent = np.asarray(sent_us, np.int64)
    accepted = np.asarray(accepted_us, np.int64)
    sent_rows = np.asarray(sent_values, np.float32).reshape(-1, 4)
    accepted_rows = np.asarray(accepted_values, np.float32).reshape(-1, 4)
    if len(sent) != len(sent_rows) or len(accepted) != len(accepted_rows):
        raise ValueError(
            f"{len(sent)} sending times for {len(sent_rows)} setpoints, "
            f"{len(accepted)} acceptance times for {len(accepted_rows)}"
        )
    if np.any(np.diff(sent) < 0) or np.any(np.diff(accepted) < 0):
        raise ValueError("times go back: sent_us and accepted_us must be in order")
    index = np.full(len(sent), UNMATCHED, np.int64)
    first = np.searchsorted(accepted, sent, side="left")
    end = np.append(np.searchsorted(accepted, sent[1:], side="left"), len(accepted))
    # All pairs of a sent setpoint and a row accepted before the next one, compared at once.
    counts = np.maximum(end[: len(sent)] - first, 0)
    owner = np.repeat(np.arange(len(sent)), counts)
    row = np.arange(len(owner)) + np.repeat(first - np.cumsum(counts) + counts, counts)
    pairs = accepted_rows[row], sent_rows[owner]
    same = np.isclose(*pairs, rtol=0.0, atol=SAME_WITHIN, equal_nan=True).all(axis=1)
    owners, hits = np.unique(owner[same], return_index=True)
    index[owners] = row[same][hits]
    return index


def stamps_of(index: ArrayLike, times_us: ArrayLike) -> NDArray[np.int64]:
    """Return the time (n,) [µs] of each match in `times_us` (m,); `NO_STAMP` if unmatched."""
    where = np.asarray(index, np.int64)
    stamps = np.full(len(where), NO_STAMP, np.int64)
    matched = where != UNMATCHED
    stamps[matched] = np.asarray(times_us, np.int64)[where[matched]]
    return stamps

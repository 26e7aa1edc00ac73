"""Conversion of a black box, and of the vehicle's log, to an episode for reports."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from airl_mav.black_box import mcap_file, messages
from airl_mav.core import constants, errors, files, frames, resource_use
from airl_mav.flight.episode_record import NO_ARENA, EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory, measure_quality
from airl_mav.latency.stamps import NO_STAMP, SETPOINTS, STAMPS, commanded
from airl_mav.rehearsal import run_folder
from companion.limits import OUT_OF_TIME

if TYPE_CHECKING:
    from airl_mav.vehicle_log import ClockAlignment, VehicleLog

NAVIGATING = "navigating"
"""Phase in which the policy flies (`companion.pilot`)."""

LEAST_NORM = 0.5
"""Minimum norm of a valid quaternion."""

DIGEST = "recording_sha256"
"""Setting of the run with the checksum of its source file."""


@dataclass(frozen=True)
class FlownPilot:
    """Pilot settings of the flight."""

    hold_s: float
    goal_radius_m: float
    commands: constants.CommandKind = "velocity"


@dataclass(frozen=True)
class FlownLimits:
    """Limits of the flight."""

    flight_s: float


@dataclass(frozen=True)
class FlownSettings:
    """Settings of a flight that its page requires."""

    goal: frames.Goal
    seed: int
    speed: Annotated[float, Field(gt=0.0)]
    pilot: FlownPilot
    limits: FlownLimits


_SETTINGS = TypeAdapter(FlownSettings)


def settings_of(box: mcap_file.BlackBox) -> FlownSettings:
    """Return the flight's settings. Raises UsageError if the black box lacks them."""
    return files.typed(_SETTINGS, box.run.get("config", {}), box.path)


def info_of(box: mcap_file.BlackBox, digest: str = "") -> run_folder.RunInfo:
    """Return the description of the run. Raises UsageError if the black box lacks it."""
    run = box.run
    info = run_folder.run_info(run, box.path)
    return replace(info, config={**info.config, DIGEST: digest})


def episode_of(
    box: mcap_file.BlackBox, path: Trajectory | None = None, remarks: tuple[str, ...] = ()
) -> run_folder.FlownEpisode:
    """Return the flight of a black box, or raise UsageError; `path` replaces its telemetry."""
    asked = settings_of(box)
    path = path_of(box) if path is None else path
    stamps = stamps_of(box)
    started_us = int(path.time_us[0]) if len(path) else 0
    phases = box.all_of(messages.Phase)
    begun = [phase.time_us for phase in phases if phase.phase == NAVIGATING]
    navigation_us = begun[0] if begun else None
    ended_us = _ended_us(box, path, navigation_us)
    ends = box.all_of(messages.End)
    reason, notes = (ends[-1].reason, ends[-1].notes) if ends else _cut(box, ended_us)
    if box.damaged:
        notes = (*notes, "the recording is damaged: its checksum is wrong")
    outcome = Outcome.TIMEOUT if reason == OUT_OF_TIME else Outcome.ABORTED
    arrived_us = _arrived_us(path, navigation_us, ended_us, asked)
    if arrived_us is not None:
        outcome, ended_us = Outcome.SUCCESS, arrived_us
    quality = None
    if navigation_us is not None and len(path):
        quality = measure_quality(
            *(path, navigation_us, ended_us, 0.0), decisions=stamps, hold_s=asked.pilot.hold_s
        )
    batteries = [status.battery_remaining for status in box.all_of(messages.Status)]
    record = EpisodeRecord(
        index=0,
        seed=asked.seed,
        arena=NO_ARENA,
        arena_seed=0,
        outcome=outcome,
        reason=reason,
        goal=asked.goal,
        goal_radius_m=asked.pilot.goal_radius_m,
        time_limit_s=asked.limits.flight_s,
        started_us=started_us,
        navigation_us=navigation_us,
        ended_us=ended_us,
        wall_s=(ended_us - started_us) / constants.US_PER_S / asked.speed,
        slipped_us=0,
        battery_remaining=next((b for b in reversed(batteries) if b is not None), None),
        quality=quality,
        notes=(*remarks, *notes),
        companion_use=_use(box.all_of(messages.Resources)),
    )
    return run_folder.FlownEpisode(record, path, stamps)


def path_of(box: mcap_file.BlackBox) -> Trajectory:
    """Return the path and power [W] of the telemetry; NaN power if never measured."""
    told = box.all_of(messages.Telemetry)
    rows = [(*each.position, *each.velocity, *each.quaternion) for each in told]
    states = np.array(rows, np.float64).reshape(len(rows), 10)  # None becomes NaN
    times = np.array([each.time_us for each in told], np.int64)
    # Before the first telemetry, all values are NaN or 0; a zero quaternion is invalid.
    known = np.isfinite(states).all(axis=1) & (np.linalg.norm(states[:, 6:], axis=1) > LEAST_NORM)
    times, states = times[known], states[known]
    later = np.diff(times, prepend=NO_STAMP) > 0
    times, states = times[later], states[later]
    power_w = _power_w(box.all_of(messages.Status), times)
    return Trajectory(times, states[:, :3], states[:, 3:6], states[:, 6:], power_w)


def stamps_of(box: mcap_file.BlackBox) -> dict[str, NDArray[Any]]:
    """Return the columns of the decisions as in `latency.stamps.DecisionLog.columns`."""
    decisions, commands = box.all_of(messages.Decision), settings_of(box).pilot.commands
    columns: dict[str, NDArray[Any]] = {
        name: np.array([getattr(each, name) for each in decisions], np.int64) for name in STAMPS
    }
    # The next decision records the actual end of the hold; the last has only its planned end.
    columns["held_until_us"][:-1] = [each.held_before_us for each in decisions[1:]]
    rows = [each.setpoint for each in decisions]
    columns[SETPOINTS[commands]] = np.array(rows, np.float32).reshape(len(rows), 4)
    return columns


def _power_w(statuses: list[messages.Status], times_us: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the newest power (n,) at times (n,); NaN if never measured (old PX4 sends -1 A)."""
    told = [
        (status.time_us, status.voltage_v * status.current_a)
        for status in statuses
        if status.voltage_v is not None
        and status.current_a is not None
        and status.current_a != constants.UNMEASURED_A
    ]
    if not told:
        return np.full(len(times_us), np.nan)
    at_us, power_w = np.array(told).T
    newest = np.searchsorted(at_us, times_us, side="right") - 1
    return np.asarray(power_w[np.maximum(newest, 0)], np.float64)


def _ended_us(box: mcap_file.BlackBox, path: Trajectory, navigation_us: int | None) -> int:
    """Return the end of navigation, or of the recording [µs]."""
    if navigation_us is not None:
        for phase in box.all_of(messages.Phase):
            if phase.time_us >= navigation_us and phase.phase != NAVIGATING:
                return phase.time_us
    sent_us = [decision.sent_us for decision in box.all_of(messages.Decision)]
    return max([navigation_us or 0, *sent_us, *map(int, path.time_us[-1:])])


def _cut(box: mcap_file.BlackBox, ended_us: int) -> tuple[str, tuple[str, ...]]:
    """Return the reason and the notes of a flight with a truncated recording."""
    phases = box.all_of(messages.Phase)
    where = f" while {phases[-1].phase}" if phases else ""
    note = "the companion, its computer or the power failed, or the file was damaged there"
    return f"the recording ends{where}", (f"the recording ends at {ended_us / 1e6:.2f} s: {note}",)


def _arrived_us(
    path: Trajectory, navigation_us: int | None, ended_us: int, asked: FlownSettings
) -> int | None:
    """Return the arrival by the referee's rule [µs], before the companion's; None = no arrival."""
    if navigation_us is None:
        return None
    flown = path.between(navigation_us, ended_us)
    away = np.array([frames.goal_distance_m(asked.goal, here) for here in flown.position])
    there = np.flatnonzero(away < asked.pilot.goal_radius_m)
    return int(flown.time_us[there[0]]) if len(there) else None


def _use(resources: list[messages.Resources]) -> resource_use.ProcessUse | None:
    if len(resources) < 2:
        return None
    times_s = np.array([each.time_us for each in resources]) / constants.US_PER_S
    cores = np.array([each.process_cores for each in resources[1:]])
    return resource_use.ProcessUse(
        wall_s=float(times_s[-1] - times_s[0]),
        cpu_s=float(np.sum(cores * np.diff(times_s))),
        peak_memory_bytes=max(each.memory_bytes for each in resources),
        peak_since="begin",
        power_w=None,
        power_source="not measured by the black box",
    )


WITH_LOG = "-with-log"
"""Suffix of the run folder's name for a flight with a vehicle log."""


def take_in(path: Path, ulg: Path | None = None) -> Path:
    """Return the run folder of a black box and its vehicle's log, created beside it if missing."""
    box = mcap_file.read_black_box(path)
    folder = files.subfolder(path.parent, path.stem + ("" if ulg is None else WITH_LOG))
    digest = files.sha256_of(path)
    if ulg is not None:
        # Imported here: pyulog is an extra.
        from airl_mav.vehicle_log import read_vehicle_log

        log = read_vehicle_log(ulg)
        digest = hashlib.sha256(f"{digest} {files.sha256_of(ulg)}".encode()).hexdigest()
    if (folder / run_folder.RUN_FILE).exists():
        if run_folder.load_info(folder).config.get(DIGEST) != digest:
            raise errors.UsageError(
                f"{folder}: holds another run; accepted: that of {path.name}, or no such folder"
            )
        return folder
    episode = episode_of(box) if ulg is None else logged_episode_of(box, log)
    run_folder.RunFolder.adopt(folder, info_of(box, digest), episodes=[episode])
    return folder


def logged_episode_of(box: mcap_file.BlackBox, log: VehicleLog) -> run_folder.FlownEpisode:
    """Return the flight with path, power and motor outputs from the log, or raise UsageError."""
    # Imported here: pyulog is an extra.
    from airl_mav.vehicle_log import align

    told = path_of(box)
    stamps = stamps_of(box)
    kind = commanded(stamps)
    setpoints = np.asarray(stamps[SETPOINTS[kind]], np.float64)
    clocks = align(told, log, stamps["sent_us"], setpoints, kind)
    ahead_us = offset_us(clocks)
    path = _path(told, log, clocks.told_us, ahead_us)
    note = (
        f"path, power and motor outputs are those of {log.path.name}; its clock is"
        f" {-ahead_us / constants.US_PER_MS:+.1f} ms ahead of the recording's, by attitude"
        f" and velocity in both (which agree to {clocks.error_m_s:.3f} m/s) and"
        f" {clocks.setpoints} setpoints"
    )
    episode = episode_of(box, path, (note,))
    columns: dict[str, NDArray[Any]] = {
        **episode.latency,
        run_folder.MOTOR_TIMES: np.round(log.motors.time_us + ahead_us).astype(np.int64),
        run_folder.MOTOR_OUTPUTS: log.motors.values.astype(np.float32),
    }
    return run_folder.FlownEpisode(episode.record, path, columns)


def offset_us(clocks: ClockAlignment) -> float:
    """Return the offset from log to companion time [µs].

    Assumes equal delays both ways if both are known, as NTP does (D. Mills, RFC 5905).
    """
    if clocks.accepted_us is None:
        return clocks.told_us
    return 0.5 * (clocks.told_us - clocks.accepted_us)


def _path(told: Trajectory, log: VehicleLog, told_us: float, ahead_us: float) -> Trajectory:
    """Return the log's estimate at its attitude times, with the battery's power."""
    attitude, motion = log.attitude, log.motion
    inside = (attitude.time_us >= motion.time_us[0]) & (attitude.time_us <= motion.time_us[-1])
    logged_us, quaternion = attitude.time_us[inside], attitude.values[inside]
    state = motion.at(logged_us)
    # Both usually share the estimator's origin; otherwise, the goal uses the recording's origin.
    both = (told.time_us - told_us >= motion.time_us[0]) & (
        told.time_us - told_us <= motion.time_us[-1]
    )
    apart = told.position[both] - motion.at(told.time_us[both] - told_us)[:, :3]
    position = state[:, :3] + np.median(apart, axis=0)
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    times_us = np.round(logged_us + ahead_us).astype(np.int64)
    power_w = _logged_power_w(log, logged_us, told, times_us)
    return Trajectory(times_us, position, state[:, 3:], quaternion / length, power_w)


def _logged_power_w(
    log: VehicleLog, logged_us: NDArray[np.int64], told: Trajectory, times_us: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the battery's power (n,) from the log, or from the recording without log values."""
    battery = log.battery
    known = np.isfinite(battery.values[:, :2]).all(axis=1) if len(battery) else np.zeros(0, bool)
    if not known.any():
        return np.interp(times_us, told.time_us, told.power_w)
    watts = battery.values[known, 0] * battery.values[known, 1]
    return np.asarray(np.interp(logged_us, battery.time_us[known], watts), np.float64)

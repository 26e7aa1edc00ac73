"""Recorded flights of runs, and the state of a flight at any time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.view import view_messages
from airl_mav.addons.view.view_messages import OFFBOARD, STRIP_S, TRAIL_STEP_M, Shown
from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.files import Arrays
from airl_mav.flight.episode_record import NO_ARENA, EpisodeRecord, ranked
from airl_mav.flight.trajectory import Trajectory, pose_at
from airl_mav.latency.stamps import SETPOINT, commanded, setpoint_column
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal import run_folder

INFO, WARNING = 6, 4
"""Levels of MAV_SEVERITY."""

STANDING_M = 0.2
"""Maximum height of a landed vehicle outside navigation [m]."""

TURNING = (0.5, 0.5, 0.5, 0.5)
"""Displayed rotor speeds of a flying vehicle; real speeds are not recorded."""

PARTED = 0.05
"""Tolerance for equal setpoints [m/s, rad/s]."""

AGE_STEP_US = 40_000
"""Period of the points of the latency strip [µs]."""


@dataclass(frozen=True)
class ReplayedFlight:
    """Flight of a run. Times are simulated, as in its record [µs]."""

    record: EpisodeRecord
    path: Trajectory
    """Path to the end of the recording, one or more samples."""
    stamps: Arrays
    """Decisions by column; empty if not recorded."""
    arena: Arena | None
    vehicle: VehicleProfile
    compensated: bool
    """True if the companion compensated latency."""

    @property
    def label(self) -> str:
        """Name of the flight."""
        record = self.record
        return f"{record.index:03d}, seed {record.seed}, {record.outcome.value}"

    @property
    def duration_s(self) -> float:
        """Time from the reset to the end of the recording [s]."""
        return (int(self.path.time_us[-1]) - self.record.started_us) / US_PER_S

    @cached_property
    def episode(self) -> view_messages.Episode:
        """Message with the flight's scene."""
        return view_messages.Episode(
            seed=self.record.seed,
            started_us=self.record.started_us,
            arena=self.arena,
            vehicle=view_messages.VehicleShape.of(self.vehicle),
            goal=self.record.goal,
            goal_radius_m=self.record.goal_radius_m,
        )

    @cached_property
    def trail(self) -> list[tuple[float, float, float]]:
        """Complete path (n, 3) NED [m]."""
        way, kept = self.path.position, [0]
        for i, step in enumerate(way):
            if np.linalg.norm(step - way[kept[-1]]) >= TRAIL_STEP_M:
                kept.append(i)
        return [(x, y, z) for x, y, z in way[kept].tolist()]

    @cached_property
    def sent_us(self) -> NDArray[np.int64]:
        """Send times of the decisions (n,), increasing; n = 0 without recorded decisions."""
        return np.asarray(self.stamps.get("sent_us", np.zeros(0)), np.int64)

    @cached_property
    def ages(self) -> NDArray[np.float64]:
        """Age of the command and t2 over time (n, 3): s since the reset, ms, ms."""
        if not len(self.sent_us):
            return np.zeros((0, 3))
        ends_us = max(int(self.sent_us[-1]), self.record.ended_us)
        times = np.arange(int(self.sent_us[0]), ends_us, AGE_STEP_US)
        which = np.searchsorted(self.sent_us, times, side="right") - 1
        ages = (times - self.stamps["capture_us"][which]) / US_PER_MS
        t2s = (self.stamps["action_ready_us"] - self.stamps["infer_start_us"])[which] / US_PER_MS
        return np.stack([(times - self.record.started_us) / US_PER_S, ages, t2s], axis=1)

    def time_us(self, seconds: float) -> int:
        """Convert seconds after the reset to simulated time [µs]."""
        return self.record.started_us + round(seconds * US_PER_S)

    def decision(self, time_us: int) -> int | None:
        """Return the number of the newest decision at a time; None before the first."""
        number = int(np.searchsorted(self.sent_us, time_us, side="right")) - 1
        return None if number < 0 else number

    def image(self, time_us: int) -> view_messages.Image | None:
        """Return the camera image at a time, without noise; None without an arena."""
        if self.arena is None:
            return None
        # Imported here, as it loads numba and a flight is shown before its arena.
        from airl_mav.report.policy_view import PathCamera, PolicyCamera

        camera = PolicyCamera.of(self.vehicle.camera)
        return PathCamera(self.arena, camera, self.path, self.record.started_us).image(time_us)

    def show(self, shown: Shown, seconds: float) -> None:
        """Set `shown` to a time after the reset [s]; its episode and arena remain."""
        record, time_us = self.record, self.time_us(seconds)
        position, velocity, quaternion = pose_at(self.path, time_us)
        navigates = record.navigates(time_us)
        flies = navigates or -position[2] > STANDING_M
        shown.vehicle = view_messages.VehicleState(
            time_us=time_us,
            position=tuple(position.tolist()),
            velocity=tuple(velocity.tolist()),
            quaternion=tuple(quaternion.tolist()),
            rotors=TURNING if flies else (0.0, 0.0, 0.0, 0.0),
            battery=None,
            mode=OFFBOARD if navigates else "",
            armed=flies,
            collision=None,
        )
        ended = time_us >= record.ended_us
        shown.phase = record.outcome.value if ended else "navigating" if navigates else "before"
        self._show_decision(shown, time_us)
        ages = self.ages
        inside = (ages[:, 0] > seconds - STRIP_S) & (ages[:, 0] <= seconds)
        shown.ages = deque(map(tuple, ages[inside].tolist()))
        shown.picture = self.image(time_us)

    def _show_decision(self, shown: Shown, time_us: int) -> None:
        number = self.decision(time_us)
        if number is None:
            shown.decided = shown.decided_image = None
            shown.decisions = 0
            return
        if shown.decided is not None and shown.decisions == number + 1:
            return
        captured_us, began_us, ready_us, sent_us = (
            int(self.stamps[name][number])
            for name in ("capture_us", "infer_start_us", "action_ready_us", "sent_us")
        )
        column = setpoint_column(self.stamps) or SETPOINT
        image = self.image(captured_us)
        shown.decided_image, shown.decisions = image, number + 1
        shown.decided = view_messages.Decided(
            captured_us=captured_us,
            began_us=began_us,
            ready_us=ready_us,
            sent_us=sent_us,
            expires_us=None,
            setpoint=tuple(self.stamps[column][number].tolist()),
            commands=commanded(self.stamps),
            compensated=self.compensated,
            shape=(1, 1) if image is None else view_messages.shape_of(image),
        )

    def begin(self, shown: Shown) -> None:
        """Reset `shown` to this flight."""
        record = self.record
        shown.take(self.episode, None)
        shown.is_surrounded = True
        shown.flight = view_messages.Flight(index=record.index, seed=record.seed, goal=record.goal)
        shown.trail = self.trail
        shown.texts.clear()
        for fault in record.faults:
            shown.texts.append(
                view_messages.Said(time_us=fault.from_us, severity=WARNING, text=fault.fault)
            )
        for note in record.notes:
            shown.texts.append(view_messages.Said(time_us=None, severity=WARNING, text=note))
        how = f"{record.outcome.value}: {record.reason}"
        shown.texts.append(view_messages.Said(time_us=record.ended_us, severity=INFO, text=how))

    def surround(self, shown: Shown) -> None:
        """Add the arena to `shown`, which so far shows this flight without an arena."""
        shown.episode, shown.arena = self.episode, self.arena
        shown.is_surrounded = True
        shown.decided = None  # The next update shows the policy's image.


def parting_s(first: ReplayedFlight, other: ReplayedFlight) -> float | None:
    """Return the exposure [s since reset] of the first different decision; None = equal."""
    column = setpoint_column(first.stamps)
    if column is None or column not in other.stamps:
        return None
    ours, theirs = first.stamps[column], other.stamps[column]
    shared = min(len(ours), len(theirs))
    differ = np.abs(ours[:shared] - theirs[:shared]).max(axis=1, initial=0.0) > PARTED
    number = int(np.argmax(differ)) if differ.any() else shared
    if number >= len(ours):
        return None
    return (int(first.stamps["capture_us"][number]) - first.record.started_us) / US_PER_S


def run_folders(path: Path) -> list[Path]:
    """Return a campaign's run folders, or the path itself; raise UsageError if it is empty."""
    if not (path / run_folder.CAMPAIGN_FILE).is_file():
        return [path]
    found = sorted(file.parent for file in path.glob(f"*/{run_folder.RUN_FILE}"))
    if not found:
        raise UsageError(f"{path}: a campaign of which no run has begun")
    return found


class ReplayedRuns:
    """Selectable runs, each read on first use."""

    def __init__(self, folders: Iterable[Path]) -> None:
        """Name the runs by their folders, or by full paths if folder names are not unique."""
        paths = list(dict.fromkeys(folders))
        short = [path.name for path in paths]
        names = short if len(set(short)) == len(short) else [str(path) for path in paths]
        self._folders = dict(zip(names, paths, strict=True))
        self._read: dict[str, ReplayedRun] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the runs."""
        return tuple(self._folders)

    def name_of(self, run: ReplayedRun) -> str:
        """Return the name of a run."""
        return next(name for name, path in self._folders.items() if path == run.path)

    def at(self, folder: Path) -> ReplayedRun:
        """Return the run of a folder. Raises UsageError as `ReplayedRun`."""
        return self.run(next(name for name, path in self._folders.items() if path == folder))

    def run(self, name: str) -> ReplayedRun:
        """Return the run with a name. Raises UsageError as `ReplayedRun`."""
        if name not in self._read:
            self._read[name] = ReplayedRun(self._folders[name])
        return self._read[name]


class ReplayedRun:
    """Run folder with flights for replay, each prepared on first use."""

    def __init__(self, path: Path) -> None:
        """Read a run folder; raise UsageError without recorded flights or with missing profiles."""
        self._run: run_folder.LoadedRun = run_folder.load(path)
        self._vehicle: VehicleProfile = run_folder.vehicle_of(self._run.info)
        self.path, self.info = path, self._run.info
        self.title = f"{self._run.info.setup.policy.name} in {self._run.info.setup.arena.name}"
        """Title of the run: policy and arena."""
        paths = self._run.trajectories
        recorded = [
            e for e in ranked(self._run.episodes) if e.index in paths and len(paths[e.index])
        ]
        if not recorded:
            raise UsageError(f"{path}: no flight is recorded")
        self.records: tuple[EpisodeRecord, ...] = tuple(recorded)
        """Records of flights with a path, worst first."""
        self._made: dict[int, ReplayedFlight] = {}

    def record(self, index: int) -> EpisodeRecord:
        """Return the record of a flight. Raises FieldError if the flight is not recorded."""
        found = next((each for each in self.records if each.index == index), None)
        if found is None:
            numbers = sorted(each.index for each in self.records)
            raise FieldError("flight", index, f"{numbers[0]} to {numbers[-1]}, as far as recorded")
        return found

    def check(self, record: EpisodeRecord) -> None:
        """Raise UsageError if the arena of a flight cannot be generated."""
        if record.arena != NO_ARENA:
            run_folder.spec_of(record.arena)

    def way(self, record: EpisodeRecord) -> ReplayedFlight:
        """Return a flight without its arena, which is slow to generate."""
        index, run = record.index, self._run
        return ReplayedFlight(
            record,
            run.trajectories[index],
            run.latency.get(index, {}),
            None,
            self._vehicle,
            bool(run.info.config.get("pilot", {}).get("compensate")),
        )

    def flight(self, record: EpisodeRecord) -> ReplayedFlight:
        """Return a flight with its arena. Raises UsageError if the arena cannot be generated."""
        index = record.index
        if index not in self._made:
            arena = run_folder.arenas_of([record], self._vehicle).get(index)
            self._made[index] = replace(self.way(record), arena=arena)
        return self._made[index]

    def same(self, record: EpisodeRecord) -> EpisodeRecord | None:
        """Return the flight with the seed and arena of another run's flight; None without one."""
        key = (record.seed, record.arena, record.arena_seed, record.zone)
        for each in self.records:
            if (each.seed, each.arena, each.arena_seed, each.zone) == key:
                return each
        return None

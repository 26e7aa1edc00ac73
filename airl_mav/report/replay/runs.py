"""Flights of runs for replay, worst first."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from airl_mav.core.errors import FieldError, UsageError
from airl_mav.flight.record import NO_ARENA, EpisodeRecord
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import CAMPAIGN_FILE, RUN_FILE, LoadedRun, load
from airl_mav.report.arenas import arenas_of, spec_of, vehicle_of
from airl_mav.report.forensics.evidence import ranked
from airl_mav.report.replay.flight import ReplayedFlight


def run_folders(path: Path) -> list[Path]:
    """Return a campaign's run folders, or the path itself; raise UsageError if it is empty."""
    if not (path / CAMPAIGN_FILE).is_file():
        return [path]
    found = sorted(file.parent for file in path.glob(f"*/{RUN_FILE}"))
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
        self._run: LoadedRun = load(path)
        self._vehicle: VehicleProfile = vehicle_of(self._run.info)
        self.path, self.info = path, self._run.info
        self.title = f"{self._run.info.setup.policy.name} in {self._run.info.setup.arena.name}"
        """Title of the run: policy and arena."""
        paths = self._run.trajectories
        recorded = [e for e in ranked(self._run) if e.index in paths and len(paths[e.index])]
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
            spec_of(record.arena)

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
            arena = arenas_of([record], self._vehicle).get(index)
            self._made[index] = replace(self.way(record), arena=arena)
        return self._made[index]

    def same(self, record: EpisodeRecord) -> EpisodeRecord | None:
        """Return the flight with the seed and arena of another run's flight; None without one."""
        key = (record.seed, record.arena, record.arena_seed, record.zone)
        for each in self.records:
            if (each.seed, each.arena, each.arena_seed, each.zone) == key:
                return each
        return None

"""The flights of a run, ready to be replayed, the worst first."""

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
    """Return a campaign's run folders, or the path itself; UsageError if it is empty."""
    if not (path / CAMPAIGN_FILE).is_file():
        return [path]
    found = sorted(file.parent for file in path.glob(f"*/{RUN_FILE}"))
    if not found:
        raise UsageError(f"{path}: a campaign of which no run has begun")
    return found


class ReplayedRuns:
    """Runs that can be chosen, each read when it is asked for."""

    def __init__(self, folders: Iterable[Path]) -> None:
        """Name them by their folders; by all of their paths where two have the same name."""
        paths = list(dict.fromkeys(folders))
        short = [path.name for path in paths]
        names = short if len(set(short)) == len(short) else [str(path) for path in paths]
        self._folders = dict(zip(names, paths, strict=True))
        self._read: dict[str, ReplayedRun] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(self._folders)

    def name_of(self, run: ReplayedRun) -> str:
        """Return what one of them is called."""
        return next(name for name, path in self._folders.items() if path == run.path)

    def at(self, folder: Path) -> ReplayedRun:
        """Return the run of a folder. Raises UsageError as `ReplayedRun`."""
        return self.run(next(name for name, path in self._folders.items() if path == folder))

    def run(self, name: str) -> ReplayedRun:
        """Return one of them. Raises UsageError as `ReplayedRun`."""
        if name not in self._read:
            self._read[name] = ReplayedRun(self._folders[name])
        return self._read[name]


class ReplayedRun:
    """A run folder; what a flight needs beside its record is made when it is asked for."""

    def __init__(self, path: Path) -> None:
        """Read a run folder; UsageError if no flight was recorded or a profile is missing."""
        self._run: LoadedRun = load(path)
        self._vehicle: VehicleProfile = vehicle_of(self._run.info)
        self.path, self.info = path, self._run.info
        self.title = f"{self._run.info.setup.policy.name} in {self._run.info.setup.arena.name}"
        """Flights and their arenas."""
        paths = self._run.trajectories
        recorded = [e for e in ranked(self._run) if e.index in paths and len(paths[e.index])]
        if not recorded:
            raise UsageError(f"{path}: no flight is recorded")
        self.records: tuple[EpisodeRecord, ...] = tuple(recorded)
        """Those that can be replayed, the worst first."""
        self._made: dict[int, ReplayedFlight] = {}

    def record(self, index: int) -> EpisodeRecord:
        """Return the record of a flight. Raises FieldError where it is not there."""
        found = next((each for each in self.records if each.index == index), None)
        if found is None:
            numbers = sorted(each.index for each in self.records)
            raise FieldError("flight", index, f"{numbers[0]} to {numbers[-1]}, as far as recorded")
        return found

    def check(self, record: EpisodeRecord) -> None:
        """Raise UsageError unless the arena of a flight can be made."""
        if record.arena != NO_ARENA:
            spec_of(record.arena)

    def way(self, record: EpisodeRecord) -> ReplayedFlight:
        """Return a flight without its arena, which takes longer to make than all the rest."""
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
        """Return a flight. Raises UsageError where its arena cannot be made any more."""
        index = record.index
        if index not in self._made:
            arena = arenas_of([record], self._vehicle).get(index)
            self._made[index] = replace(self.way(record), arena=arena)
        return self._made[index]

    def same(self, record: EpisodeRecord) -> EpisodeRecord | None:
        """Return the flight of the same seed and arena as another run's; None: there is none."""
        key = (record.seed, record.arena, record.arena_seed, record.zone)
        for each in self.records:
            if (each.seed, each.arena, each.arena_seed, each.zone) == key:
                return each
        return None

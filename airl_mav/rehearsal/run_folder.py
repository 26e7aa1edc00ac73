"""The folder a run leaves behind: written so that a kill at any moment loses no saved episode.

docs/run-folder.md describes every file. An episode is committed by its line in `episodes.jsonl`,
which is written last; arrays without a line belong to an episode that never ended.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.core.files import add_arrays
from airl_mav.core.provenance import describe_machine, git_state, package_versions
from airl_mav.core.versioned import read_versioned, write_json
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.setup import Setup
from airl_mav.flight.trajectory import Trajectory

SCHEMA = 1
"""Version of the folder's layout and of `run.json`."""

RUN_FILE = "run.json"
EPISODES_FILE = "episodes.jsonl"
LATENCY_FILE = "latency.npz"
TRAJECTORIES_FILE = "trajectories.npz"
FIRMWARE_PRINTS = "autopilot.log"
"""What real firmware prints, where it was started for the run."""
LOG_FILES = ("firmware.log", "companion.log", FIRMWARE_PRINTS)
"""What the processes have to say to people; the first two are empty when all is well."""

TICK_LATENESS = "tick_lateness_us"
"""Name of the array of a paced run that says how late each tick began [µs]."""

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class RunInfo:
    """What `run.json` holds."""

    name: str
    created_utc: str
    """ISO 8601."""
    setup: Setup
    config: dict[str, Any]
    """Every setting of the run, as given."""
    seeds: tuple[int, ...]
    """Seed of each episode planned, by index."""
    versions: dict[str, str]
    """Packages by name."""
    machine: dict[str, Any]
    git: dict[str, Any] | None
    """Commit of the checkout, and whether it was changed; None for an installed wheel."""
    schema: int = SCHEMA


_INFO = TypeAdapter(RunInfo)


@dataclass(frozen=True)
class LoadedRun:
    """A run read back. The mappings are by episode index and may lack episodes."""

    path: Path
    info: RunInfo
    episodes: tuple[EpisodeRecord, ...]
    latency: dict[int, Arrays]
    trajectories: dict[int, Trajectory]


@dataclass(frozen=True)
class FlownEpisode:
    """One episode, flown."""

    record: EpisodeRecord
    trajectory: Trajectory
    """Its true path."""
    latency: Mapping[str, NDArray[Any]]
    """Its raw stamps by column; see docs/run-folder.md."""


class RunFolder:
    """A run being written."""

    def __init__(self, path: Path) -> None:
        """Wrap a folder; use `create` for a new run and `resume` for one that was killed."""
        self.path = path

    @classmethod
    def create(
        cls,
        out: Path | None,
        name: str,
        config: Mapping[str, Any],
        *,
        setup: Setup,
        seeds: Sequence[int] = (),
    ) -> RunFolder:
        """Make the folder and write `run.json`.

        Args:
            out: The folder; None makes `runs/<UTC time>-<name>` in the working directory.
            name: Name of the run.
            config: Every setting: plain values, paths, pydantic models, dataclasses.
            setup: What is flown on what.
            seeds: Seed of each episode planned.

        Raises:
            UsageError: `out` already holds a run, or is a file.
        """
        now = utc_now()
        if out is None:
            path = _fresh_folder(Path("runs"), f"{now:%Y%m%dT%H%M%SZ}-{name}")
        else:
            path = out
            if (path / RUN_FILE).exists():
                raise UsageError(f"--out {path}: already holds a run; accepted: a new folder")
            try:
                path.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise UsageError(f"--out {path}: {error.strerror}") from None
        info = RunInfo(
            name=name,
            created_utc=now.isoformat(timespec="seconds"),
            setup=setup,
            config=dict(config),
            seeds=tuple(seeds),
            versions=package_versions(),
            machine=describe_machine(),
            git=git_state(),
        )
        _write_info(path / RUN_FILE, info)
        return cls(path)

    @classmethod
    def resume(cls, path: Path) -> tuple[RunFolder, LoadedRun]:
        """Open a run that was killed, cut off a half-written line, and say what is there."""
        run = load(path)
        lines = path / EPISODES_FILE
        if lines.exists():
            data = lines.read_bytes()
            if (whole := data.rfind(b"\n") + 1) != len(data):
                os.truncate(lines, whole)
        return cls(path), run

    def plan_again(self, config: Mapping[str, Any], seeds: Sequence[int]) -> None:
        """Replace the settings and the seeds that are planned, in `run.json`."""
        path = self.path / RUN_FILE
        info = read_versioned(path, _INFO, SCHEMA, "run")
        _write_info(path, replace(info, config=dict(config), seeds=tuple(seeds)))

    def tlog_path(self, index: int) -> Path:
        """Return the path of an episode's raw MAVLink log."""
        return self.path / f"flight-{index:03d}.tlog"

    def sweep(self) -> None:
        """Remove what processes left behind for an episode that was never finished.

        The MAVLink log of a killed firmware is kept: whole records, up to its last second.
        """
        for pattern in (".*.npz*", f"{LATENCY_FILE}.partial", f"{TRAJECTORIES_FILE}.partial"):
            for leftover in self.path.glob(pattern):
                leftover.unlink()
        for log in self.path.glob("flight-*.tlog.part"):
            log.rename(log.with_suffix(""))

    def discard(self) -> None:
        """Take back a run that never began, so that the same folder can be used again."""
        for name in (RUN_FILE, *LOG_FILES):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):  # Somebody else's files.
            self.path.rmdir()

    def save_episode(
        self, record: EpisodeRecord, trajectory: Trajectory, latency: Mapping[str, NDArray[Any]]
    ) -> None:
        """Save an episode as it ends; on return it is on the disk."""
        self.save_episodes([FlownEpisode(record, trajectory, latency)])

    def save_episodes(self, episodes: Sequence[FlownEpisode]) -> None:
        """Save episodes; on return they are on the disk.

        The arrays come first, then the lines that commit them.
        """
        groups = {f"{episode.record.index:03d}": episode for episode in episodes}
        add_arrays(
            self.path / TRAJECTORIES_FILE, {g: e.trajectory.arrays() for g, e in groups.items()}
        )
        add_arrays(self.path / LATENCY_FILE, {g: e.latency for g, e in groups.items()})
        lines = b"".join(episode.record.to_json().encode() + b"\n" for episode in episodes)
        with (self.path / EPISODES_FILE).open("ab") as file:
            file.write(lines)
            file.flush()
            os.fsync(file.fileno())


def load(path: Path) -> LoadedRun:
    """Read a run folder back; a last line cut short by a kill is passed over.

    Raises:
        UsageError: The folder holds no run, or a file of it cannot be read.
    """
    info = read_versioned(path / RUN_FILE, _INFO, SCHEMA, "run")
    episodes = _load_episodes(path / EPISODES_FILE)
    done = {episode.index for episode in episodes}
    stamps = _load_arrays(path / LATENCY_FILE)
    paths = _load_arrays(path / TRAJECTORIES_FILE)
    try:
        trajectories = {i: Trajectory.from_arrays(a) for i, a in paths.items() if i in done}
    except (KeyError, ValueError) as error:
        raise UsageError(f"{path / TRAJECTORIES_FILE}: {error}") from None
    latency = {i: arrays for i, arrays in stamps.items() if i in done}
    return LoadedRun(path, info, episodes, latency, trajectories)


def _write_info(path: Path, info: RunInfo) -> None:
    """Write `run.json`."""
    write_json(path, _INFO.dump_python(info, mode="json"))


def _load_episodes(path: Path) -> tuple[EpisodeRecord, ...]:
    """Read the whole lines, in the order of their index; a later line replaces an earlier."""
    data = path.read_bytes() if path.exists() else b""
    whole = data[: data.rfind(b"\n") + 1]
    episodes = {}
    for number, line in enumerate(whole.splitlines(), start=1):
        try:
            record = EpisodeRecord.from_json(line)
        except ValueError as error:
            raise UsageError(f"{path}:{number}: {error}") from None
        episodes[record.index] = record
    return tuple(episodes[index] for index in sorted(episodes))


def _load_arrays(path: Path) -> dict[int, Arrays]:
    """Read an archive whose keys are `<episode>/<name>`."""
    episodes: dict[int, Arrays] = {}
    if not path.exists():
        return episodes
    try:
        with np.load(path, allow_pickle=False) as archive:
            for key in archive.files:
                index, _, name = key.partition("/")
                episodes.setdefault(int(index), {})[name] = archive[key]
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise UsageError(f"{path}: {error}") from None
    return episodes


def _fresh_folder(parent: Path, name: str) -> Path:
    """Make a new folder; a second one of the same second gets a number."""
    for attempt in range(1, 1000):
        path = parent / (name if attempt == 1 else f"{name}-{attempt}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        return path
    raise UsageError(f"{parent / name}: a thousand runs in one second")

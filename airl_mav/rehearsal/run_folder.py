"""Folder of a new or resumed run. A kill loses no saved episode.

docs/reference/run-folder.md describes every file. An episode is committed by its line in
`episodes.jsonl`, which is written last. Arrays without a line belong to an unfinished episode.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray
from pydantic import TypeAdapter

from airl_mav.arena.geometry import Arena
from airl_mav.core import files
from airl_mav.core.clock import WallClock, utc_now
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError, usage_errors
from airl_mav.core.files import PARTIAL_SUFFIX
from airl_mav.core.machine import check_code, describe_machine, git_state, package_versions
from airl_mav.core.plugins import GENERATORS, is_loaded, load_part
from airl_mav.flight.episode_record import NO_ARENA, EpisodeRecord, Setup
from airl_mav.flight.episode_record import SCHEMA as LINE_SCHEMA
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.arena import OBSTACLES, ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.model import SCENARIO_FILE, free_fields, save_scenario

if TYPE_CHECKING:
    from airl_mav.scenario.resolve import ResolvedScenario

SCHEMA = 1
"""Version of the folder's layout and of `run.json`."""

RUN_FILE = "run.json"
EPISODES_FILE = "episodes.jsonl"
LATENCY_FILE = "latency.npz"
TRAJECTORIES_FILE = "trajectories.npz"
FIRMWARE_PRINTS = "autopilot.log"
"""Output of real firmware that was started for the run."""
STAMPS_CRC, PATH_CRC = "latency_crc32", "trajectory_crc32"
"""Fields of a line: CRC of the episode's arrays in the two archives."""
LOG_FILES = ("firmware.log", "companion.log", FIRMWARE_PRINTS)
"""Log files of the processes; the first two are empty without problems."""

CAMPAIGN_FILE = "campaign.json"

FOLDER_KINDS = {
    RUN_FILE: "a single run",
    CAMPAIGN_FILE: "a campaign",
    "train.json": "a training",
    "hardware-gap.json": "a verdict",
}
"""Folder contents, by the first of these files in it."""

TICK_LATENESS = "tick_lateness_us"
"""Array name of the start delay of each tick in a paced run [µs]."""


@dataclass(frozen=True)
class RunInfo:
    """Contents of `run.json`."""

    name: str
    created_utc: str
    """Creation time, ISO 8601."""
    setup: Setup
    config: dict[str, Any]
    """Every setting of the run, as given."""
    seeds: tuple[int, ...]
    """Seed of each planned episode, by index."""
    versions: dict[str, str]
    """Package versions by name."""
    machine: dict[str, Any]
    git: dict[str, Any] | None
    """Commit of the checkout, and its changed flag; None for an installed wheel."""
    schema: int = SCHEMA


_INFO = TypeAdapter(RunInfo)


@dataclass(frozen=True)
class LoadedRun:
    """Run read from a folder. The mappings are by episode index and may lack episodes."""

    path: Path
    info: RunInfo
    episodes: tuple[EpisodeRecord, ...]
    latency: dict[int, files.Arrays]
    trajectories: dict[int, Trajectory]


@dataclass(frozen=True)
class FlownEpisode:
    """Finished episode."""

    record: EpisodeRecord
    trajectory: Trajectory
    """True path."""
    latency: Mapping[str, NDArray[Any]]
    """Raw stamps by column; see docs/reference/run-folder.md."""


class RunFolder:
    """Run folder open for writing."""

    def __init__(self, path: Path) -> None:
        """Wrap a folder; use `create` for a new run and `resume` for a killed run."""
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
        """Create the folder, by default `runs/<UTC time>-<name>`, and write `run.json`."""
        now = utc_now()
        if out is not None and (out / RUN_FILE).exists():
            raise UsageError(f"--out {out}: already holds a run; accepted: a new folder")
        path = out or _fresh_folder(Path("runs"), f"{now:%Y%m%dT%H%M%SZ}-{name}")
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
        return cls.adopt(path, info, "--out ")

    @classmethod
    def adopt(
        cls, path: Path, info: RunInfo, option: str = "", *, episodes: Sequence[FlownEpisode] = ()
    ) -> RunFolder:
        """Create the folder of a run from elsewhere. Raises UsageError, after the option's name."""
        with usage_errors(f"{option}{path}"):
            path.mkdir(parents=True, exist_ok=True)
        _write_info(path / RUN_FILE, info)
        folder = cls(path)
        if episodes:
            folder.save_episodes(episodes)
            folder.close()
        return folder

    @classmethod
    def resume(cls, path: Path) -> tuple[RunFolder, LoadedRun]:
        """Open a killed run, remove half-written data, and return its contents."""
        run = load(path)
        files.cut_torn_line(path / EPISODES_FILE)
        cls(path).close()
        return cls(path), run

    def plan_again(self, config: Mapping[str, Any], seeds: Sequence[int]) -> None:
        """Replace the settings and the planned seeds in `run.json`."""
        info = replace(load_info(self.path), config=dict(config), seeds=tuple(seeds))
        _write_info(self.path / RUN_FILE, info)

    def tlog_path(self, index: int) -> Path:
        """Return the path of an episode's raw MAVLink log; the vehicle's log is beside it."""
        return self.path / f"flight-{index:03d}.tlog"

    def forget(self, indices: Collection[int]) -> None:
        """Remove the lines and the arrays of episodes."""
        path = self.path / EPISODES_FILE
        kept = [
            line
            for line in path.read_bytes().splitlines(keepends=True)
            if json.loads(line)["index"] not in indices
        ]
        files.replace_file(path, b"".join(kept))
        self.close()

    def close(self) -> None:
        """Remove arrays without a line, and write the directories of the two archives."""
        lines = files.read_lines(self.path / EPISODES_FILE, LINE_SCHEMA)
        groups = {f"{line['index']:03d}" for _, line in lines}
        for name in (TRAJECTORIES_FILE, LATENCY_FILE):
            if os.path.lexists(self.path / name):
                files.close_archive(self.path / name, groups)

    def sweep(self) -> None:
        """Remove files of unfinished episodes, but keep the logs of a killed firmware."""
        for pattern in (".*.npz*", f"*{files.TEMPORARY_SUFFIX}"):
            for leftover in self.path.glob(pattern):
                files.remove(leftover)
        for log in self.path.glob(f"flight-*{PARTIAL_SUFFIX}"):
            log.rename(log.with_suffix(""))

    def discard(self) -> None:
        """Remove a run without flights, so that the same folder can be used again."""
        for name in (RUN_FILE, SCENARIO_FILE, *LOG_FILES):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):  # The folder contains other files.
            self.path.rmdir()

    def save_episodes(self, episodes: Sequence[FlownEpisode]) -> None:
        """Save episodes: the arrays, then the lines with their CRC, which commit them.

        `run.json` gets the title of real firmware, which is unknown before the first flight.
        """
        info, firmware = self.path / RUN_FILE, episodes[-1].record.firmware
        if firmware and (held := load_info(self.path)).setup.firmware != firmware:
            _write_info(info, replace(held, setup=replace(held.setup, firmware=firmware)))
        groups = {f"{episode.record.index:03d}": episode for episode in episodes}
        paths = {group: episode.trajectory.arrays() for group, episode in groups.items()}
        stamps = {group: episode.latency for group, episode in groups.items()}
        path_crcs = files.add_arrays(self.path / TRAJECTORIES_FILE, paths)
        stamp_crcs = files.add_arrays(self.path / LATENCY_FILE, stamps)
        lines = [
            {**episode.record.as_data(), PATH_CRC: path_crcs[group], STAMPS_CRC: stamp_crcs[group]}
            for group, episode in groups.items()
        ]
        files.append_lines(self.path / EPISODES_FILE, lines)


def check_folder(path: Path, wanted: str) -> None:
    """Raise UsageError if a folder contains something other than the file `wanted`."""
    for file, what in FOLDER_KINDS.items():
        if file == wanted and (path / file).exists():
            return
        if (path / file).exists():
            raise UsageError(f"--out {path}: holds {what}; accepted: another folder")


def open_folder(
    out: Path | None,
    name: str,
    scenario: ResolvedScenario,
    say: Callable[[str], None] = lambda _: None,
) -> tuple[RunFolder, tuple[EpisodeRecord, ...]]:
    """Open the folder of a new run, or of the same run, finished or not.

    A run whose seeds are the first of the requested seeds is the same run, and is extended. Removes
    invalid episodes, which the host disturbed, for a new flight. Returns the folder and its
    episodes. `say` gets a line about other code. Raises UsageError if the folder contains something
    else, another run, or flights of other code without `mixed_code`.
    """
    config, seeds = scenario.config, scenario.seeds
    if out is not None:
        check_folder(out, RUN_FILE)
    if out is None or not (out / RUN_FILE).exists():
        folder = RunFolder.create(out, name, config, setup=scenario.setup, seeds=seeds)
        save_scenario(scenario.scenario, folder.path / SCENARIO_FILE)
        return folder, ()
    held = load_info(out)
    grows = len(held.seeds) < len(seeds) and held.seeds == seeds[: len(held.seeds)]
    free = free_fields(scenario.scenario.level) | ({"episodes"} if grows else set())
    if difference := another_config(held.config, config, free):
        raise UsageError(
            f"--out {out}: holds a run with {difference}; accepted: a new folder, or the same "
            "settings to go on"
        )
    folder, run = RunFolder.resume(out)
    flown = [episode.code for episode in run.episodes]
    check_code(f"--out {out}", vars(held), flown, mixed=scenario.scenario.mixed_code, say=say)
    folder.sweep()
    if grows:
        folder.plan_again(config, seeds)
    if grows or not (out / SCENARIO_FILE).exists():
        # The file is missing if the process was killed while it wrote the first files.
        save_scenario(scenario.scenario, folder.path / SCENARIO_FILE)
    if disturbed := {episode.index for episode in run.episodes if episode.invalid}:
        folder.forget(disturbed)
    return folder, tuple(episode for episode in run.episodes if not episode.invalid)


def another_config(
    held: Mapping[str, Any], asked: Mapping[str, Any], free: Collection[str] = free_fields("gym")
) -> str | None:
    """Return the first setting, or table of settings, not in `free` that differs, or None."""
    old, new = _flat(held), _flat(json.loads(json.dumps(asked)))
    for key in sorted(old.keys() | new.keys()):
        known = key in free or key.partition(".")[0] in free
        if not known and old.get(key) != new.get(key):
            return f"{key} = {old.get(key)!r}, not {new.get(key)!r}"
    return None


def load_info(path: Path) -> RunInfo:
    """Read `run.json` alone. Raises UsageError."""
    return files.read_typed(path / RUN_FILE, _INFO, SCHEMA, "run")


def run_info(data: Mapping[str, Any], source: object) -> RunInfo:
    """Return the contents of `run.json` from an object. Raises UsageError, with the source."""
    return files.typed(_INFO, data, source)


def load(path: Path) -> LoadedRun:
    """Read a run folder, without a truncated last line. Raises UsageError."""
    info = load_info(path)
    records: dict[int, EpisodeRecord] = {}
    stamp_crcs, path_crcs = {}, {}
    for place, data in files.read_lines(path / EPISODES_FILE, LINE_SCHEMA):
        record = EpisodeRecord.from_data(data, place)
        # A later line replaces an earlier one. Lines of earlier versions have no CRC.
        records[record.index] = record
        stamp_crcs[record.index] = data.get(STAMPS_CRC)
        path_crcs[record.index] = data.get(PATH_CRC)
    latency = _load_arrays(path / LATENCY_FILE, stamp_crcs)
    paths = _load_arrays(path / TRAJECTORIES_FILE, path_crcs)
    try:
        trajectories = {i: Trajectory.from_arrays(arrays) for i, arrays in paths.items()}
    except (KeyError, ValueError) as error:
        raise UsageError(f"{path / TRAJECTORIES_FILE}: {error}") from None
    episodes = tuple(records[index] for index in sorted(records))
    return LoadedRun(path, info, episodes, latency, trajectories)


def info_data(info: RunInfo) -> dict[str, Any]:
    """Return the object of `run.json`; `run_info` reads it back."""
    data: dict[str, Any] = _INFO.dump_python(info, mode="json")
    return data


def _write_info(path: Path, info: RunInfo) -> None:
    """Write `run.json`."""
    files.write_json(path, info_data(info))


def _load_arrays(path: Path, crcs: Mapping[int, Any]) -> dict[int, files.Arrays]:
    """Return the arrays of the episodes with a line, by index. Raises UsageError if damaged."""
    groups = files.read_groups(path, {f"{index:03d}" for index in crcs})
    found = {}
    for index, crc in crcs.items():
        group = groups.get(f"{index:03d}", files.NO_ARRAYS)
        if crc is not None and group.crc32 != crc:
            raise UsageError(
                f"{path}: arrays of episode {index}: {files.CRC} = {group.crc32!r}: "
                f"accepted: {crc!r}, that of {EPISODES_FILE}"
            )
        if group.arrays:
            found[index] = group.arrays
    return found


def _fresh_folder(parent: Path, name: str) -> Path:
    """Create a new folder; a second one in the same second gets a number."""
    for attempt in range(1, 1000):
        path = parent / (name if attempt == 1 else f"{name}-{attempt}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        return path
    raise UsageError(f"{parent / name}: a thousand runs in one second")


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the settings by their dotted names."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat |= _flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


WAIT_S = 20.0
"""Maximum wait for the processes of a killed run to end [wall s]."""

POLL_S = 0.05
"""Time between two attempts to take the lock [wall s]."""


@contextmanager
def locked(path: Path, say: Callable[[str], None]) -> Iterator[int]:
    """Create a folder if needed, and lock it for this process and processes that inherit the lock.

    The lock ends with the last process that has the yielded descriptor. Waits for the processes of
    a killed run, which hold its ports and may still write.
    """
    with usage_errors(f"--out {path}"):
        path.mkdir(parents=True, exist_ok=True)
        # Locks the folder: a lock file would need cleanup.
        descriptor = os.open(path, os.O_RDONLY)
    try:
        _acquire(descriptor, path, say)
        yield descriptor
    finally:
        os.close(descriptor)


def _acquire(descriptor: int, path: Path, say: Callable[[str], None]) -> None:
    if files.try_lock(descriptor):
        return
    say(f"{path}: waiting for the processes of an earlier run to end")
    clock = WallClock()
    while not files.try_lock(descriptor):
        now_us = clock.time_us()
        if now_us > WAIT_S * US_PER_S:
            raise UsageError(f"--out {path}: another run flies into it; accepted: a new folder")
        clock.sleep_until(now_us + int(POLL_S * US_PER_S))


MOTOR_TIMES, MOTOR_OUTPUTS = "motors/time_us", "motors/output"
"""Columns from the vehicle's log: times (n,) [µs] and outputs (n, 4), 0 to 1, in PX4's order."""


def vehicle_of(info: RunInfo) -> VehicleProfile:
    """Return the vehicle of a run with its changes; raise UsageError if its profile is missing."""
    vehicle = load_profile("vehicles", info.setup.vehicle.name, VehicleProfile)
    change = info.config.get("environment", {}).get("camera", {})
    given = {name: value for name, value in change.items() if value is not None}
    camera = vehicle.camera.model_copy(update=given)
    body = vehicle.body.model_copy(update=info.config.get("vehicle_body", {}))
    return vehicle.model_copy(update={"camera": camera, "body": body})


def check_trust(arena: str, spec: ArenaSpec) -> None:
    """Raise UsageError for an arena with a custom generator that this process did not load.

    A run folder from an untrusted source must not select the code to run.
    """
    if spec.generator != OBSTACLES and not is_loaded(GENERATORS, spec.generator):
        raise UsageError(
            f"arena {arena}: its generator {spec.generator!r} is code that would run on this "
            "machine; accepted: with --trust, if you trust its maker"
        )


def spec_of(arena: str) -> ArenaSpec:
    """Return an arena's profile; raise UsageError if it is missing or its generator untrusted."""
    spec = load_profile("arenas", arena, ArenaSpec)
    check_trust(arena, spec)
    return spec


def trust_arenas(run: LoadedRun) -> None:
    """Load the custom generators of a run's arenas. Raises UsageError."""
    for arena in {record.arena for record in run.episodes} - {NO_ARENA}:
        spec = load_profile("arenas", arena, ArenaSpec)
        if spec.generator != OBSTACLES:
            load_part(GENERATORS, spec.generator)


def arenas_of(records: Iterable[EpisodeRecord], vehicle: VehicleProfile) -> dict[int, Arena]:
    """Generate the arenas of flights, by episode index. Raises UsageError."""
    # Imported here: serving a page or rejecting an invalid run must not wait for numba.
    from airl_mav.arena.generate import generate
    from airl_mav.arena.tours import set_out_later

    specs: dict[str, ArenaSpec] = {}
    arenas: dict[int, Arena] = {}
    for record in records:
        if record.arena == NO_ARENA:
            continue
        if record.arena not in specs:
            specs[record.arena] = spec_of(record.arena)
        if record.index not in arenas:
            arena = generate(
                specs[record.arena],
                record.arena_seed,
                name=record.arena,
                vehicle_width_m=vehicle.body.width_m,
                zone=record.zone,
            )
            arenas[record.index] = set_out_later(arena, record.tours_s)
    return arenas


def arena_of(run: LoadedRun, episode: EpisodeRecord) -> Arena | None:
    """Generate the arena of a flight; None if a profile is missing."""
    try:
        return arenas_of([episode], vehicle_of(run.info)).get(episode.index)
    except UsageError:
        return None


def flown_path(run: LoadedRun, record: EpisodeRecord) -> Trajectory | None:
    """Return a flight's path up to the verdict, without the landing recorded after it."""
    path = run.trajectories.get(record.index)
    if path is None or not len(path):
        return None
    return path.between(int(path.time_us[0]), record.ended_us)

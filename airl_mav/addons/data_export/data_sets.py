"""Minari and LeRobot data sets of a run: states, goals and setpoints at a fixed rate."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import pandas
import pyarrow
import pyarrow.parquet
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.core.files import replace_file, replacing
from airl_mav.flight.judge import Outcome
from airl_mav.latency.stamps import setpoint_column
from airl_mav.rehearsal.run_folder import LoadedRun

STATE_NAMES = (
    *("north_m", "east_m", "down_m", "vel_north_m_s", "vel_east_m_s", "vel_down_m_s"),
    *("qw", "qx", "qy", "qz", "goal_north_m", "goal_east_m"),
)
ACTION_NAMES = ("setpoint_0", "setpoint_1", "setpoint_2", "setpoint_3")

LEROBOT_VERSION = "v3.0"
"""Version of the LeRobot data set format; read by LeRobot from 0.4 on."""

LEROBOT_FILE = "chunk-000/file-000.parquet"
TASK = "fly to the goal"


@dataclass(frozen=True)
class SampledEpisode:
    """Episode at a fixed rate, from the first setpoint to the verdict."""

    states: NDArray[np.float32]  # (n + 1, 12), as STATE_NAMES
    actions: NDArray[np.float32]  # (n, 4) setpoint in effect at each state
    outcome: Outcome
    seed: int


def sampled(run: LoadedRun, rate_hz: float) -> Iterator[SampledEpisode]:
    """Yield the episodes with decisions and a trajectory."""
    for record in run.episodes:
        path, stamps = run.trajectories.get(record.index), run.latency.get(record.index)
        name = None if stamps is None else setpoint_column(stamps)
        if path is None or stamps is None or name is None or not len(stamps["sent_us"]):
            continue
        sent = stamps["sent_us"]
        times = np.arange(sent[0], record.ended_us, round(US_PER_S / rate_hz))
        if len(times) < 2:
            continue
        at = path.at(times)
        goal = np.tile(record.goal[:2], (len(times), 1))
        states = np.hstack([at.position, at.velocity, at.quaternion, goal]).astype(np.float32)
        newest = np.searchsorted(sent, times[:-1], side="right") - 1
        actions = stamps[name][newest].astype(np.float32)
        yield SampledEpisode(states, actions, record.outcome, record.seed)


def write_minari(run: LoadedRun, rate_hz: float, out: Path) -> int:
    """Write a Minari data set; return the number of episodes.

    The reward is 1 for the step that reaches the goal. The data set is named FOLDER-v0;
    `MINARI_DATASETS_PATH` is the parent folder.
    """
    buffers = []
    for number, episode in enumerate(sampled(run, rate_hz)):
        n = len(episode.actions)
        last = np.arange(n) == n - 1
        reached = episode.outcome is Outcome.SUCCESS
        buffers.append(
            EpisodeBuffer(
                id=number,
                seed=episode.seed,
                observations=list(episode.states),
                actions=list(episode.actions),
                rewards=list((last * float(reached)).astype(float)),
                terminations=[bool(end and episode.outcome is not Outcome.TIMEOUT) for end in last],
                truncations=[bool(end and episode.outcome is Outcome.TIMEOUT) for end in last],
            )
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    os.environ["MINARI_DATASETS_PATH"] = str(out.parent.resolve())
    with warnings.catch_warnings():
        # Minari warns about every optional fact that is missing, such as a reference score.
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(
            dataset_id=f"{out.name}-v0",
            buffer=buffers,
            observation_space=gymnasium.spaces.Box(
                -np.inf, np.inf, (len(STATE_NAMES),), np.float32
            ),
            action_space=gymnasium.spaces.Box(-np.inf, np.inf, (len(ACTION_NAMES),), np.float32),
            algorithm_name=run.info.setup.policy.name,
            code_permalink="https://github.com/airl-mav/airl-mav",
            description=f"Flights of {run.path.name}, exported by airl-mav",
        )
    return len(buffers)


def write_lerobot(run: LoadedRun, rate_hz: float, out: Path) -> int:
    """Write a LeRobot data set of version 3.0; return the number of episodes."""
    frames: dict[str, list[Any]] = {name: [] for name in ("observation.state", "action", *_INDICES)}
    episodes: list[dict[str, Any]] = []
    for number, episode in enumerate(sampled(run, rate_hz)):
        n, first = len(episode.actions), len(frames["index"])
        frames["observation.state"] += list(episode.states[:-1])
        frames["action"] += list(episode.actions)
        frames["timestamp"] += [np.float32(i / rate_hz) for i in range(n)]
        frames["frame_index"] += range(n)
        frames["episode_index"] += [number] * n
        frames["index"] += range(first, first + n)
        frames["task_index"] += [0] * n
        episodes.append(
            {
                "episode_index": number,
                "tasks": [TASK],
                "length": n,
                "dataset_from_index": first,
                "dataset_to_index": first + n,
                **{f"{part}/{name}_index": 0 for part in _PARTS for name in ("chunk", "file")},
            }
        )
    _write(pyarrow.table(frames), out / "data" / LEROBOT_FILE)
    _write(pyarrow.Table.from_pylist(episodes), out / "meta/episodes" / LEROBOT_FILE)
    # LeRobot reads the tasks as the index of a pandas table.
    tasks = pandas.DataFrame({"task_index": [0]}, index=[TASK])
    _write(pyarrow.Table.from_pandas(tasks), out / "meta/tasks.parquet")
    for name, data in (("info", _info(rate_hz, frames, episodes)), ("stats", _stats(frames))):
        replace_file(out / f"meta/{name}.json", json.dumps(data, indent=4).encode())
    return len(episodes)


_INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
_PARTS = ("data", "meta/episodes")


def _write(table: pyarrow.Table, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        pyarrow.parquet.write_table(table, partial)


def _info(
    rate_hz: float, frames: dict[str, list[Any]], episodes: list[dict[str, Any]]
) -> dict[str, Any]:
    def feature(dtype: str, names: tuple[str, ...] | None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [len(names or "1")], "names": names and list(names)}

    integers = {name: feature("int64", None) for name in _INDICES[1:]}
    return {
        "codebase_version": LEROBOT_VERSION,
        "robot_type": "quadcopter",
        "total_episodes": len(episodes),
        "total_frames": len(frames["index"]),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": round(rate_hz),
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {
            "observation.state": feature("float32", STATE_NAMES),
            "action": feature("float32", ACTION_NAMES),
            "timestamp": feature("float32", None),
            **integers,
        },
    }


def _stats(frames: dict[str, list[Any]]) -> dict[str, Any]:
    stats = {}
    for name, rows in frames.items():
        values = np.array(rows, float).reshape(len(rows), -1)
        stats[name] = {
            "min": values.min(axis=0).tolist(),
            "max": values.max(axis=0).tolist(),
            "mean": values.mean(axis=0).tolist(),
            "std": values.std(axis=0).tolist(),
            "count": [len(rows)],
        }
    return stats

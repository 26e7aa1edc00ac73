"""Tables of a run as columns: episodes, decisions, latency, trajectories."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_MS
from airl_mav.latency.stages import SHOWN_STAGES, stage_durations, stage_samples, summarize
from airl_mav.latency.stamps import NO_STAMP, STAMPS, setpoint_column
from airl_mav.rehearsal.run_folder import LoadedRun

Columns = dict[str, Sequence[Any] | NDArray[Any]]
"""Equally long columns by name; `pandas.DataFrame(columns)` reads them."""

TableName = Literal["episodes", "decisions", "latency", "trajectories"]

ARRIVALS = ("accepted_us", "motor_us")
"""Stamps of the flight controller."""

STATE = ("north_m", "east_m", "down_m", "vel_north_m_s", "vel_east_m_s", "vel_down_m_s")


def episode_columns(run: LoadedRun) -> Columns:
    """Return one row per episode: the fields of episodes.jsonl, nested names joined by dots."""
    rows = [_flat(record.as_data()) for record in run.episodes]
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def _flat(data: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    row: dict[str, Any] = {}
    for name, value in data.items():
        if isinstance(value, Mapping):
            row |= _flat(value, f"{path}{name}.")
        else:
            # A cell is a number or a text.
            nested = isinstance(value, (list, tuple))
            row[path + name] = json.dumps(value) if nested else value
    return row


def decision_columns(run: LoadedRun) -> Columns:
    """Return one row per decision: stamps, stages [ms], setpoint, true state when it was sent.

    Missing times are -1, missing durations NaN.
    """
    parts = []
    for index, stamps in run.latency.items():
        n = len(stamps["sent_us"])
        part: dict[str, NDArray[Any]] = {
            "episode": np.full(n, index),
            "decision": np.arange(n),
            **{name: stamps.get(name, np.full(n, NO_STAMP)) for name in (*STAMPS, *ARRIVALS)},
        }
        for key, (rows, durations) in stage_durations(stamps).items():
            part[f"{key}_ms"] = np.full(n, np.nan)
            part[f"{key}_ms"][rows] = durations / US_PER_MS
        name = setpoint_column(stamps)
        setpoints = np.full((n, 4), np.nan) if name is None else stamps[name]
        part |= {f"setpoint_{i}": setpoints[:, i] for i in range(4)}
        states, sent = np.full((n, len(STATE)), np.nan), stamps["sent_us"] != NO_STAMP
        if index in run.trajectories and sent.any():
            path = run.trajectories[index].at(stamps["sent_us"][sent])
            states[sent] = np.hstack([path.position, path.velocity])
        part |= dict(zip(STATE, states.T, strict=True))
        parts.append(part)
    return _joined(parts)


def latency_columns(run: LoadedRun) -> Columns:
    """Return one row per episode and stage: number of decisions, mean and percentiles [ms]."""
    rows = [
        (index, stage.key, summarize(samples[stage.key]))
        for index, stamps in run.latency.items()
        for samples in [stage_samples(stamps)]
        for stage in SHOWN_STAGES
    ]
    columns: Columns = {
        "episode": [index for index, _, _ in rows],
        "stage": [key for _, key, _ in rows],
        "n": [summary.n for _, _, summary in rows],
    }
    for name in ("mean", "p50", "p90", "p99", "max"):
        values = [getattr(summary, name) for _, _, summary in rows]
        columns[f"{name}_ms"] = [None if v is None else v / US_PER_MS for v in values]
    return columns


def trajectory_columns(run: LoadedRun) -> Columns:
    """Return one row per sample of the true paths: time, NED state, attitude, power."""
    parts = []
    for index, path in run.trajectories.items():
        part = {"episode": np.full(len(path), index), "time_us": path.time_us}
        part |= dict(zip(STATE, np.hstack([path.position, path.velocity]).T, strict=True))
        part |= dict(zip(("qw", "qx", "qy", "qz"), path.quaternion.T, strict=True))
        parts.append(part | {"power_w": path.power_w})
    return _joined(parts)


def _joined(parts: Sequence[Mapping[str, NDArray[Any]]]) -> Columns:
    names = parts[0] if parts else ()
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


TABLES: dict[TableName, Callable[[LoadedRun], Columns]] = {
    "episodes": episode_columns,
    "decisions": decision_columns,
    "latency": latency_columns,
    "trajectories": trajectory_columns,
}
"""Functions that return the tables, by name."""

"""The stages of a decision: which two stamps each one lies between."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.latency.stamps import NO_STAMP

Samples = NDArray[np.int64]


@dataclass(frozen=True)
class Stage:
    """One measured interval."""

    key: str
    title: str
    start: str
    """Stamp at which it begins."""
    end: str
    """Stamp at which it ends."""
    meaning: str


STAGES = (
    Stage("t1", "t1 fetch", "capture_us", "decoded_us", "frame exposed → decoded on the companion"),
    Stage("wait", "wait", "decoded_us", "infer_start_us", "frame decoded → inference starts"),
    Stage("t2", "t2 infer", "infer_start_us", "action_ready_us", "inference starts → action ready"),
    Stage("send", "send", "action_ready_us", "sent_us", "action ready → handed to MAVSDK"),
    Stage("link", "link", "sent_us", "accepted_us", "handed to MAVSDK → accepted by the autopilot"),
    Stage("control", "control", "accepted_us", "motor_us", "accepted → motors reflect it"),
    Stage(
        "end_to_end", "end to end", "capture_us", "motor_us", "frame exposed → motors reflect it"
    ),
    Stage("t3", "t3 hold", "sent_us", "held_until_us", "action applied → next observation"),
)
"""t1 to control follow each other and add up to end to end."""

PERIOD = Stage("period", "decision period", "sent_us", "sent_us", "from one action to the next")

SETPOINT_TO_MOTOR = Stage(
    "setpoint_to_motor", "setpoint → motor", "sent_us", "motor_us", "link and control together"
)
"""What the flight side alone takes: the real-time figure."""

ALL_STAGES = (*STAGES, SETPOINT_TO_MOTOR, PERIOD)

SHOWN_STAGES = (*STAGES, PERIOD)
"""The rows of a latency table."""


def stage_durations(
    stamps: Mapping[str, NDArray[Any]],
) -> dict[str, tuple[NDArray[np.int64], Samples]]:
    """Return the stages of an episode's decisions, by the stage's key.

    Stamps are the decision log's columns plus `accepted_us` and `motor_us`, each (n,) [µs]. Of each
    stage two arrays (k,): the decisions that have it, and its durations [µs]. A stage lacks the
    decisions where one of its two stamps is `NO_STAMP`, and is empty where a whole column is
    missing. A decision period belongs to the decision that ends it.
    """
    nothing: Samples = np.zeros(0, np.int64)
    found = {}
    for stage in (*STAGES, SETPOINT_TO_MOTOR):
        start, end = (stamps.get(name) for name in (stage.start, stage.end))
        if start is None or end is None:
            found[stage.key] = nothing, nothing
            continue
        there = np.flatnonzero((start != NO_STAMP) & (end != NO_STAMP))
        found[stage.key] = there, (end - start)[there].astype(np.int64)
    sent = stamps.get("sent_us", nothing)
    there = np.flatnonzero(sent != NO_STAMP)
    found[PERIOD.key] = there[1:], np.diff(sent[there]).astype(np.int64)
    return found


def stage_samples(stamps: Mapping[str, NDArray[Any]]) -> dict[str, Samples]:
    """Return the durations [µs] of each stage in one episode; see `stage_durations`."""
    return {key: durations for key, (_, durations) in stage_durations(stamps).items()}


def pool(episodes: Iterable[Mapping[str, Samples]]) -> dict[str, Samples]:
    """Join the samples of several episodes, stage by stage."""
    parts = list(episodes)
    return {
        stage.key: np.concatenate(
            [part[stage.key] for part in parts] or [np.zeros(0, np.int64)], dtype=np.int64
        )
        for stage in ALL_STAGES
    }

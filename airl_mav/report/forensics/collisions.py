"""What led to a collision: the last frame that still moved the motors, and what lay ahead in it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import US_PER_S
from airl_mav.flight.judge import Outcome
from airl_mav.flight.quality import measure_leg
from airl_mav.flight.trajectory import pose_at
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.report.forensics.camera_view import (
    ObstacleView,
    bearing,
    passes_through,
    view_obstacle,
    view_wall,
)
from airl_mav.report.forensics.evidence import Evidence

LOOK_BACK = 5
"""Decisions before the collision whose frames are looked at."""

SEEN_SHARE = 0.002
"""An obstacle on a smaller part of the picture counts as not seen: 6 pixels of 64 x 48."""

_THING = re.compile(r"hit (?:(?:static|moving)-)?([a-z]+(?:-[a-z]+)*(?:[- ](\d+))?)")


@dataclass(frozen=True)
class Collision:
    """A collision, taken apart."""

    what: str
    """As the plant calls it: `static-box-3`, `wall`, `floor`."""
    speed_m_s: float
    """At the collision."""
    off_heading_rad: float
    """Direction of flight at the collision, from the heading, positive to the right."""
    before_s: float | None
    """Exposure of the last frame that still moved the motors, before the collision [s]; None when
    no decision ever did."""
    blind_m: float | None
    """Way flown since then."""
    lag_s: float | None
    """Of it: until the motors answered to that frame."""
    lag_m: float | None
    """Way flown meanwhile."""
    answer_m_s: float | None
    """Speed at which the motors answered."""
    view: ObstacleView | None
    """Where the spot that was hit lay on that frame; None where arena or camera is not known."""
    glass: bool
    """It is of glass, and the camera measured through it."""
    seen: tuple[bool, ...]
    """Whether the obstacle was in the picture in each of the last frames decided on, old to new."""


def decisions_in_effect(stamps: Mapping[str, NDArray[Any]], ended_us: int) -> NDArray[np.int64]:
    """Return the numbers of the decisions that moved the motors before a time [µs].

    Where nothing says when the motors answered, a decision acts when it is sent.
    """
    if "sent_us" not in stamps or "capture_us" not in stamps:
        return np.zeros(0, np.int64)
    acts = stamps["sent_us"]
    motor = stamps.get("motor_us")
    if motor is not None and np.any(motor != NO_STAMP):
        acts = motor
    flown = (acts != NO_STAMP) & (acts <= ended_us) & (stamps["capture_us"] != NO_STAMP)
    return np.flatnonzero(flown).astype(np.int64)


def hit_number(reason: str, arena: Arena | None) -> int | None:
    """Return the number of the obstacle that a verdict names; None for walls, floor, unknown."""
    found = _THING.match(reason)
    if found is None or found[2] is None or arena is None:
        return None
    number = int(found[2])
    return number if number < len(arena.obstacles) else None


def examine_collision(flight: Evidence) -> Collision | None:
    """Take a collision apart; None for a flight that hit nothing, or that has no recording."""
    record, path, stamps, arena = flight.record, flight.path, flight.stamps, flight.arena
    if record.outcome is not Outcome.COLLISION or not len(path):
        return None
    hit_us = record.ended_us
    _, velocity, quaternion = pose_at(path, hit_us)
    number = hit_number(record.reason, arena)
    before_s = blind_m = lag_s = lag_m = answer_m_s = view = None
    seen: tuple[bool, ...] = ()
    glass = False
    decisions = decisions_in_effect(stamps, hit_us)
    if decisions.size:
        frames = stamps["capture_us"][decisions[-LOOK_BACK:]]
        frame_us = int(frames[-1])
        before_s, blind_m = (
            (hit_us - frame_us) / US_PER_S,
            measure_leg(path, frame_us, hit_us).distance_m,
        )
        motor_us = int(stamps.get("motor_us", stamps["sent_us"])[decisions[-1]])
        if motor_us != NO_STAMP:
            lag_s, lag_m = (
                (motor_us - frame_us) / US_PER_S,
                measure_leg(path, frame_us, motor_us).distance_m,
            )
            answer_m_s = float(np.linalg.norm(pose_at(path, motor_us)[1]))
        if arena is not None and flight.camera is not None:
            if number is not None:
                began_us, camera = record.started_us, flight.camera
                views = [
                    view_obstacle(path, int(frame), hit_us, arena, began_us, number, camera)
                    for frame in frames
                ]
                view = views[-1]
                glass = passes_through(arena, number, camera)
                seen = tuple((v.share or 0.0) >= SEEN_SHARE for v in views)
            elif "wall" in record.reason:
                view = view_wall(path, frame_us, hit_us, arena)
    return Collision(
        what=record.reason.removeprefix("hit ").removesuffix(" during the take-off"),
        speed_m_s=float(np.linalg.norm(velocity)),
        off_heading_rad=bearing(quaternion, velocity) if math.hypot(*velocity[:2]) > 0.2 else 0.0,
        before_s=before_s,
        blind_m=blind_m,
        lag_s=lag_s,
        lag_m=lag_m,
        answer_m_s=answer_m_s,
        view=view,
        glass=glass,
        seen=seen,
    )

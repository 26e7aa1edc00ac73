"""Flights and their arenas in three dimensions, as data for the page's own view of them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.draw import GOAL_COLOUR, MOVING_COLOURS, START_COLOUR
from airl_mav.arena.geometry import Arena, Shape
from airl_mav.core.constants import US_PER_S
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.run_figures import OUTCOME_COLOURS, speed_colours
from airl_mav.report.table import OUTCOME_LABELS
from airl_mav.report.theme import DARK

POINTS = 240
"""A path has at most this many points: one a tenth of a second, or what is seen of more."""

ALL_POINTS = 40
"""The same where all flights are shown together."""

ALL_FLIGHTS = 150
"""At most so many flights are shown together: those that failed first."""


@dataclass(frozen=True)
class SceneFlight:
    """One flight in the view."""

    record: EpisodeRecord
    path: Trajectory
    """Up to the verdict, two samples or more."""
    arena: Arena | None


def scene_json(
    run: LoadedRun,
    flights: Sequence[SceneFlight],
    everyone: Sequence[EpisodeRecord],
    fov_deg: float,
) -> str:
    """Return everything that the view shows, as JSON that may stand inside a script element.

    Frame: east, north, up [m] from the start. Lengths are rounded to a centimetre.

    Args:
        run: The run, for the paths of `everyone`.
        flights: Those that can be looked at one by one, in the order of the list.
        everyone: Those that are shown together.
        fov_deg: Horizontal field of view of the camera [deg]; 0 draws none.
    """
    arenas: dict[tuple[str, int], int] = {}
    described: list[dict[str, Any]] = []
    for flight in flights:
        key = flight.record.arena, flight.record.arena_seed
        if flight.arena is not None and key not in arenas:
            arenas[key] = len(described)
            described.append(describe_arena(flight.arena))
    top = max((float(flight.path.speed().max()) for flight in flights), default=1.0)
    data = {
        "topSpeed": round(top, 2),
        "fov": fov_deg,
        "speedColours": [_hex(speed_colours()(i / 15.0)) for i in range(16)],
        "colours": {
            "start": _both(START_COLOUR),
            "goal": _both(GOAL_COLOUR),
            "still": ["#93a0ac", "#7f8a95"],
            "moving": _both(MOVING_COLOURS[0]),
        },
        "outcomes": {
            outcome.value: {"words": OUTCOME_LABELS[outcome], "colour": _both(colour)}
            for outcome, colour in OUTCOME_COLOURS.items()
        },
        "arenas": described,
        "flights": [
            {
                **describe_flight(flight.record, flight.path, POINTS),
                "arena": arenas.get((flight.record.arena, flight.record.arena_seed)),
            }
            for flight in flights
        ],
        "all": [
            describe_flight(record, path, ALL_POINTS)
            for record in everyone
            if (path := _flown(run.trajectories, record)) is not None
        ],
        # All flights around the common start share an arena, or only its walls.
        "shared": len({(e.arena, e.arena_seed) for e in run.episodes}) == 1,
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def _flown(paths: Mapping[int, Trajectory], record: EpisodeRecord) -> Trajectory | None:
    """Return a flight's path up to the verdict, None when there is none to draw."""
    path = paths.get(record.index)
    if path is None or not len(path):
        return None
    part = path.between(int(path.time_us[0]), record.ended_us)
    return part if len(part) > 1 else None


def describe_flight(record: EpisodeRecord, path: Trajectory, points: int) -> dict[str, Any]:
    """Return a flight for the view.

    Args:
        record: The flight.
        path: Up to the verdict, two samples or more.
        points: At most so many are kept, evenly in time, first and last included.
    """
    keep = np.unique(np.linspace(0, len(path) - 1, min(len(path), points)).round().astype(int))
    position, attitude = path.position[keep], path.quaternion[keep]
    w, x, y, z = attitude.T
    heading = np.degrees(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    began_us = record.started_us
    since_us = 0 if record.navigation_us is None else record.navigation_us - began_us
    return {
        "index": record.index,
        "outcome": record.outcome.value,
        "goal": [round(record.goal[1], 2), round(record.goal[0], 2)],
        "radius": record.goal_radius_m,
        "navigation": round(since_us / US_PER_S, 2),
        "time": _list((path.time_us[keep] - began_us) / US_PER_S),
        "place": _list((position[:, [1, 0, 2]] * [1.0, 1.0, -1.0]).ravel()),
        "speed": _list(path.speed()[keep]),
        "heading": [round(angle) for angle in heading.tolist()],
    }


def describe_arena(arena: Arena) -> dict[str, Any]:
    """Return an arena for the view; of moving obstacles the last ones, each with its tour."""
    b, o = arena.bounds, arena.obstacles
    return {
        "bounds": [b.east_min, b.east_max, b.north_min, b.north_max, b.height],
        "wall": [round(channel / 255.0, 3) for channel in arena.wall_colour],
        "obstacles": [
            {
                "shape": Shape(int(o.shape[i])).name.lower(),
                "center": _list(o.center[i][[1, 0, 2]] * [1.0, 1.0, -1.0]),
                "half": _list(o.half_size[i]),
                "yaw": round(math.degrees(float(o.yaw[i])), 1),
            }
            for i in range(len(o))
        ],
        "tours": [
            {"time": _list(tour.times_s), "place": _list(tour.points[:, [1, 0]].ravel())}
            for tour in arena.tours
        ],
    }


def _list(values: NDArray[np.float64]) -> list[float]:
    """Return numbers to a hundredth; whole ones as integers, which are shorter."""
    rounded = np.round(values, 2) + 0.0
    return [int(value) if value.is_integer() else value for value in rounded.tolist()]


def _both(colour: str) -> list[str]:
    """Return a colour for light and for dark paper."""
    return [colour, DARK.get(colour, _DARK_OUTCOMES.get(colour, colour))]


_DARK_OUTCOMES = {
    OUTCOME_COLOURS[Outcome.SUCCESS]: "#45b36b",
    OUTCOME_COLOURS[Outcome.COLLISION]: "#f0695c",
    OUTCOME_COLOURS[Outcome.TIMEOUT]: "#e2ab55",
    OUTCOME_COLOURS[Outcome.BATTERY]: "#c79be6",
    OUTCOME_COLOURS[Outcome.ABORTED]: "#9aa3ad",
}


def _hex(colour: tuple[float, float, float, float]) -> str:
    """Return "#rrggbb"."""
    return "#" + "".join(f"{round(255.0 * channel):02x}" for channel in colour[:3])

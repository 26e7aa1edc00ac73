"""What the page's script shows of a flight: its motion, its decisions and what the policy saw."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import rgb_of
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.files import Arrays
from airl_mav.latency.stages import STAGES, decision_series
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.report.depth_colours import shades
from airl_mav.report.policy_view import PolicyAgain, SeenDecision
from airl_mav.report.tracking import EstimateErrors, Motion, TrackedFlight


class Steps(TypedDict):
    """A line of numbers as whole steps from one to the next, which compress well."""

    unit: float
    """What a step of 1 is."""
    steps: list[int]
    """From 0 to the first number, from each to the next."""


LEVEL = 7
"""Of gzip, 1 to 9: 9 takes three times as long for a page's data, and saves a hundredth of it."""


def packed(text: str) -> str:
    """Return a text as base64 of gzip. The same text gives the same bytes."""
    return base64.b64encode(gzip.compress(text.encode(), compresslevel=LEVEL, mtime=0)).decode()


def steps_of(values: NDArray[np.float64] | Sequence[float], unit: float) -> Steps:
    """Return numbers (n,), all finite, as steps of a unit: each is kept to half a unit."""
    whole = np.round(np.asarray(values, np.float64) / unit).astype(np.int64)
    return {"unit": unit, "steps": np.diff(whole, prepend=0).tolist()}


TIME_POINTS = 1000
"""A line has at most this many points: 20 s at the recorded rate, or what is seen of more."""

UNITS = {"_m_s": 0.01, "_m": 0.01, "_deg": 0.1, "_deg_s": 0.1, "thrust": 0.001}
"""Numbers are kept to half of this, by the unit that a name ends with."""

IMAGES = 24
"""Decisions of a flight with an image: all, or the first, the last and some between."""

LAST = 8
"""Of them, so many are the last: they led to the end."""

BEST = 5
"""So many of a decision's scores are shown, the best first."""


def chosen(count: int, most: int = IMAGES, last: int = LAST) -> list[int]:
    """Return which of so many decisions are shown, increasing: `most` of them at most."""
    if count <= most:
        return list(range(count))
    before = np.linspace(0, count - last - 1, most - last).round().astype(int)
    return [*np.unique(before).tolist(), *range(count - last, count)]


def flight_data(
    flight: TrackedFlight,
    stamps: Arrays,
    seen: Sequence[SeenDecision],
    range_m: float,
    again: PolicyAgain | None,
) -> dict[str, Any]:
    """Return one flight as plain data, with depth up to `range_m` and the policy's scores."""
    count = len(flight.time_s)
    keep = np.unique(np.linspace(0, count - 1, min(count, TIME_POINTS)).round().astype(int))
    commands = flight.commands
    return {
        "time": steps_of(flight.time_s[keep], 0.001),
        "flown": _lines(flight.flown, keep),
        "estimated": None if flight.estimated is None else _lines(flight.estimated, keep),
        "errors": None if flight.errors is None else _lines(flight.errors, keep),
        "power": None if flight.power_w is None else steps_of(flight.power_w[keep], 1.0),
        "motors": None
        if flight.motors is None
        else [steps_of(column, 0.002) for column in flight.motors[keep].T],
        "altitude": flight.altitude_m,
        "commands": {
            "sent": steps_of(commands.sent_s, 0.001),
            **{name: steps_of(values, _unit(name)) for name, values in commands.values.items()},
        },
        "stages": _stages(stamps),
        "seen": [_seen(seen[k], range_m, again) for k in chosen(len(seen))],
    }


def _lines(of: Motion | EstimateErrors, keep: NDArray[np.int64]) -> dict[str, Steps]:
    known = {name: values for name, values in vars(of).items() if values is not None}
    return {name: steps_of(values[keep], _unit(name)) for name, values in known.items()}


def _unit(name: str) -> float:
    ends = [end for end in UNITS if name.endswith(end)]
    return UNITS[max(ends, key=len)]


def _stages(stamps: Arrays) -> dict[str, list[float | None]]:
    """Return what each decision that was sent took, stage by stage [ms]; None: not known."""
    series = decision_series(stamps)
    sent = np.asarray(stamps.get("sent_us", np.zeros(0, np.int64)))
    there = sent != NO_STAMP
    found = {}
    for stage in STAGES:
        values = series.get(stage.key)
        if values is None or len(values) != len(sent) or (values[there] == NO_STAMP).all():
            continue
        found[stage.key] = [
            None if us == NO_STAMP else round(float(us) / US_PER_MS, 2) for us in values[there]
        ]
    return found


def _seen(decision: SeenDecision, range_m: float, again: PolicyAgain | None) -> Mapping[str, Any]:
    """Return one decision: its image as base64 of bytes, and its best actions."""
    seen = decision.image
    height, width = seen.shape[:2]
    # A byte of the palette a pixel of depth, three of colour.
    pixels = rgb_of(seen) if seen.ndim == 3 else shades(seen, range_m)
    image = base64.b64encode(pixels.tobytes()).decode()
    told: dict[str, Any] = {"number": decision.number, "size": [width, height], "image": image}
    if decision.scores is not None and again is not None:
        best = np.argsort(-decision.scores, kind="stable")[:BEST]
        told["best"] = [
            [round(float(decision.scores[k]), 3), *np.round(again.actions[k], 3).tolist()]
            for k in best
        ]
        told["again"] = decision.again
    return told

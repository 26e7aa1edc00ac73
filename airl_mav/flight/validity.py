"""Was a flight a test of the policy, or of a host that could not keep up with it?

Flights that live by the wall clock share a machine with everything else that runs there. Where it
was too busy, or somebody else commanded the vehicle, what was flown says nothing of the policy. It
is flown again, and never counted in silence. The rules are one table, of shares and simulated time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.latency.stamps import NO_STAMP

BY_HAND = "latency or compensation was changed by hand"
"""Why a flight is no test of its scenario that somebody has changed while it flew."""

LATE_FRAMES = 3.0
"""A frame older than so many camera periods when it is decided on, or a decision that comes so much
later than the end of the hold time before it, was late. With a host that keeps pace it is one
period and the transport."""


@dataclass(frozen=True)
class HostFigures:
    """What the host did to a flight. None where there is nothing to work it out from."""

    given_up: float
    """Simulated time given up, as a share of the flight."""
    tick_lateness_ms: float | None
    """99th percentile of how late ticks began [simulated ms]."""
    speed: float | None
    """Simulated seconds per wall second, as a share of those asked for."""
    stale_frames: float | None
    """Share of decisions on a frame that was older than `LATE_FRAMES` camera periods."""
    late_decisions: float | None
    """Share of decisions that began more than `LATE_FRAMES` camera periods after the hold time."""


class Rule(NamedTuple):
    """A bound that a flight must keep to be valid."""

    figure: str
    """Field of `HostFigures`."""
    limit: float
    least: bool
    """Whether the limit is a least value, not a greatest."""
    scale: float
    """From the figure to the unit of the text."""
    text: str
    """What is wrong, with places for the figure and for the limit."""


RULES = (
    Rule(
        "given_up", 0.01, False, 100.0, "{:.1f} % of its simulated time was given up (limit {:g} %)"
    ),
    Rule("tick_lateness_ms", 40.0, False, 1.0, "1 % of ticks began {:.0f} ms late (limit {:g} ms)"),
    Rule("speed", 0.95, True, 100.0, "flown at {:.0f} % of the speed asked for (limit {:g} %)"),
    Rule(
        "stale_frames",
        0.05,
        False,
        100.0,
        "{:.0f} % of decisions were on a camera frame missed by the host (limit {:g} %)",
    ),
    Rule(
        "late_decisions",
        0.05,
        False,
        100.0,
        "{:.0f} % of decisions were paced too late (limit {:g} %)",
    ),
)
"""What a host must keep to. Ticks are 4 ms apart and camera frames mostly 33 ms. A decision moves a
vehicle at 4 m/s by 0.16 m in 40 ms, a tenth of what a hold time of 0.5 s does."""


def host_figures(
    *,
    flight_us: int,
    slipped_us: int,
    wall_s: float | None,
    speed: float | None,
    lateness_us: NDArray[np.int64],
    decisions: Mapping[str, NDArray[Any]],
    frame_period_us: int,
    excused: Sequence[tuple[int, int]] = (),
) -> HostFigures:
    """Work out what the host did to a flight, in simulated time.

    `flight_us` is from the reset to the verdict, without the time given up in it, `slipped_us`;
    `wall_s` the wall time of the same, None if it was not paced. `lateness_us` (n,) is how late
    each tick began. `decisions` has stamps by column, as in `latency.npz`. `excused` are the times
    in which decisions may be late for what was asked for. These are faults of the camera, a link or
    a process, or images that take long to draw.
    """
    kept = None
    if wall_s and speed:
        kept = flight_us / US_PER_S / (wall_s * speed)
    whole_us = flight_us + slipped_us
    late_us = LATE_FRAMES * frame_period_us
    return HostFigures(
        given_up=slipped_us / whole_us if whole_us > 0 else 0.0,
        tick_lateness_ms=float(np.percentile(lateness_us, 99.0)) / US_PER_MS
        if lateness_us.size
        else None,
        speed=kept,
        stale_frames=_share_beyond(decisions, "capture_us", "infer_start_us", late_us, excused),
        late_decisions=_share_beyond(
            _shifted(decisions), "held_until_us", "infer_start_us", late_us, excused
        ),
    )


def host_faults(figures: HostFigures, strangers: Sequence[str] = ()) -> tuple[str, ...]:
    """Return why a flight is no test of its policy; `strangers` commanded the vehicle."""
    faults = []
    for rule in RULES:
        value = getattr(figures, rule.figure)
        if value is None:
            continue
        if value < rule.limit if rule.least else value > rule.limit:
            faults.append(rule.text.format(rule.scale * value, rule.scale * rule.limit))
    faults.extend(f"commanded by a stranger: {stranger}" for stranger in strangers)
    return tuple(faults)


def _shifted(decisions: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the end of each hold time beside the start of the next decision."""
    if "held_until_us" not in decisions or "infer_start_us" not in decisions:
        return {}
    return {
        "held_until_us": decisions["held_until_us"][:-1],
        "infer_start_us": decisions["infer_start_us"][1:],
    }


def _share_beyond(
    stamps: Mapping[str, NDArray[Any]],
    start: str,
    end: str,
    limit_us: float,
    excused: Sequence[tuple[int, int]],
) -> float | None:
    """Return the share of intervals longer than a limit, excused times aside; None: none."""
    if start not in stamps or end not in stamps:
        return None
    first, last = stamps[start], stamps[end]
    both = (first != NO_STAMP) & (last != NO_STAMP)
    for from_us, to_us in excused:
        both &= (last < from_us) | (first > to_us)
    if not both.any():
        return None
    return float(np.mean((last - first)[both] > limit_us))

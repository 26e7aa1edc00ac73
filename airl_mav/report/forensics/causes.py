"""The cause of a failure or of a long flight, in plain sentences, from what was recorded."""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.report.forensics.camera_view import ObstacleView, PolicyCamera
from airl_mav.report.forensics.collisions import SEEN_SHARE, Collision, examine_collision
from airl_mav.report.forensics.evidence import (
    HALF_WIDTH_M,
    NO_CAUSE,
    Cause,
    Evidence,
    UsualFlight,
    path_excess,
    straight_m,
    time_lost_s,
)
from airl_mav.report.forensics.long_flights import cause_of_long_flight

SLOW_EXCESS = 0.25
"""A flight is slow, or long, when it takes this much more than the run's usual one."""

ACT_S = 0.2
"""A multicopter has to tilt before it brakes or swerves: with less time than this after the motors
answered, nothing of the decision shows in its path."""

USUAL = "as usual"


def cause_of(flight: Evidence, usual: UsualFlight) -> Cause:
    """Return the cause of a failure, or of a flight that took longer than is usual."""
    outcome = flight.record.outcome
    if outcome is Outcome.ABORTED:
        return Cause("aborted", (f"{flight.record.reason}.",))
    if outcome is Outcome.COLLISION:
        crash = examine_collision(flight)
        return Cause(NO_CAUSE, ()) if crash is None else _cause_of_collision(flight, crash)
    if not len(flight.path):
        return Cause(NO_CAUSE, ())
    if outcome is Outcome.SUCCESS and not _slow(flight.record, usual):
        return Cause(USUAL, ())
    return cause_of_long_flight(flight, usual)


def _slow(record: EpisodeRecord, usual: UsualFlight) -> bool:
    """Return whether a flight took clearly longer, or a longer way, than is usual."""
    lost, excess = time_lost_s(record, usual), path_excess(record)
    if lost is None or excess is None or usual.pace_s_m is None or usual.path_ratio is None:
        return False
    slow = lost > SLOW_EXCESS * usual.pace_s_m * straight_m(record)
    return slow or excess + 1.0 > (1.0 + SLOW_EXCESS) * usual.path_ratio


def _cause_of_collision(flight: Evidence, crash: Collision) -> Cause:
    """Return why something was hit."""
    if flight.record.navigation_us is None or flight.record.reason.endswith("take-off"):
        return Cause("hit during the take-off", (f"At {crash.speed_m_s:.1f} m/s.",))
    if crash.before_s is None or crash.blind_m is None:
        return Cause("hit before the first decision", ("No decision had reached the motors yet.",))
    sentences = [
        f"The last frame that still moved the motors was {crash.before_s:.2f} s old at the "
        f"collision; the vehicle flew {crash.blind_m:.1f} m on it."
    ]
    kind = NO_CAUSE
    if (view := crash.view) is not None:
        sentences.insert(0, _where(crash, flight.camera))
        half_angle = flight.camera.half_angle_rad if flight.camera else math.pi
        aside = flight.camera.aside_rad if flight.camera else abs
        shown = crash.seen[-1] if crash.seen else aside(view.bearing_rad) <= half_angle
        if crash.glass:
            kind = "glass, which depth passes through"
        elif not shown:
            kind = "hidden behind something nearer" if view.hidden else "hit out of the picture"
        else:
            kind = _seen(crash, view, flight.braking_m)
        if len(crash.seen) > 1 and not crash.glass:
            sentences.append(
                f"It was in {sum(crash.seen)} of the last {len(crash.seen)} frames used."
            )
        if aside(crash.off_heading_rad) > half_angle:
            sentences.append(
                f"It was flying {_side(crash.off_heading_rad)} of its heading, where the camera "
                "does not look."
            )
    if crash.lag_s is not None and crash.lag_m is not None:
        sentences.append(
            f"Until the motors answered that frame, {crash.lag_s:.2f} s and {crash.lag_m:.1f} m "
            f"went by; speed at the collision {crash.speed_m_s:.1f} m/s."
        )
    return Cause(kind, tuple(sentences))


def _seen(crash: Collision, view: ObstacleView, braking_m: Callable[[float], float] | None) -> str:
    """Return what became of an obstacle in the picture: was there room to act, and to stop?"""
    if crash.lag_m is None or crash.lag_s is None or crash.before_s is None:
        return "seen and flown into"
    if crash.before_s - crash.lag_s < ACT_S:
        return "seen too late to act"
    room_m = max(0.0, view.distance_m - HALF_WIDTH_M - crash.lag_m)
    if braking_m is None or crash.answer_m_s is None:
        return "seen and flown into"
    stops = braking_m(crash.answer_m_s) <= room_m
    return "seen and flown into" if stops else "seen too late to stop"


def _where(crash: Collision, camera: PolicyCamera | None) -> str:
    """Say where the thing that was hit lay on the last frame that moved the motors."""
    view = crash.view
    if view is None or camera is None:
        return ""
    place = f"{view.distance_m:.1f} m off, {_side(view.bearing_rad)}"
    if view.share is not None and view.share >= SEEN_SHARE:
        return f"On the last frame used, {crash.what} filled {view.share:.1%} of it: {place}."
    limit = math.degrees(camera.half_angle_rad)
    if crash.glass:
        return f"{crash.what} is of glass; the camera measured through it. It lay {place}."
    if view.hidden:
        return f"On the last frame used, {crash.what} was hidden by something nearer: {place}."
    if camera.aside_rad(view.bearing_rad) > camera.half_angle_rad:
        return (
            f"On the last frame used, {crash.what} lay {place}; the camera sees {limit:.0f}° to "
            "either side."
        )
    if view.share is None:
        return f"On the last frame used, the spot of the {crash.what} that was hit lay {place}."
    return f"On the last frame used, {crash.what} was barely in the picture: {place}."


def _side(angle_rad: float) -> str:
    """Say an angle from the heading."""
    degrees = round(math.degrees(angle_rad))
    if degrees == 0:
        return "straight ahead"
    return f"{abs(degrees)}° to the {'right' if degrees > 0 else 'left'}"

"""What the panel shows, as pure functions: the camera's images, numbers and texts as HTML."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import nearness, rgb_of
from airl_mav.core.constants import US_PER_S
from airl_mav.view.messages import Decided, Image
from airl_mav.view.shown import Shown
from airl_mav.view.viridis import VIRIDIS

NO_RETURN = (38, 42, 48)
"""Colour of pixels that the camera has no depth of."""

LEAST_PX = 192
"""Images are shown at least so wide, each pixel as a square."""

WARNING = 4
"""MAV_SEVERITY_WARNING."""

NOTHING = "–"


def camera_picture(image: Image, range_m: float) -> NDArray[np.uint8]:
    """Return a camera's image for people, RGB (h, w, 3): of depth near is bright.

    Args:
        image: As `camera.frame.Frame.image`.
        range_m: Farthest depth that the camera returns [m].
    """
    if image.ndim == 3:
        picture = rgb_of(image)
    else:
        picture = VIRIDIS[(255.0 * nearness(image, range_m)).astype(np.uint8)]
        picture[image == 0] = NO_RETURN
    times = max(1, math.ceil(LEAST_PX / picture.shape[1]))
    larger: NDArray[np.uint8] = np.kron(picture, np.ones((times, times, 1), np.uint8))
    return larger


def numbers_html(shown: Shown) -> str:
    """Return the numbers of the moment as a table."""
    vehicle, decided = shown.vehicle, shown.decided
    rows = [("phase", shown.phase or NOTHING)]
    if (trained := shown.trained) is not None:
        zone = "" if trained.zone is None else f", zone {trained.zone}"
        success = None if trained.success is None else 100.0 * trained.success
        rows += [
            ("training", f"{trained.steps:,} decisions{zone}"),
            ("success", _number(success, "{:.0f} % of the newest episodes")),
            ("reward", f"{trained.reward:+.3f}, {trained.returned:+.3f} so far"),
            ("chosen", trained.action),
        ]
    if vehicle is not None:
        speed = math.hypot(*vehicle.velocity)
        away = _number(shown.to_goal_m, ", {:.1f} m to the goal")
        charge = None if vehicle.battery is None else 100.0 * vehicle.battery
        hit = "" if vehicle.collision is None else f", has hit {vehicle.collision}"
        rows += [
            ("mode", (vehicle.mode or NOTHING) + ("" if vehicle.armed else ", disarmed")),
            ("time", f"{shown.seconds:.1f} s{away}"),
            ("flies", f"{speed:.1f} m/s, {-vehicle.position[2]:.1f} m high{hit}"),
            ("battery", _number(charge, "{:.0f} %")),
        ]
    acts, then, how = NOTHING, NOTHING, ""
    if decided is not None and shown.flies_setpoints:
        acts, then = _setpoint(decided)
        how = ", compensated" if decided.compensated else ""
    rows += [
        ("action", acts),
        ("", then),
        ("command age", _number(shown.age_ms, "{:.0f} ms")),
        ("t2", _number(shown.t2_ms, "{:.0f} ms") + how),
    ]
    return _table(rows)


def _setpoint(decided: Decided) -> tuple[str, str]:
    """Return what was decided, in two lines."""
    # Added to zero, so that a rounded zero has no sign of its own.
    if decided.commands == "velocity":
        forward, right, down = (round(number, 1) + 0.0 for number in decided.setpoint[:3])
        turn = round(math.degrees(decided.setpoint[3])) + 0
        return (
            f"{forward:+.1f} forward, {right:+.1f} right,",
            f"{down:+.1f} down [m/s], {turn:+d} °/s",
        )
    roll, pitch, yaw = (round(math.degrees(number)) + 0 for number in decided.setpoint[:3])
    unit = "°/s" if decided.commands == "body_rates" else "°"
    thrust = f"thrust {decided.setpoint[3]:.2f}"
    return f"roll {roll:+d}, pitch {pitch:+d},", f"yaw {yaw:+d} {unit}, {thrust}"


def title_html(shown: Shown, run: str) -> str:
    """Return what flies, as a heading; `run` names the run."""
    flight = shown.flight
    what = "" if flight is None else f"flight {flight.index:03d}, seed {flight.seed}"
    style = "margin:0 1em;font-size:0.85em;line-height:1.3"
    return f'<div style="{style}"><b>{html.escape(run)}</b><br>{html.escape(what)}</div>'


def texts_html(shown: Shown) -> str:
    """Return what was said, the newest first."""
    began_us = 0 if shown.episode is None else shown.episode.started_us
    lines = []
    for said in reversed(shown.texts):
        colour = "#c0392b" if said.severity < WARNING else "#b4540a"
        style = f' style="color:{colour}"' if said.severity <= WARNING else ""
        when = "" if said.time_us is None else f"{(said.time_us - began_us) / US_PER_S:.1f} s "
        lines.append(f"<div{style}>{when}{html.escape(said.text)}</div>")
    return (
        '<div style="padding:0 1em;font-size:0.8em;line-height:1.35">'
        + ("".join(lines) or NOTHING)
        + "</div>"
    )


def _table(rows: Iterable[tuple[str, str]]) -> str:
    style = "opacity:0.65;padding-right:1em;white-space:nowrap"
    cells = "".join(
        f'<tr><td style="{style}">{html.escape(name)}</td><td>{html.escape(value)}</td></tr>'
        for name, value in rows
    )
    return (
        '<table style="margin:0 1em;font-size:0.85em;line-height:1.3;'
        f'font-variant-numeric:tabular-nums"><tbody>{cells}</tbody></table>'
    )


def _number(value: float | None, form: str) -> str:
    return NOTHING if value is None else form.format(value)

"""Panel beside the scene: numbers, the policy's image, the latency strip, texts."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from airl_mav.addons.view.view_messages import STRIP_S, Decided, Image, Shown
from airl_mav.core.constants import US_PER_S

LEAST_PX = 192
"""Minimum width of a displayed image [px]; narrower images are scaled by an integer."""

WARNING = 4

NOTHING = "–"


def camera_picture(image: Image, range_m: float) -> NDArray[np.uint8]:
    """Return a `Frame.image` as RGB (h, w, 3); near depth is bright, up to `range_m` [m]."""
    # Imported with the first image: the page is ready sooner without matplotlib.
    from airl_mav.report.theme import pictured

    picture = pictured(image, range_m)
    times = max(1, math.ceil(LEAST_PX / picture.shape[1]))
    larger: NDArray[np.uint8] = np.kron(picture, np.ones((times, times, 1), np.uint8))
    return larger


def numbers_html(shown: Shown) -> str:
    """Return the current values as an HTML table."""
    vehicle, decided = shown.vehicle, shown.decided
    rows = [("phase", shown.phase or NOTHING)]
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
    """Return the decision's setpoint as two lines of text."""
    # Adding zero removes the sign of a negative zero.
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
    """Return the run's name and its flight as an HTML heading."""
    flight = shown.flight
    what = "" if flight is None else f"flight {flight.index:03d}, seed {flight.seed}"
    style = "margin:0 1em;font-size:0.85em;line-height:1.3"
    return f'<div style="{style}"><b>{html.escape(run)}</b><br>{html.escape(what)}</div>'


def texts_html(shown: Shown) -> str:
    """Return the texts as HTML, newest first."""
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


AGE_COLOUR, T2_COLOUR = "#2868a8", "#b4540a"

WIDTH_PX = 340

BLANK = np.full((144, 192, 3), 38, np.uint8)
"""Image before the first decision."""

NO_PAST = (np.array([0.0, STRIP_S]), np.zeros(2), np.zeros(2))
"""Latency strip before the first decision."""


class Panel:
    """Panel of one server."""

    def __init__(
        self,
        server: viser.ViserServer,
        run: str,
        *,
        image: str = "what the policy saw",
        head: Callable[[], None] = lambda: None,
        latency: Callable[[], None] = lambda: None,
    ) -> None:
        """Build the panel; `head` and `latency` add controls below the title and the strip."""
        self._run = run
        gui: Any = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label("airl-mav")
        # Docked beside the scene: an overlay would hide the vehicle in the middle.
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH_PX)
        self._title = gui.add_html(title_html(Shown(), run))
        head()
        self._numbers = gui.add_html(numbers_html(Shown()))
        self._gui, self._label = gui, image
        self._picture: Any = None
        with gui.add_folder("Latency"):
            self._strip = _new_strip(gui)
            latency()
        with gui.add_folder("Texts"):
            self._texts = gui.add_html(texts_html(Shown()))
        self._decisions = 0
        self._is_blank = True

    def name(self, run: str) -> None:
        """Rename the run in the title."""
        self._run = run

    def draw_title(self, shown: Shown) -> None:
        """Update the title with the run and its flight."""
        if self._title.content != (title := title_html(shown, self._run)):
            self._title.content = title

    def draw(self, shown: Shown) -> None:
        """Update numbers, texts and image; unchanged elements are not sent."""
        self.draw_title(shown)
        for element, text in (
            (self._numbers, numbers_html(shown)),
            (self._texts, texts_html(shown)),
        ):
            if element.content != text:
                element.content = text
        if self._picture is None:
            self._add_picture()
        if shown.decisions != self._decisions:
            self._decisions = shown.decisions
            if shown.episode is None or shown.decided_image is None:
                self._picture.image = BLANK
            else:
                range_m = shown.episode.vehicle.camera_range_m
                self._picture.image = camera_picture(shown.decided_image, range_m)

    def _add_picture(self) -> None:
        """Add the image below the numbers; deferred, as its encoder is slow to import."""
        order = self._numbers.order + 0.5
        self._picture = self._gui.add_image(BLANK, label=self._label, format="png", order=order)

    def draw_strip(self, shown: Shown) -> None:
        """Update the strip with the latencies of the last `STRIP_S` seconds."""
        if len(shown.ages) >= 2:
            seconds, ages, t2s = np.array(shown.ages).T
            self._strip.data = (seconds, ages, t2s)
            self._is_blank = False
        elif not self._is_blank:
            self._strip.data = NO_PAST
            self._is_blank = True


def _new_strip(gui: Any) -> Any:
    axis = uplot.Axis(size=42, font="10px sans-serif")
    return gui.add_uplot(
        NO_PAST,
        (
            uplot.Series(label="s"),
            uplot.Series(label="command age [ms]", stroke=AGE_COLOUR, width=1.5),
            uplot.Series(label="t2 [ms]", stroke=T2_COLOUR, width=1.5),
        ),
        scales={"x": uplot.Scale(time=False)},
        axes=(axis, axis),
        aspect=1.9,
        padding=(12, 16, 0, 0),
    )

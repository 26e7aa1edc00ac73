"""Panel beside the scene: numbers, the policy's image, the latency strip, texts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from viser import uplot

from airl_mav.view.pictures import camera_picture, numbers_html, texts_html, title_html
from airl_mav.view.shown import STRIP_S, Shown

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

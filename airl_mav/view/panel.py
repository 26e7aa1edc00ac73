"""The panel beside the scene: numbers, the policy's image, the latency strip, what may be set."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from viser import uplot

from airl_mav.view.messages import Steering
from airl_mav.view.pictures import depth_picture, numbers_html, texts_html, title_html
from airl_mav.view.shown import STRIP_S, Shown

AGE_COLOUR, T2_COLOUR = "#2868a8", "#b4540a"

FASTEST = "fastest"
SPEEDS = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "5 x": 5.0}
"""What may be chosen beside the scenario's own speed and the fastest."""

WIDTH_PX = 340

BLANK = np.full((144, 192, 3), 38, np.uint8)
"""The image before the first decision."""

NO_PAST = (np.array([0.0, STRIP_S]), np.zeros(2), np.zeros(2))
"""The strip before it."""

LONGEST_MS = 1000
"""Greatest latency that may be set by hand [ms]."""

FIRST_MS = 400
"""The latency that the slider begins at: that of the paper's Raspberry Pi 4."""


class Panel:
    """The panel of one server."""

    def __init__(
        self,
        server: viser.ViserServer,
        run: str,
        steering: Steering,
        *,
        paced: bool,
        compensable: bool,
        compensated: bool,
    ) -> None:
        """Build it.

        Args:
            server: Whose.
            run: What the run is called.
            steering: What is asked for at the beginning.
            paced: Whether the watchers may set the pace.
            compensable: Whether the latency can be compensated: the vehicle's response is known.
            compensated: Whether it is, as the scenario says.
        """
        self.steering = steering
        """What the watchers ask for."""
        self._run = run
        gui: Any = server.gui
        self._gui = gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label("airl-mav")
        # Beside the scene, not on it: the vehicle is in the middle of what is seen.
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH_PX)
        self._title = gui.add_html(title_html(Shown(), run))
        if paced:
            self._add_pace()
        self._numbers = gui.add_html(numbers_html(Shown()))
        self._picture = gui.add_image(BLANK, label="what the policy saw", format="png")
        with gui.add_folder("Latency"):
            self._strip = self._new_strip()
            self._add_knob(compensable=compensable, compensated=compensated)
        with gui.add_folder("Texts"):
            self._texts = gui.add_html(texts_html(Shown()))
        self._decisions = 0
        self._is_blank = True

    def _ask(self, **changes: Any) -> None:
        self.steering = self.steering.model_copy(update=changes)

    def let_go(self) -> None:
        """Let a paused flight go on: the last of those who could has left."""
        self._ask(paused=False)

    def _add_pace(self) -> None:
        gui = self._gui
        speeds = dict(SPEEDS)
        if (speed := self.steering.speed) is not None and speed not in speeds.values():
            speeds[f"{speed:g} x"] = speed
        named = {value: name for name, value in speeds.items()}
        first = FASTEST if speed is None else named[speed]
        pause = gui.add_button_group("Flight", ("Pause", "Step", "Go on"))
        pace = gui.add_dropdown("Speed", (*speeds, FASTEST), initial_value=first)

        @pause.on_click
        def _(_event: object) -> None:
            if pause.value == "Go on":
                self._ask(paused=False)
            elif pause.value == "Pause":
                self._ask(paused=True)
            else:
                self._ask(paused=True, steps=self.steering.steps + 1)

        @pace.on_update
        def _(_event: object) -> None:
            self._ask(speed=speeds.get(pace.value))

    def _add_knob(self, *, compensable: bool, compensated: bool) -> None:
        gui = self._gui
        by_hand = gui.add_checkbox(
            "Set t2 by hand", False, hint="The flight then counts in no statistics."
        )
        t2 = gui.add_slider("t2 [ms]", 0, LONGEST_MS, 10, FIRST_MS, disabled=True)

        def changed(_event: object) -> None:
            t2.disabled = not by_hand.value
            self._ask(t2_ms=float(t2.value) if by_hand.value else None)

        by_hand.on_update(changed)
        t2.on_update(changed)
        if not compensable:
            return
        switch = gui.add_checkbox(
            "Compensate", compensated, hint="Changed, the flight counts in no statistics."
        )

        @switch.on_update
        def _(_event: object) -> None:
            self._ask(compensate=None if switch.value == compensated else bool(switch.value))

    def _new_strip(self) -> Any:
        axis = uplot.Axis(size=42, font="10px sans-serif")
        return self._gui.add_uplot(
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

    def draw(self, shown: Shown) -> None:
        """Show the numbers, texts and images of the moment; what has not changed is not sent."""
        for element, text in (
            (self._title, title_html(shown, self._run)),
            (self._numbers, numbers_html(shown)),
            (self._texts, texts_html(shown)),
        ):
            if element.content != text:
                element.content = text
        if shown.decisions != self._decisions:
            self._decisions = shown.decisions
            if shown.episode is None or shown.decided_mm is None:
                self._picture.image = BLANK
            else:
                range_m = shown.episode.vehicle.camera_range_m
                self._picture.image = depth_picture(shown.decided_mm, range_m)

    def draw_strip(self, shown: Shown) -> None:
        """Show the latencies of the last seconds."""
        if len(shown.ages) >= 2:
            seconds, ages, t2s = np.array(shown.ages).T
            self._strip.data = (seconds, ages, t2s)
            self._is_blank = False
        elif not self._is_blank:
            self._strip.data = NO_PAST
            self._is_blank = True

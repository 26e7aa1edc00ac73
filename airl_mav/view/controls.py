"""What the watchers of a flight may set: its pace, its latency, its compensation."""

from __future__ import annotations

from typing import Any

from airl_mav.view.messages import Steering

FASTEST = "fastest"
SPEEDS = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "5 x": 5.0}
"""What may be chosen beside the scenario's own speed and the fastest."""

LONGEST_MS = 1000
"""Greatest latency that may be set by hand [ms]."""

FIRST_MS = 400
"""The latency that the slider begins at: that of the paper's Raspberry Pi 4."""


class Controls:
    """The controls of one page.

    What viser calls is a coroutine: it runs before the next message of a page is read. A function
    would run in a thread of a pool, and read what another click has made of the control since.
    """

    def __init__(self, gui: Any, steering: Steering) -> None:
        """Take viser's interface, and what is asked for at the beginning."""
        self.steering = steering
        """What the watchers ask for."""
        self._gui = gui

    def _ask(self, **changes: Any) -> None:
        self.steering = self.steering.model_copy(update=changes)

    def let_go(self) -> None:
        """Let a paused flight go on: the last of those who could has left."""
        self._ask(paused=False)

    def add_pace(self) -> None:
        """Add what sets the pace."""
        gui = self._gui
        speeds = dict(SPEEDS)
        if (speed := self.steering.speed) is not None and speed not in speeds.values():
            speeds[f"{speed:g} x"] = speed
        named = {value: name for name, value in speeds.items()}
        first = FASTEST if speed is None else named[speed]
        pause = gui.add_button_group("Flight", ("Pause", "Step", "Go on"))
        pace = gui.add_dropdown("Speed", (*speeds, FASTEST), initial_value=first)

        @pause.on_click
        async def _(_event: object) -> None:
            if pause.value == "Go on":
                self._ask(paused=False)
            elif pause.value == "Pause":
                self._ask(paused=True)
            else:
                self._ask(paused=True, steps=self.steering.steps + 1)

        @pace.on_update
        async def _(_event: object) -> None:
            self._ask(speed=speeds.get(pace.value))

    def add_knob(self, *, compensable: bool, compensated: bool) -> None:
        """Add what sets the latency.

        Args:
            compensable: Whether it can be compensated: the vehicle's response is known, and its
                camera gives depth.
            compensated: Whether it is, as the scenario says.
        """
        gui = self._gui
        by_hand = gui.add_checkbox(
            "Set t2 by hand", False, hint="The flight then counts in no statistics."
        )
        t2 = gui.add_slider("t2 [ms]", 0, LONGEST_MS, 10, FIRST_MS, disabled=True)

        async def changed(_event: object) -> None:
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
        async def _(_event: object) -> None:
            self._ask(compensate=None if switch.value == compensated else bool(switch.value))

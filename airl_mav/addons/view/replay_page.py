"""Replay page of a run: the live view's scene and panel with a time slider."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from airl_mav.addons.view import replayed_flight, view_messages, view_server, viser_scene
from airl_mav.addons.view.panel import Panel
from airl_mav.core import constants, errors
from airl_mav.core.clock import Clock, WallClock
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.report.scene import OTHER

DRAW_US = 33_000
"""Period of scene updates [wall µs]."""

LATE_US = 500_000
"""Maximum time step of the replay [wall µs]; the rest of a longer delay is skipped."""

PANEL_S = 0.2
"""Period of updates of the panel and the camera's image [wall s]."""

STEP_S = 0.02
"""Step of the slider [s], equal to the recording's period."""

SPEEDS = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "5 x": 5.0}

ALONE = "none"
"""Menu entry for a replay without a second run."""

BEFORE_S = 0.5
"""Time shown before the start of navigation [s]."""


class ReplayPage:
    """Page that replays flights of a run, optionally with the flights of a second run."""

    def __init__(
        self,
        server: viser.ViserServer,
        run: replayed_flight.ReplayedRun,
        beside: replayed_flight.ReplayedRun | None = None,
        first: EpisodeRecord | None = None,
        runs: replayed_flight.ReplayedRuns | None = None,
    ) -> None:
        """Build the page at the start of flight `first`; None = the worst flight."""
        self._run, self._beside, self._runs = run, beside, runs
        self._shown, self._others = view_messages.Shown(), view_messages.Shown()
        self._scene = viser_scene.FlightScene(server)
        self._ghost = viser_scene.FlightScene(server, "/beside", OTHER)
        self._records = {_label(record): record for record in run.records}
        self._gui: Any = server.gui
        self._panel = Panel(
            server, run.title, image="what the camera saw for the decision", head=self._add_head
        )
        self._watchers = view_server.Watchers(server)
        self._playing = True
        self._dirty = True
        self._behind = False
        """True if the panel shows an earlier time than the scene."""
        self._since_panel_s = PANEL_S
        self._slid = False
        """True if a viewer moved the slider to the current time."""
        self._other: replayed_flight.ReplayedFlight | None = None
        """Flight of the second run."""
        self._open(run.way(first or run.records[0]))

    def _add_head(self) -> None:
        gui = self._gui
        if self._runs is not None and len(self._runs.names) > 1:
            self._add_runs(self._runs)
        labels = tuple(self._records)
        self._pick = gui.add_dropdown("Flight", labels, initial_value=labels[0])
        self._time = gui.add_slider("time [s]", 0.0, 1.0, STEP_S, 0.0)
        self._buttons = gui.add_button_group("Play", ("Play", "Pause", "Step"))
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 x")
        self._part = gui.add_button("Where the runs part", visible=self._beside is not None)

        @self._pick.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                chosen = self._records[self._pick.value]
                self._told(event, lambda: self._choose(chosen))

        @self._time.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self._playing = False
                self._go_to(self._time.value, slid=True)

        @self._buttons.on_click
        def _(_event: object) -> None:
            self._playing = self._buttons.value == "Play"
            if self._buttons.value == "Step":
                self._go_to(self._next_decision_s())
            elif self._playing and self._seconds >= self._flight.duration_s:
                self._go_to(self._begin_s())

        @self._part.on_click
        def _(_event: object) -> None:
            if (
                self._other is not None
                and (at := replayed_flight.parting_s(self._flight, self._other)) is not None
            ):
                self._playing = False
                self._go_to(at)

    def _add_runs(self, runs: replayed_flight.ReplayedRuns) -> None:
        now, beside = runs.name_of(self._run), self._beside
        there = ALONE if beside is None else runs.name_of(beside)
        flown = self._gui.add_dropdown("Run", runs.names, initial_value=now)
        other = self._gui.add_dropdown("Beside", (ALONE, *runs.names), initial_value=there)

        @flown.on_update
        def _(event: Any) -> None:
            if event.client is not None and not self._told(event, lambda: self._fly(flown.value)):
                flown.value = runs.name_of(self._run)

        @other.on_update
        def _(event: Any) -> None:
            name = other.value
            if event.client is not None and not self._told(event, lambda: self._pair(name)):
                other.value = ALONE if self._beside is None else runs.name_of(self._beside)

    @staticmethod
    def _told(event: Any, act: Callable[[], None]) -> bool:
        """Run an action; on UsageError, show a notification on the page and return False."""
        try:
            act()
        except errors.UsageError as error:
            event.client.add_notification("It cannot be shown", str(error), color="red")
            return False
        return True

    # --- position in time

    def _open(self, way: replayed_flight.ReplayedFlight) -> None:
        """Show a flight at once and add its arena when ready; late viewers get both."""
        self._flight: replayed_flight.ReplayedFlight = way
        way.begin(self._shown)
        self._shown.is_surrounded = False
        self._go_to(self._begin_s())
        way.show(self._shown, self._seconds)
        self._scene.draw(self._shown, picture=False)
        self._watchers.expect(self._shown)
        self._panel.draw_title(self._shown)
        flight = self._run.flight(way.record)
        if self._flight is way:  # No other flight was chosen while the arena was generated.
            self._flight = flight
            flight.surround(self._shown)
            self._accompany(way.record)
            self.draw()

    def _fly(self, name: str) -> None:
        if self._runs is None:
            return
        run = self._runs.run(name)
        record = run.same(self._flight.record) or run.records[0]
        run.flight(record)
        self._run = run
        self._records = {_label(each): each for each in run.records}
        self._pick.options = tuple(self._records)
        self._panel.name(run.title)
        self._choose(record)

    def _pair(self, name: str) -> None:
        if self._runs is None:
            return
        beside = None if name == ALONE else self._runs.run(name)
        if beside is not None and (same := beside.same(self._flight.record)) is not None:
            beside.flight(same)
        self._beside = beside
        self._part.visible = beside is not None
        self._accompany(self._flight.record)

    def _choose(self, record: EpisodeRecord) -> None:
        self._flight = self._run.flight(record)
        self._flight.begin(self._shown)
        self._accompany(record)

    def _accompany(self, record: EpisodeRecord) -> None:
        """Add the second run's flight of the same seed and go to the start of the flight."""
        self._other = None
        if self._beside is not None and (same := self._beside.same(record)) is not None:
            self._other = self._beside.flight(same)
        self._others = view_messages.Shown()
        if self._other is not None:
            self._other.begin(self._others)
        if self._pick.value != _label(record):
            self._pick.value = _label(record)
        self._time.max = max(STEP_S, round(self._flight.duration_s, 2))
        self._go_to(self._begin_s())

    def _begin_s(self) -> float:
        record = self._flight.record
        if record.navigation_us is None:
            return 0.0
        return max(0.0, (record.navigation_us - record.started_us) / constants.US_PER_S - BEFORE_S)

    def _next_decision_s(self) -> float:
        now_us = self._flight.time_us(self._seconds)
        later = self._flight.sent_us[self._flight.sent_us > now_us + 1]
        if not len(later):
            return self._flight.duration_s
        return (int(later[0]) - self._flight.record.started_us) / constants.US_PER_S

    def _go_to(self, seconds: float, *, slid: bool = False) -> None:
        self._seconds = min(max(0.0, seconds), self._flight.duration_s)
        self._dirty, self._slid = True, slid

    # --- drawing

    def run(self, clock: Clock | None = None) -> None:
        """Run the replay until interrupted."""
        clock = clock or WallClock()
        before_us = clock.time_us()
        while True:
            clock.sleep_until(before_us + DRAW_US)
            now_us = clock.time_us()
            self.advance(min(now_us - before_us, LATE_US) / constants.US_PER_S)
            before_us = now_us

    def advance(self, wall_s: float) -> None:
        """Advance by `wall_s` of wall time and draw; does nothing without viewers."""
        if not self._watchers.there:
            return
        if self._playing:
            self._go_to(self._seconds + wall_s * SPEEDS[self._speed.value])
            self._playing = self._seconds < self._flight.duration_s
        self._since_panel_s += wall_s
        due = self._since_panel_s >= PANEL_S
        if self._dirty:
            self.draw(panel=due)
        elif self._behind and due:
            self._draw_panel()
        self._watchers.follow(self._shown)

    def draw(self, *, panel: bool = True) -> None:
        """Draw the current time; with `panel`, including the panel."""
        self._dirty = False
        self._behind = True
        self._flight.show(self._shown, self._seconds)
        self._scene.draw(self._shown, picture=False)
        if self._other is not None:
            self._other.show(self._others, self._seconds)
        self._ghost.draw(self._others, picture=False)
        if panel:
            self._draw_panel()

    def _draw_panel(self) -> None:
        """Draw the panel and the camera's image, which a page draws slower than the scene."""
        self._behind, self._since_panel_s = False, 0.0
        self._scene.draw_picture(self._shown)
        if not self._slid:  # An update would move the slider while a viewer drags it.
            self._time.value = round(self._seconds, 2)
        self._panel.draw(self._shown)
        self._panel.draw_strip(self._shown)


def _label(record: EpisodeRecord) -> str:
    return f"{record.index:03d}  seed {record.seed}  {record.outcome.value}"

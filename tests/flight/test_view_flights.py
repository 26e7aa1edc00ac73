"""Flights with viewers: bit-identical, with interventions on record."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from airl_mav.addons.view.taps import ViewObserver
from airl_mav.addons.view.view_messages import (
    CameraImage,
    Decided,
    Episode,
    Flight,
    PhaseStart,
    Shown,
    Steering,
    VehicleState,
)
from airl_mav.addons.view.viewer import Ends
from airl_mav.flight.judge import BY_HAND
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.rehearsal.live_view import ViewAddresses
from airl_mav.rehearsal.observer import Observer
from airl_mav.rehearsal.rehearsal import Rehearsal
from airl_mav.rehearsal.run_folder import FlownEpisode, load, open_folder
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.browser import CHROMIUM, Page, browser
from tests.support.lockstep_kit import SEED, demo_scenario
from tests.support.ports import choose_ports
from tests.support.processes import SITL_WITHOUT_REPORT, running, wait_until
from tests.support.scene import has_drawn


class Watchers:
    """Viewer in this process: reads everything, and pauses, steps and resumes."""

    def __init__(self, steering: Steering, *, steps: int = 0) -> None:
        self.shown, self.kinds = Shown(), set[type]()
        self.t2s_ms: list[float] = []
        self.phases: list[str] = []
        self._steering, self._left = steering, steps
        self._ends, self._stop = Ends(), threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self.ends: ViewAddresses = self._ends.ends

    def _watch(self) -> None:
        while not self._stop.is_set():
            self._ends.ask(self._steering)
            for message, depth_mm in self._ends.take(0.02):
                self.shown.take(message, depth_mm)
                self.kinds.add(type(message))
                if isinstance(message, PhaseStart):
                    self.phases.append(message.phase)
                if isinstance(message, Decided):
                    self.t2s_ms.append((message.ready_us - message.began_us) / 1e3)
                    self._step()

    def _step(self) -> None:
        """Pause at the first decisions, and let one more be made."""
        paused = self._left > 0
        self._left -= 1
        steps = self._steering.steps + 1
        self._steering = self._steering.model_copy(update={"paused": paused, "steps": steps})

    @contextmanager
    def watching(self) -> Iterator[Watchers]:
        self._thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            self._thread.join()
            self._ends.close()


def flown(ends: ViewAddresses | None = None) -> FlownEpisode:
    resolved = demo_scenario()
    return fly(resolved, resolved.fresh_policy(SEED), 0, SEED, view=ends)


def test_a_watched_flight_is_the_same_bit_by_bit() -> None:
    alone = flown().record
    with Watchers(Steering(speed=None), steps=4).watching() as watchers:
        watched = flown(watchers.ends).record
        wait_until(lambda: watchers.shown.decisions > 4, "decisions")
    assert watched == alone
    assert watched.sha256 is not None
    assert {Episode, VehicleState, CameraImage, Decided} <= watchers.kinds
    shown = watchers.shown
    # The drawn path is the flown path: down at the goal, over the whole way.
    assert shown.to_goal_m is not None
    assert shown.to_goal_m < 3.5
    assert len(shown.trail) > 100
    assert shown.decided_image is not None
    assert shown.decided_image.shape == (48, 64)


def test_a_latency_by_hand_acts_and_is_on_record() -> None:
    with Watchers(Steering(speed=None, t2_ms=250.0)).watching() as watchers:
        record = flown(watchers.ends).record
        wait_until(lambda: watchers.t2s_ms, "decisions")
    # The first may have been made before anything was heard of the watchers.
    assert watchers.t2s_ms[-1] == 250.0
    assert record.invalid == (BY_HAND,)
    assert BY_HAND in record.notes
    assert record.sha256 is None


@pytest.mark.nightly
@pytest.mark.slow
def test_two_processes_show_their_flight_and_obey(tmp_path: Path) -> None:
    """Changed by hand, it is kept as it was flown: not flown again, and not valid."""
    ports = choose_ports()
    scenario = resolve(
        Scenario(
            seed=SEED,
            episodes=1,
            speed=4.0,
            time_limit_s=60.0,
            ports={
                "api_port": ports.api,
                "api_local_port": ports.api_local,
                "gcs_port": ports.gcs,
                "gcs_local_port": ports.gcs_local,
                "camera_port": ports.camera,
            },
        )
    )
    folder, _ = open_folder(tmp_path / "run", "watched", scenario)
    with Watchers(Steering(t2_ms=200.0)).watching() as watchers:
        observer = ViewObserver(watchers.ends, Observer())
        with Rehearsal(scenario, folder, observer, view=watchers.ends) as rehearsal:
            rehearsal.run()
        wait_until(lambda: "done" in watchers.phases, "the end")
        observer.close()
    assert {Flight, PhaseStart, Episode, VehicleState, CameraImage, Decided} <= watchers.kinds
    (record,) = load(folder.path).episodes
    assert BY_HAND in record.invalid
    assert not any("flown again" in note for note in record.notes)
    assert np.median(watchers.t2s_ms) == pytest.approx(200.0, rel=0.2)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
@pytest.mark.xdist_group("chromium")
def test_a_browser_shows_the_flight(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    # Slowly, so that there is time to look, and with nothing that the vehicle could be behind.
    # On a busy machine the page needs longer to come up than a flight takes: there are more.
    words = (
        *("--level", "lockstep", "--episodes", "100", "--seed", "1", "--max-speed-m-s", "1"),
        *("--arena", "no-obstacles"),
        *("--speed", "2", "--view", "--out", "run"),
    )
    with browser(tmp_path) as page, running([*SITL_WITHOUT_REPORT, *words], tmp_path) as sitl:
        page.resize(900, 600)
        page.open(sitl.wait_for_text(r"view +(http://127\.0\.0\.1:\d+)")[1])
        time = wait_until(lambda: paused_under_way(page), "a flight that is paused on its way")
        # The first step ends with the decision that was due, which may be at once.
        for _ in range(2):
            assert page.press("Step")
        wait_until(lambda: told_time(page.text()) != time, "a step")
        # The policy's image, each pixel magnified three times.
        sizes = page.evaluate(
            "[...document.querySelectorAll('img')].map((i) => [i.naturalWidth, i.naturalHeight])"
        )
        assert [192, 144] in sizes
        shot = tmp_path / "page.png"
        # The page draws in software here, in its own time.
        wait_until(lambda: has_drawn(page, shot), "vehicle, trail and image")


def paused_under_way(page: Page) -> str | None:
    """Pause a flight on its way to the goal; return the time it stands at, or None if it is not."""
    if "navigating" not in page.text():
        return None
    assert page.press("Pause")
    times = [told_time(page.text())]

    def stands() -> bool:
        times.append(told_time(page.text()))
        return times[-1] == times[-2]

    wait_until(stands, "the pause")
    if "navigating" in page.text():
        return times[-1]
    # The page was so far behind that the flight had landed.
    assert page.press("Go on")
    return None


def told_time(text: str) -> str:
    """Return the flight's time from the panel's text."""
    line = next((line for line in text.splitlines() if line.startswith("time")), "")
    return line.partition(" s")[0]

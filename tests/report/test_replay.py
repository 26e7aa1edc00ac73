"""Replay of a recorded run: the page shows the recorded data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from airl_mav.addons.view.replayed_flight import (
    ReplayedFlight,
    ReplayedRun,
    ReplayedRuns,
    parting_s,
    run_folders,
)
from airl_mav.addons.view.view_messages import Shown
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.flight.judge import Outcome
from airl_mav.rehearsal.run_folder import CAMPAIGN_FILE
from tests.support.processes import PATIENCE_S, running
from tests.support.run_demo import write_demo_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    written, _ = write_demo_run(
        tmp_path_factory.mktemp("replay") / "run", episodes=4, profile="dynamic-obstacles"
    )
    return written.path


@pytest.fixture
def run(folder: Path) -> ReplayedRun:
    return ReplayedRun(folder)


@pytest.fixture
def flight(run: ReplayedRun) -> ReplayedFlight:
    return run.flight(run.record(1))


def test_the_worst_flight_comes_first(run: ReplayedRun) -> None:
    assert len(run.records) == 4
    reached = [record.outcome is Outcome.SUCCESS for record in run.records]
    assert reached == sorted(reached)
    with pytest.raises(FieldError, match="0 to 3"):
        run.record(4)


def test_a_folder_without_a_run_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=str(tmp_path)):
        ReplayedRun(tmp_path)


@pytest.mark.parametrize("seconds", [0.0, 7.3, 12.0])
def test_a_moment_is_shown_as_it_was_recorded(flight: ReplayedFlight, seconds: float) -> None:
    shown, path = Shown(), flight.path
    flight.begin(shown)
    flight.show(shown, seconds)
    time_us = flight.time_us(seconds)
    at = [np.interp(time_us, path.time_us, column) for column in path.position.T]
    assert shown.vehicle is not None
    np.testing.assert_allclose(shown.vehicle.position, at, atol=1e-9)
    sent_us = flight.stamps["sent_us"]
    past = sent_us <= time_us
    if not past.any():
        assert shown.decided is None
        return
    newest = int(np.flatnonzero(past)[-1])
    assert shown.decided is not None
    assert shown.decided.sent_us == sent_us[newest]
    np.testing.assert_allclose(shown.decided.setpoint, flight.stamps["setpoint"][newest])
    age_ms = (time_us - flight.stamps["capture_us"][newest]) / 1e3
    assert shown.age_ms == pytest.approx(age_ms)
    assert shown.ages
    assert shown.ages[-1][1] == pytest.approx(age_ms, abs=41.0)
    # The camera sees the arena: its image is not blank.
    assert shown.decided_image is not None
    assert len(np.unique(shown.decided_image)) > 20


def test_scrubbing_back_shows_the_earlier_decision(flight: ReplayedFlight) -> None:
    shown = Shown()
    flight.begin(shown)
    newest = {}
    for seconds in (12.0, 7.0):
        flight.show(shown, seconds)
        assert shown.decided is not None
        newest[seconds] = shown.decided.sent_us
        assert newest[seconds] <= flight.time_us(seconds)
    assert newest[7.0] < newest[12.0]


def test_flights_part_at_the_first_other_decision(flight: ReplayedFlight) -> None:
    assert parting_s(flight, flight) is None
    changed = flight.stamps["setpoint"].copy()
    changed[3:, 0] += 1.0
    other = replace(flight, stamps=flight.stamps | {"setpoint": changed})
    taken_us = int(flight.stamps["capture_us"][3])
    assert parting_s(flight, other) == (taken_us - flight.record.started_us) / 1e6


def test_a_flight_outside_of_all_arenas_has_its_goal(flight: ReplayedFlight) -> None:
    viser = pytest.importorskip("viser")
    from airl_mav.addons.view.viser_scene import FlightScene

    outside, shown = replace(flight, arena=None), Shown()
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        scene = FlightScene(server)
        outside.begin(shown)
        outside.show(shown, 12.0)
        scene.draw(shown, picture=True)
        assert shown.decided is not None
        assert shown.decided_image is None
        assert server.scene.get_handle_by_name("/flight/arena/walls") is None
        north, east, _ = server.scene.get_handle_by_name("/flight/goal/disc").position
        assert (north, east) == pytest.approx(flight.record.goal)
    finally:
        server.stop()


@pytest.mark.slow
def test_the_command_serves_pages_of_this_computer_alone(folder: Path, tmp_path: Path) -> None:
    viser = pytest.importorskip("viser")
    client = pytest.importorskip("websockets.sync.client")
    from websockets.exceptions import InvalidStatus

    with running(["-m", "airl_mav.cli.main", "view", str(folder), "1"], tmp_path) as program:
        url = program.wait_for_text(r"view  http://(127\.0\.0\.1:\d+)")[1]
        protocols = [f"viser-v{viser.__version__}"]
        with (
            pytest.raises(InvalidStatus, match="HTTP 403"),
            client.connect(f"ws://{url}", origin="https://example.org", subprotocols=protocols),
        ):
            pass
        own = client.connect(
            f"ws://{url}", origin=f"http://{url}", subprotocols=protocols, max_size=None
        )
        with own as page:
            assert page.recv(timeout=PATIENCE_S)
        program.interrupt()
        assert program.wait() == 0, program.text()


class Watched:
    """Page with a simulated viewer."""

    def __init__(self, folder: Path, beside: Path | None = None) -> None:
        viser = pytest.importorskip("viser")
        from airl_mav.addons.view.replay_page import ReplayPage

        self.server = viser.ViserServer("127.0.0.1", 0, verbose=False)
        other = None if beside is None else ReplayedRun(beside)
        self.page = ReplayPage(self.server, ReplayedRun(folder), other)
        self.page._watchers = SimpleNamespace(there=True, follow=lambda _at: None)  # type: ignore[assignment]

    def node(self, name: str) -> Any:
        return self.server.scene.get_handle_by_name(name)


@pytest.fixture
def watched(folder: Path) -> Iterator[Watched]:
    made = Watched(folder, folder)
    yield made
    made.server.stop()


def test_the_page_plays_steps_and_shows_the_other_run(watched: Watched) -> None:
    page, node = watched.page, watched.node
    page.advance(0.0)
    begun = node("/flight/vehicle").position.copy()
    np.testing.assert_allclose(node("/beside/vehicle").position, begun)
    assert node("/beside/camera") is None
    for _ in range(20):
        page.advance(0.1)
    assert np.linalg.norm(node("/flight/vehicle").position - begun) > 0.5
    seconds = page._seconds
    page._playing = False
    page.advance(5.0)
    assert page._seconds == seconds
    page._go_to(page._next_decision_s())
    assert page._seconds > seconds
    page._go_to(1e9)
    page.advance(0.0)
    assert page._seconds == page._flight.duration_s
    # Another flight: another arena, and the vehicle at its beginning.
    last = page._run.records[-1]
    page._choose(last)
    page.advance(0.0)
    assert page._shown.flight is not None
    assert page._shown.flight.index == last.index
    assert page._pick.value.startswith(f"{last.index:03d}")


# --- campaigns


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a campaign of three cells: two with flights, one damaged."""
    path = tmp_path_factory.mktemp("campaign") / "hardware-gap"
    for name, episodes in (("late", 3), ("early", 2)):
        write_demo_run(path / name, episodes=episodes, profile="static-obstacles")
    (path / "gone").mkdir()
    (path / "gone" / "run.json").write_text("{}", encoding="utf-8")
    (path / CAMPAIGN_FILE).write_text("{}", encoding="utf-8")
    return path


def test_a_campaign_stands_for_its_runs(campaign: Path, folder: Path, tmp_path: Path) -> None:
    assert [each.name for each in run_folders(campaign)] == ["early", "gone", "late"]
    assert run_folders(folder) == [folder]
    (tmp_path / CAMPAIGN_FILE).write_text("{}", encoding="utf-8")
    with pytest.raises(UsageError, match="no run has begun"):
        run_folders(tmp_path)


def test_runs_are_named_by_their_folders_or_paths(campaign: Path, folder: Path) -> None:
    runs = ReplayedRuns([campaign / "late", folder, folder])
    assert runs.names == ("late", folder.name)
    assert runs.run("late") is runs.at(campaign / "late")
    assert runs.name_of(runs.run("late")) == "late"
    twins = [campaign / "late", campaign.parent / "other" / "late"]
    assert ReplayedRuns(twins).names == tuple(map(str, twins))


def test_any_two_runs_of_a_campaign_can_be_chosen(campaign: Path) -> None:
    viser = pytest.importorskip("viser")
    from airl_mav.addons.view.replay_page import ALONE, ReplayPage

    server, told = viser.ViserServer("127.0.0.1", 0, verbose=False), list[str]()
    try:
        runs = ReplayedRuns(run_folders(campaign))
        page = ReplayPage(server, runs.run("early"), runs=runs)
        elements = {
            handle.label: handle
            for handle in server.gui._gui_input_handle_from_uuid.values()
            if hasattr(handle, "label")
        }
        run, beside = elements["Run"], elements["Beside"]
        assert (run.value, beside.value) == ("early", ALONE)
        assert beside.options == (ALONE, "early", "gone", "late")

        def choose(handle: Any, name: str) -> None:
            handle.value = name
            notice = SimpleNamespace(add_notification=lambda *words, **_: told.append(words[1]))
            for act in handle._impl.update_cb:
                act(SimpleNamespace(client=notice))

        seed = page._flight.record.seed
        choose(run, "late")
        assert page._run is runs.run("late") and len(page._pick.options) == 3
        assert page._flight.record.seed == seed
        assert page._flight is runs.run("late").flight(page._flight.record)
        choose(beside, "early")
        assert page._other is not None and page._other.record.seed == seed
        assert page._part.visible
        # A damaged run is reported, and changes nothing.
        choose(run, "gone")
        choose(beside, "gone")
        assert len(told) == 2 and all("gone" in each for each in told)
        assert (run.value, beside.value) == ("late", "early")
        choose(beside, ALONE)
        assert page._other is None and not page._part.visible
    finally:
        server.stop()

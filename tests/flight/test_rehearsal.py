"""The harness's part of an episode: every order of events has one outcome.

Both processes have stand-ins, so that events arrive in a test's exact order. `test_sitl.py` and
`test_faults.py` fly real processes.
"""

from __future__ import annotations

import errno
import json
import queue
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.core.child_process import Exited
from airl_mav.core.errors import UsageError
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Effect
from airl_mav.latency.stamps import DecisionLog
from airl_mav.rehearsal import process_pair, rehearsal
from airl_mav.rehearsal.channel import (
    Abort,
    Due,
    Ended,
    Event,
    Failed,
    FinishEpisode,
    Fly,
    Loaded,
    LoadEpisode,
    LogLost,
    PhaseEntered,
    Ready,
    Saved,
    State,
    Text,
)
from airl_mav.rehearsal.observer import Observer
from airl_mav.rehearsal.process_pair import COMPANION, FIRMWARE
from airl_mav.rehearsal.rehearsal import Rehearsal, RehearsalError
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder, load, open_folder
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from firmware_sim.fault_timeline import Acted
from firmware_sim.recording import fault_arrays
from tests.support.run_demo import demo_arena, demo_episode

GOAL = (10.0, 0.0)
WATTS = 2.0
START_US = 1_000_000

Item = tuple[str, Event | Exited]
Script = list[Item | Callable[[], None]]


def at(seconds: float, north: float = 0.0, **more: Any) -> Item:
    """Return a state of the vehicle, `seconds` after the reset."""
    fields: dict[str, Any] = {
        "time_us": START_US + round(seconds * 1e6),
        "position": (north, 0.0, -2.0),
        "speed_m_s": 0.0,
        "battery": 1.0,
        "collision": None,
        "armed": True,
        "slipped_us": 0,
    }
    return FIRMWARE, State(**(fields | more))


def phase(name: str, seconds: float) -> Item:
    return COMPANION, PhaseEntered(phase=name, time_us=START_US + round(seconds * 1e6))


WARNED: Item = (
    FIRMWARE,
    Text(time_us=START_US + 4_000_000, severity=2, text="Failsafe activated"),
)


def ended(reason: str = "goal reached", *notes: str) -> Item:
    return COMPANION, Ended(reason=reason, notes=notes)


class Stage:
    """Stand-in for both processes; plays a script at the request to fly."""

    def __init__(self, *scripts: Script) -> None:
        self.scripts = list(scripts)
        self.events: queue.Queue[Item] | None = None
        self.children: dict[str, FakeChild] = {}
        """The newest of each."""
        self.all: list[FakeChild] = []
        self.on_abort: Callable[[Abort], list[Item]] = lambda _: [ended("stopped")]
        self.saves = True
        self.slips: list[tuple[int, int]] = []
        self.effects: list[Effect] = []
        self.faults: list[tuple[str, int, int]] = []
        """Faults that acted, each with begin and end [µs]."""
        self.goes_on: list[Item] = []
        """Events when a process resumes."""
        """`slips` holds the times at which the firmware skipped time, and the lengths [µs]."""
        self.starts: list[list[Item]] = []
        """Events at each start; both processes are ready once the list is empty."""

    def put(self, *items: Item) -> None:
        assert self.events is not None
        for item in items:
            self.events.put(item)

    def requests(self, name: str, kind: type) -> list[Any]:
        children = [child for child in self.all if child.name == name]
        return [r for child in children for r in child.requests if isinstance(r, kind)]


class FakeChild:
    """Answers requests at once, through the queue."""

    stage: Stage

    def __init__(
        self,
        name: str,
        *arguments: Any,
        keeps: Sequence[int],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        assert keeps == (7,)
        assert (name == COMPANION) == bool(environment)
        self.name, self.ending, self.stopped, self.log = name, False, 0, Path(f"{name}.log")
        self.requests: list[Any] = []
        self.standing: list[bool] = []
        stage = self.stage
        stage.events = arguments[-1]
        stage.children[name] = self
        stage.all.append(self)
        if name == COMPANION:
            ready: list[Item] = [(FIRMWARE, Ready()), (COMPANION, Ready())]
            stage.put(*(stage.starts.pop(0) if stage.starts else ready))

    def send(self, request: Any) -> None:
        self.requests.append(request)
        stage = self.stage
        if self.ending:
            return
        if isinstance(request, LoadEpisode):
            self.record = Path(request.record)
            stage.put(
                (
                    FIRMWARE,
                    Loaded(
                        time_us=START_US,
                        epoch_ns=0,
                        slipped_us=0,
                        goal=GOAL,
                        local_goal=GOAL,
                        poses="",
                    ),
                )
            )
        elif isinstance(request, Fly):
            self.decisions = Path(request.record)
            for item in stage.scripts.pop(0):
                if callable(item):
                    item()
                else:
                    stage.put(item)
        elif isinstance(request, Abort):
            stage.put(*stage.on_abort(request))
        elif isinstance(request, FinishEpisode) and stage.saves:
            self.save()
            stage.put((FIRMWARE, Saved()))

    def save(self) -> None:
        stage = self.stage
        write_record(self.record, stage.slips, stage.effects, stage.faults)

    def suspend(self) -> None:
        self.standing.append(True)

    def resume(self) -> None:
        self.standing.append(False)
        self.stage.put(*self.stage.goes_on)

    def stop(self) -> None:
        self.ending = True
        self.stopped += 1

    def kill(self) -> None:
        self.ending = True

    def log_tail(self) -> str:
        return "last words"


def write_record(
    path: Path,
    slips: Sequence[tuple[int, int]],
    effects: Sequence[Effect],
    faults: Sequence[tuple[str, int, int]],
) -> None:
    """Write the firmware's files of an episode: 100 s at 10 m/s to the north."""
    n = 5001
    time_us = START_US + np.arange(n, dtype=np.int64) * 20_000
    position = np.zeros((n, 3))
    position[:, 0] = 0.2 * np.arange(n)
    arrays: dict[str, Any] = {
        "trajectory/time_us": time_us,
        "trajectory/position": position,
        "trajectory/velocity": np.tile([10.0, 0.0, 0.0], (n, 1)),
        "trajectory/quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        "trajectory/power_w": np.full(n, 100.0),
        "setpoints/accepted_us": np.array([START_US + 2_100_000]),
        "setpoints/motor_us": np.array([START_US + 2_103_000]),
        "setpoints/setpoint": np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        "estimate/time_us": np.zeros(0, np.int64),
        "tick/lateness_us": np.zeros(3, np.int64),
        "tick/slips_us": np.array(slips, np.int64).reshape(-1, 2),
        "commands/effects": np.array([json.dumps(asdict(e)) for e in effects], np.str_),
    }
    acted = [Acted(*each) for each in faults]
    arrays |= fault_arrays(acted)
    np.savez(path, **arrays)


class Silent(Observer):
    """An observer that keeps the records."""

    def __init__(self) -> None:
        self.records: list[EpisodeRecord] = []
        self.texts: list[str] = []
        self.losses: list[str] = []

    def text(self, text: Text) -> None:
        self.texts.append(text.text)

    def finished(self, record: EpisodeRecord) -> None:
        self.records.append(record)

    def lost(self, what: str) -> None:
        self.losses.append(what)


def asked(**changes: Any) -> ResolvedScenario:
    """Return a scenario with a round goal radius, time limit and power of the computer."""
    fields = {"policy": "greedy", "seed": 5, "episodes": 1, "time_limit_s": 60.0} | changes
    resolved = resolve(Scenario(**fields))
    watts = resolved.computer.model_copy(update={"watts": WATTS})
    return replace(resolved, computer=watts)


class Run:
    """One rehearsal on a stage."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, stage: Stage) -> None:
        FakeChild.stage = stage
        monkeypatch.setattr(process_pair, "Child", FakeChild)
        monkeypatch.setattr(process_pair, "REPLY_TIMEOUT_S", 0.3)
        self.scenario = asked(episodes=max(1, len(stage.scripts)))
        self.folder = RunFolder.create(folder / "run", "test", {}, setup=self.scenario.setup)
        self.stage = stage
        self.observer = Silent()

    def fly(
        self, episodes: int | None = None, done: Collection[int] = (), **more: Any
    ) -> list[EpisodeRecord]:
        if episodes is not None:
            self.scenario = asked(episodes=episodes, **more)
        with Rehearsal(self.scenario, self.folder, self.observer, keeps=(7,)) as flown:
            flown.run(done)
        assert all(child.stopped for child in self.stage.all)
        return self.observer.records


@pytest.fixture
def play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    return lambda *scripts, folder="": Run(tmp_path / folder, monkeypatch, Stage(*scripts))


FLOWN: Script = [
    at(0.5),
    phase("navigating", 2.0),
    at(2.5, 1.0),
    at(9.0, 8.0),
    ended(),
]


def test_two_good_episodes(play: Callable[..., Run]) -> None:
    run = play(FLOWN, FLOWN)
    first, second = run.fly()
    for index, record in enumerate((first, second)):
        assert (record.index, record.seed, record.arena_seed) == (index, 5 + index, 5 + index)
        assert record.outcome == "success"
        assert record.quality is not None
        assert record.quality.flight_time_s == pytest.approx(7.0)
        assert record.quality.distance_m == pytest.approx(70.0)
        assert record.quality.energy_j == pytest.approx(700.0)
        assert record.quality.computer_energy_j == 0.0  # the workstation stays on the ground
    stage = run.stage
    assert stage.requests(COMPANION, Abort) == []
    assert [r.seed for r in stage.requests(COMPANION, Fly)] == [5, 6]
    assert [e.index for e in load(run.folder.path).episodes] == [0, 1]
    assert not list(run.folder.path.glob(".*"))


def test_goal_and_collision_in_one_sample_is_a_success(play: Callable[..., Run]) -> None:
    (record,) = play(
        [phase("navigating", 2.0), at(9.0, 8.0, collision="box 3"), ended()],
    ).fly()
    assert record.outcome == "success"


def test_verdict_stands_whatever_comes_after(play: Callable[..., Run]) -> None:
    after: Script = [
        *FLOWN[:-1],
        at(9.1, 9.0, collision="wall north"),
        at(9.2, 9.0, battery=0.0),
        ended("link lost", "it was windy"),
    ]
    run = play(after)
    (record,) = run.fly()
    assert record.outcome == "success"
    assert record.ended_us == START_US + 9_000_000
    assert record.notes == ("it was windy",)
    assert run.stage.requests(COMPANION, Abort) == []


@pytest.mark.parametrize(
    ("sample", "outcome", "land"),
    [
        (at(5.0, 4.0, collision="box 3"), "collision", False),
        (at(5.0, 4.0, battery=0.0), "battery", False),
        (at(62.5, 4.0), "timeout", True),
    ],
)
def test_the_companion_is_called_off(
    play: Callable[..., Run], sample: Item, outcome: str, land: bool
) -> None:
    run = play([phase("navigating", 2.0), at(2.5), sample])
    (record,) = run.fly()
    assert record.outcome == outcome
    assert run.stage.requests(COMPANION, Abort) == [Abort(land=land)]


def test_collision_before_navigation(play: Callable[..., Run]) -> None:
    (record,) = play([at(1.0, collision="wall east")]).fly()
    assert (record.outcome, record.quality) == ("collision", None)
    assert record.reason == "hit wall east during the take-off"


def test_navigation_that_never_begins(play: Callable[..., Run]) -> None:
    run = play([at(1.0), phase("arming", 1.0), at(91.0)])
    (record,) = run.fly()
    assert (record.outcome, record.reason) == ("aborted", "navigation never began")
    assert record.navigation_us is None
    assert run.stage.requests(COMPANION, Abort) == [Abort(land=True)]


def test_mission_that_ends_early_is_aborted_with_its_reason(play: Callable[..., Run]) -> None:
    early: Script = [at(1.0), ended("arming failed: command denied")]
    first, second = play(early, FLOWN).fly()
    assert (first.outcome, first.reason) == ("aborted", "arming failed: command denied")
    assert second.outcome == "success"


def test_success_that_nobody_notices_is_called_off(play: Callable[..., Run]) -> None:
    """The companion still looks for the goal, or lies on its back under it."""
    run = play([*FLOWN[:-1], at(18.9, 8.0), at(19.1, 8.0), at(19.2, 8.0)])
    (record,) = run.fly()
    assert record.outcome == "success"
    assert run.stage.requests(COMPANION, Abort) == [Abort(land=True)]


def test_success_then_crash_is_called_off_without_landing(play: Callable[..., Run]) -> None:
    run = play([*FLOWN[:-1], at(19.1, 8.0, collision="floor")])
    run.fly()
    assert run.stage.requests(COMPANION, Abort) == [Abort(land=False)]


def test_time_given_up_is_taken_off_the_companions_clock(
    play: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The skipped time makes the flight invalid; the limit prevents another attempt.
    monkeypatch.setattr(rehearsal, "MAX_ATTEMPTS", 1)
    run = play(
        [
            at(0.5),
            at(1.0, slipped_us=3_000_000),
            # 5.1 s of the companion's clock are 2 s of the simulator's clock, which has skipped
            # another 0.1 s. No state has reported the skip yet.
            phase("navigating", 5.1),
            at(2.5, 1.0, slipped_us=3_100_000),
            at(9.0, 8.0, slipped_us=3_500_000),
            ended(),
        ],
    )
    when = [(1.0, 3.0), (1.5, 0.1), (9.0, 0.4)]
    run.stage.slips = [(START_US + int(at_s * 1e6), int(lost_s * 1e6)) for at_s, lost_s in when]
    (record,) = run.fly()
    assert record.navigation_us == START_US + 2_000_000
    assert record.slipped_us == 3_500_000
    assert record.invalid == ("28.0 % of its simulated time was given up (limit 1 %)",)


DISTURBED: Script = [
    at(0.5),
    phase("navigating", 2.0),
    at(2.5, 1.0),
    at(9.0, 8.0, slipped_us=1_000_000),
    ended(),
]
FAULT = "10.0 % of its simulated time was given up (limit 1 %)"


def test_a_flight_that_the_host_disturbed_is_flown_again(play: Callable[..., Run]) -> None:
    run = play(DISTURBED, FLOWN)
    (record,) = run.fly(episodes=1)
    assert (record.outcome, record.invalid, record.slipped_us) == ("success", (), 0)
    assert record.notes == (f"flown again: invalid: {FAULT}",)
    assert run.observer.losses == [f"flight 000, seed 5 is invalid and begins again: {FAULT}"]
    # The same processes: nothing is wrong with them.
    assert len(run.stage.all) == 2
    assert [r.seed for r in run.stage.requests(COMPANION, Fly)] == [5, 5]
    assert len(load(run.folder.path).episodes) == 1
    assert not list(run.folder.path.glob(".*"))


def test_what_stays_invalid_is_kept_with_its_reasons(play: Callable[..., Run]) -> None:
    run = play(DISTURBED, DISTURBED, DISTURBED, FLOWN)
    first, second = run.fly(episodes=2)
    assert first.invalid == (FAULT,)
    assert first.notes == (f"flown again: invalid: {FAULT}",) * 2
    assert second.invalid == ()
    held = load(run.folder.path).episodes
    assert [episode.invalid for episode in held] == [(FAULT,), ()]


IN_FLIGHT_US = START_US + 3_000_000


def changed(**fields: Any) -> Effect:
    """Return the effect of a ground station that sets a parameter in flight."""
    usual = Effect(
        *("gcs", "", 255, 190, "PARAM_SET MPC_XY_VEL_MAX", 1, IN_FLIGHT_US, False, 12.0, 3.0)
    )
    return replace(usual, **fields)


CHANGED = (
    "gcs, system 255 component 190, PARAM_SET MPC_XY_VEL_MAX from 12 to 3"
    " (once, first 3.0 s after the reset)"
)


@pytest.mark.parametrize(
    ("effect", "options", "invalid", "notes"),
    [
        (changed(), {}, (f"commanded by a stranger: {CHANGED}",), ()),
        (changed(), {"ground_station": True}, (), (f"commanded by {CHANGED}",)),
        (changed(), {"validity": False}, (), (f"commanded by {CHANGED}",)),
        (
            changed(link="onboard"),
            {"ground_station": True},
            (f"commanded by a stranger: {CHANGED.replace('gcs', 'onboard')}",),
            (),
        ),
        (changed(is_companion=True), {}, (), ()),
        (changed(first_us=START_US + 90_000_000), {}, (), ()),
    ],
    ids=["unasked", "permitted", "unchecked", "another link", "companion", "after the verdict"],
)
def test_an_effect_of_another_sender_makes_a_flight_invalid(
    play: Callable[..., Run],
    monkeypatch: pytest.MonkeyPatch,
    effect: Effect,
    options: dict[str, Any],
    invalid: tuple[str, ...],
    notes: tuple[str, ...],
) -> None:
    monkeypatch.setattr(rehearsal, "MAX_ATTEMPTS", 1)
    run = play(FLOWN)
    run.stage.effects = [effect]
    (record,) = run.fly(episodes=1, **options)
    assert (record.invalid, record.notes) == (invalid, notes)
    assert load(run.folder.path).episodes[0].effects == record.effects == (effect,)


def test_a_run_with_invalid_flights_goes_on_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are taken out of the run before they are flown again: a kill leaves no half of one."""
    scenario = asked(episodes=2)
    out = tmp_path / "run"
    folder, done = open_folder(out, "test", scenario)
    assert done == ()
    record, path, latency = demo_episode(0, demo_arena(1))
    disturbed = replace(record, invalid=(FAULT,))
    folder.save_episodes([FlownEpisode(disturbed, path, latency)])
    folder.save_episodes([FlownEpisode(replace(record, index=1), path, latency)])
    _, done = open_folder(out, "test", scenario)
    assert [episode.index for episode in done] == [1]
    assert [episode.index for episode in load(out).episodes] == [1]
    folder.save_episodes([FlownEpisode(record, path, latency)])
    _, done = open_folder(out, "test", scenario)
    assert [episode.index for episode in done] == [0, 1]


def test_decisions_are_joined_with_the_setpoints(play: Callable[..., Run]) -> None:
    run = play([*FLOWN])

    def leave_log() -> None:
        log = DecisionLog()
        second = START_US + 2_000_000
        log.record(
            second, second + 10, second + 20, second + 30, second + 40, second + 50, (1, 0, 0, 0)
        )
        columns: dict[str, Any] = {**log.columns()}
        np.savez(run.stage.children[COMPANION].decisions, **columns)

    run.stage.scripts[0].insert(0, leave_log)
    run.fly()
    stamps = load(run.folder.path).latency[0]
    assert stamps["accepted_us"].tolist() == [START_US + 2_100_000]
    assert stamps["motor_us"].tolist() == [START_US + 2_103_000]
    assert not list(run.folder.path.glob(".*"))


def test_what_is_there_is_not_flown(play: Callable[..., Run]) -> None:
    run = play(FLOWN)
    (record,) = run.fly(3, done={0, 2})
    assert (record.index, record.seed) == (1, 6)
    assert [request.seed for request in run.stage.requests(FIRMWARE, LoadEpisode)] == [6]


def test_nothing_is_started_when_there_is_nothing_to_fly(play: Callable[..., Run]) -> None:
    run = play()
    assert run.fly(2, done={0, 1}) == []
    assert run.stage.all == []


# --- a process dies

DIED: Item = (COMPANION, Exited(-9))


def test_a_flight_that_lost_its_companion_is_flown_again(play: Callable[..., Run]) -> None:
    """Two new processes fly again after the failsafe has ended."""
    run = play(
        FLOWN,
        [
            phase("navigating", 2.0),
            at(3.0, 1.0),
            DIED,
            (FIRMWARE, Text(time_us=START_US + 4_100_000, severity=2, text="Failsafe activated")),
            at(5.0, 1.0),
            at(8.0, 1.0, armed=False),
        ],
        FLOWN,
        FLOWN,
    )
    records = run.fly(3)
    assert [(r.index, r.seed, r.outcome.value) for r in records] == [
        (0, 5, "success"),
        (1, 6, "success"),
        (2, 7, "success"),
    ]
    told = "the companion died (SIGKILL); autopilot at 5.10 s: Failsafe activated"
    assert [r.notes for r in records] == [(), (f"flown again: {told}",), ()]
    (loss,) = run.observer.losses
    assert loss.startswith(f"flight 001, seed 6 begins again: {told}; log: companion.log")
    assert loss.endswith("last words")
    assert run.observer.texts == ["Failsafe activated"]
    # A line each, the same seed and files both times.
    assert [e.index for e in load(run.folder.path).episodes] == [0, 1, 2]
    loads = run.stage.requests(FIRMWARE, LoadEpisode)
    assert [request.seed for request in loads] == [5, 6, 6, 7]
    assert loads[1] == loads[2]
    assert [child.name for child in run.stage.all] == 2 * [FIRMWARE, COMPANION]
    assert not list(run.folder.path.glob(".*"))


def test_companion_that_fails_and_then_exits_is_one_fault(play: Callable[..., Run]) -> None:
    """Its exit is no news, and must not cut short the look at the failsafe."""
    run = play(
        [
            at(1.0),
            (COMPANION, Failed(message="no flight controller heard")),
            (COMPANION, Exited(1)),
            at(2.0),
            (FIRMWARE, Text(time_us=START_US, severity=2, text="Failsafe activated")),
            at(3.0, armed=False),
        ],
        FLOWN,
    )
    (record,) = run.fly(1)
    assert record.outcome == "success"
    (note,) = record.notes
    assert note.startswith("flown again: the companion gave up: no flight controller heard; auto")


@pytest.mark.parametrize(
    ("end", "told"),
    [
        (Exited(-11), "the firmware died (SIGSEGV)"),
        (Exited(3), "the firmware died (exit status 3)"),
        (Failed(message="no such thing"), "the firmware gave up: no such thing"),
    ],
)
def test_a_lost_firmware_is_not_waited_for(
    play: Callable[..., Run], end: Exited | Failed, told: str
) -> None:
    run = play([at(1.0), (FIRMWARE, end)], FLOWN)
    (record,) = run.fly(1)
    assert record.outcome == "success"
    assert record.notes == (f"flown again: {told}",)
    assert len(run.stage.requests(FIRMWARE, FinishEpisode)) == 1


def test_firmware_that_dies_under_the_failsafe(play: Callable[..., Run]) -> None:
    run = play([at(1.0), (COMPANION, Exited(1)), at(2.0), (FIRMWARE, Exited(-9))], FLOWN)
    (record,) = run.fly(1)
    assert record.notes == (
        "flown again: the companion died (exit status 1); the firmware died (SIGKILL)",
    )


def test_a_flight_without_its_decisions_is_none(play: Callable[..., Run]) -> None:
    """At the goal, but the companion dies on the way down and its log with it."""
    run = play([*FLOWN[:-1], DIED, at(12.0, 8.0, armed=False)], FLOWN)
    (record,) = run.fly(1)
    assert record.outcome == "success"
    assert record.notes == ("flown again: the companion died (SIGKILL)",)
    assert len(load(run.folder.path).episodes) == 1


@pytest.mark.parametrize("reason", ["link lost", "camera silent"])
def test_processes_that_lost_each_other_fly_again(play: Callable[..., Run], reason: str) -> None:
    run = play([phase("navigating", 2.0), at(3.0, 1.0), ended(reason, "watchdog at 3 s")], FLOWN)
    (record,) = run.fly(1)
    assert record.outcome == "success"
    assert record.notes == (f"flown again: firmware and companion lost each other ({reason})",)
    assert len(run.stage.all) == 4


def test_a_log_on_a_full_disk_is_a_note(play: Callable[..., Run]) -> None:
    what = "run/flight-000.tlog: No space left on device; the log ends after 9 bytes"
    (record,) = play([*FLOWN[:-1], (FIRMWARE, LogLost(what=what)), ended()]).fly()
    assert (record.outcome, record.notes) == ("success", (what,))


# --- requested faults of the processes


def due(fault: str, seconds: float, *, begins: bool = True) -> Item:
    return FIRMWARE, Due(time_us=START_US + round(seconds * 1e6), fault=fault, begins=begins)


def test_a_killed_companion_is_no_loss(play: Callable[..., Run]) -> None:
    """The flight controller's failsafe lands the vehicle; the next flight has two new processes."""
    fault = "companion killed at 3s"
    down = [due(fault, 3.0), (COMPANION, Exited(-9)), WARNED, at(6.0, 4.0, armed=False)]
    run = play([phase("navigating", 2.0), at(2.9, 1.0), *down], FLOWN)
    run.stage.faults = [(fault, START_US + 3_000_000, START_US + 6_000_000)]
    lost, flown = run.fly(2, faults=(fault,))
    assert (lost.outcome, lost.reason, lost.invalid) == ("aborted", "companion killed", ())
    assert lost.ended_us == START_US + 6_000_000
    assert lost.notes == (
        "companion killed at 4.00 s, as asked for",
        "autopilot at 5.00 s: Failsafe activated",
    )
    assert [each.fault for each in lost.faults] == [fault]
    assert (flown.outcome, run.observer.losses, len(run.stage.all)) == ("success", [], 4)


def test_a_companion_that_stood_to_the_end_says_what_it_knows(play: Callable[..., Run]) -> None:
    fault = "companion stopped at 3s"
    run = play([phase("navigating", 2.0), at(2.9, 1.0), due(fault, 3.0), at(6.0, 4.0, armed=False)])
    (record,) = run.fly(1, faults=(fault,))
    assert (record.outcome, record.reason) == ("aborted", "companion stopped")
    assert run.stage.children[COMPANION].standing == [True, False]
    assert run.stage.requests(COMPANION, Abort) == [Abort(land=False)]


def test_a_companion_that_stood_for_a_while_flies_on(play: Callable[..., Run]) -> None:
    fault = "companion stopped at 3s for 1s"
    stood = [due(fault, 3.0), at(3.5, 2.0), due(fault, 4.0, begins=False)]
    run = play([phase("navigating", 2.0), at(2.9, 1.0), *stood, at(9.0, 8.0), ended()])
    (record,) = run.fly(1, faults=(fault,))
    assert record.outcome == "success"
    assert run.stage.children[COMPANION].standing == [True, False]


def test_a_killed_firmware_leaves_what_was_flown(play: Callable[..., Run]) -> None:
    fault = "firmware killed at 3s"
    begun: Script = [phase("navigating", 2.0), at(2.9, 1.0)]
    run = play(begun, FLOWN)
    begun += [
        lambda: run.stage.children[FIRMWARE].save(),
        *(due(fault, 3.0), (FIRMWARE, Exited(-9)), ended("link lost")),
    ]
    run.stage.faults = [(fault, START_US + 3_000_000, START_US + 3_000_000)]
    lost, flown = run.fly(2, faults=(fault,))
    assert (lost.outcome, lost.reason) == ("aborted", "firmware killed")
    assert (flown.outcome, run.observer.losses, len(run.stage.all)) == ("success", [], 4)
    assert len(run.stage.requests(FIRMWARE, FinishEpisode)) == 1


def test_a_stopped_firmware_goes_on_by_the_wall_clock(play: Callable[..., Run]) -> None:
    """Simulated time stops: only the rehearsal can time the end of the fault."""
    fault = "firmware stopped at 3s for 50ms"
    run = play([phase("navigating", 2.0), at(2.9, 1.0), due(fault, 3.0)])
    run.stage.goes_on = [at(9.0, 8.0), ended()]
    (record,) = run.fly(1, faults=(fault,))
    assert record.outcome == "success"
    assert run.stage.children[FIRMWARE].standing == [True, False]


@pytest.mark.parametrize("acted", [True, False])
def test_a_companion_that_a_fault_kept_from_hearing_is_not_flown_again(
    play: Callable[..., Run], *, acted: bool
) -> None:
    """Unless the fault had not begun yet."""
    fault = "camera off at 3s"
    run = play([phase("navigating", 2.0), at(3.0, 1.0), ended("camera silent")], FLOWN)
    if acted:
        run.stage.faults = [(fault, START_US + 3_000_000, START_US + 9_000_000)]
    (record,) = run.fly(1, faults=(fault,))
    assert record.outcome == ("aborted" if acted else "success")
    assert len(run.observer.losses) == (0 if acted else 1)


@pytest.mark.parametrize("reason", ["watchdog", "policy failed: RuntimeError: out of ideas"])
def test_what_a_policy_does_is_not_flown_again(play: Callable[..., Run], reason: str) -> None:
    (record,) = play([phase("navigating", 2.0), at(3.0, 1.0), ended(reason)]).fly(1)
    assert (record.outcome, record.reason, record.notes) == ("aborted", reason, ())


@pytest.mark.parametrize(
    "script",
    [
        [at(1.0), DIED, at(2.0, armed=False)],
        [at(1.0), (FIRMWARE, Exited(-9))],
        [at(1.0), ended("link lost")],
    ],
)
def test_a_flight_that_is_lost_every_time_ends_the_run(
    play: Callable[..., Run], script: Script
) -> None:
    run = play(FLOWN, script, script, script, FLOWN)
    with pytest.raises(RehearsalError, match="flight 001, seed 6: lost 3 times; at last "):
        run.fly(3)
    assert len(run.observer.losses) == 2
    # Earlier flights are kept; the lost flights leave nothing.
    assert [record.index for record in run.observer.records] == [0]
    assert [e.index for e in load(run.folder.path).episodes] == [0]
    assert all(child.stopped for child in run.stage.all)


def test_losses_are_counted_by_flight(play: Callable[..., Run]) -> None:
    lost: Script = [at(1.0), (FIRMWARE, Exited(-9))]
    records = play(lost, lost, FLOWN, lost, lost, FLOWN).fly(2)
    assert [len(record.notes) for record in records] == [2, 2]


def test_ended_but_never_saved(play: Callable[..., Run]) -> None:
    run = play(FLOWN, FLOWN, FLOWN)
    run.stage.saves = False
    with pytest.raises(RehearsalError, match="gave up waiting for the event 'Saved'"):
        run.fly(1)
    assert run.observer.records == []
    assert all(child.stopped for child in run.stage.all)


def test_companion_that_never_answers_is_ended(
    play: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hung companion is ended, which triggers the flight controller's failsafe."""
    for name in ("TAKEOFF_LIMIT_S", "WRAP_UP_S"):
        monkeypatch.setattr(rehearsal, name, 0.1)
    run = play([at(0.05), phase("navigating", 0.06), at(0.08)], FLOWN)
    run.scenario = asked(time_limit_s=1.0)
    (record,) = run.fly()
    (note,) = record.notes
    assert re.fullmatch(
        "flown again: gave up waiting for the flight after 1 s; "
        "gave up waiting for the vehicle to come down after 0 s",
        note,
    )


@pytest.mark.parametrize("name", [FIRMWARE, COMPANION])
def test_refusal_at_the_start_is_a_usage_error(play: Callable[..., Run], name: str) -> None:
    run = play(FLOWN)
    refused: Item = (name, Failed(message="port 1 is taken", usage=True))
    run.stage.starts = [[(FIRMWARE, Ready()), refused]]
    with pytest.raises(UsageError, match="port 1 is taken"):
        run.fly()
    assert len(run.stage.all) == 2
    assert all(child.stopped for child in run.stage.all)


def test_refusal_in_flight_is_a_usage_error_too(play: Callable[..., Run]) -> None:
    """Not again: the same input is refused the same way."""
    run = play(FLOWN, [(COMPANION, Failed(message="cannot use this camera", usage=True))])
    with pytest.raises(UsageError, match="cannot use this camera"):
        run.fly()
    assert [record.index for record in run.observer.records] == [0]
    assert len(run.stage.all) == 2
    assert all(child.stopped for child in run.stage.all)


def test_a_full_disk_of_a_process_ends_the_run(play: Callable[..., Run]) -> None:
    """No second attempt: the disk stays full."""
    failed = Failed(message="run/episode.npz", errno=errno.ENOSPC)
    run = play(FLOWN, [(FIRMWARE, failed)])
    with pytest.raises(OSError, match=r"No space left on device: 'run/episode.npz'"):
        run.fly()
    assert len(run.stage.all) == 2
    assert all(child.stopped for child in run.stage.all)


def test_death_at_the_start(play: Callable[..., Run]) -> None:
    run = play(FLOWN)
    died: list[Item] = [(FIRMWARE, Ready()), (COMPANION, Exited(1))]
    run.stage.starts = [died, died]
    (record,) = run.fly()
    assert record.notes == 2 * ("flown again: the companion died (exit status 1)",)
    run = play(FLOWN, folder="again")
    run.stage.starts = [died, died, died]
    with pytest.raises(RehearsalError, match=r"companion died \(exit status 1\)(.|\n)*last words"):
        run.fly()


def test_interrupt_while_a_new_pair_starts(
    play: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = play([at(1.0), (FIRMWARE, Exited(-9))])
    real = FakeChild.__init__

    def interrupted(child: FakeChild, name: str, *words: Any, **more: Any) -> None:
        if len(run.stage.all) == 3:
            raise KeyboardInterrupt
        real(child, name, *words, **more)

    monkeypatch.setattr(FakeChild, "__init__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.fly()
    assert len(run.stage.all) == 3
    assert all(child.stopped for child in run.stage.all)


def test_second_interrupt_kills(play: Callable[..., Run], monkeypatch: pytest.MonkeyPatch) -> None:
    run = play(FLOWN)
    killed: list[str] = []

    def impatient(_child: FakeChild) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(FakeChild, "stop", impatient)
    monkeypatch.setattr(FakeChild, "kill", lambda child: killed.append(child.name))
    with pytest.raises(KeyboardInterrupt):
        run.fly()
    assert sorted(killed) == [COMPANION, FIRMWARE]

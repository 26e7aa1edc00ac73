"""The harness's part of an episode: every order of events has one outcome.

The two processes are stood in for, so that events come in exactly the order that a test asks for;
`test_sitl.py` and `test_faults.py` fly real ones.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.channel import (
    Abort,
    Ended,
    Event,
    Failed,
    FinishEpisode,
    Fly,
    Loaded,
    LoadEpisode,
    Progress,
    Ready,
    Saved,
    State,
    Text,
)
from airl_mav.errors import UsageError
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.setup import Part, Setup
from airl_mav.harness import rehearsal
from airl_mav.harness.episode import Plan, ProcessPlan
from airl_mav.harness.process import Exited
from airl_mav.harness.rehearsal import COMPANION, FIRMWARE, Rehearsal, RehearsalError
from airl_mav.harness.run_folder import RunFolder, load
from airl_mav.latency.injection import NOTHING_INJECTED
from airl_mav.latency.stamps import DecisionLog

GOAL = (10.0, 0.0)
START_US = 1_000_000

Item = tuple[str, Event | Exited]
Script = list[Item | Callable[[], None]]


def at(seconds: float, north: float = 0.0, **more: Any) -> Item:
    """A state of the vehicle, so long after the reset."""
    fields: dict[str, Any] = {
        "time_us": START_US + round(seconds * 1e6),
        "position": (north, 0.0, -2.0),
        "speed_m_s": 0.0,
        "yaw": 0.0,
        "battery": 1.0,
        "collision": None,
        "mode": "offboard",
        "armed": True,
        "landed": False,
        "slipped_us": 0,
    }
    return FIRMWARE, State(**(fields | more))


def phase(name: str, seconds: float) -> Item:
    return COMPANION, Progress(phase=name, time_us=START_US + round(seconds * 1e6))


def ended(reason: str = "goal reached", *notes: str) -> Item:
    return COMPANION, Ended(reason=reason, notes=notes, path="")


class Stage:
    """Stands in for both processes; plays a script when told to fly."""

    def __init__(self, *scripts: Script) -> None:
        self.scripts = list(scripts)
        self.events: queue.Queue[Item] | None = None
        self.children: dict[str, FakeChild] = {}
        self.on_abort: Callable[[Abort], list[Item]] = lambda _: [ended("stopped")]
        self.saves = True
        self.ready: list[Item] = [(FIRMWARE, Ready()), (COMPANION, Ready())]

    def put(self, *items: Item) -> None:
        assert self.events is not None
        for item in items:
            self.events.put(item)

    def requests(self, name: str, kind: type) -> list[Any]:
        return [r for r in self.children[name].requests if isinstance(r, kind)]


class FakeChild:
    """Answers requests at once, through the queue."""

    stage: Stage

    def __init__(self, name: str, *arguments: Any) -> None:
        self.name, self.ending, self.stopped, self.log = name, False, 0, Path(f"{name}.log")
        self.requests: list[Any] = []
        stage = self.stage
        stage.events = arguments[-1]
        stage.children[name] = self
        if len(stage.children) == 2:
            stage.put(*stage.ready)

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
                        episode=request.episode,
                        time_us=START_US,
                        epoch_ns=0,
                        slipped_us=0,
                        goal=GOAL,
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
            write_record(self.record)
            stage.put((FIRMWARE, Saved(path=str(self.record))))

    def stop(self) -> None:
        self.ending = True
        self.stopped += 1

    def kill(self) -> None:
        self.ending = True

    def log_tail(self) -> str:
        return "last words"


def write_record(path: Path) -> None:
    """What the firmware leaves of an episode: 100 s at 10 m/s to the north."""
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
        "tick/slips_us": np.zeros((0, 2), np.int64),
    }
    np.savez(path, **arrays)


class Silent:
    """An observer that keeps the records."""

    def __init__(self) -> None:
        self.records: list[EpisodeRecord] = []
        self.texts: list[str] = []

    def waiting(self, what: str) -> None: ...
    def episode(self, index: int, seed: int, goal: tuple[float, float]) -> None: ...
    def phase(self, phase: str, time_us: int) -> None: ...
    def state(self, state: State, started_us: int) -> None: ...

    def text(self, text: Text) -> None:
        self.texts.append(text.text)

    def finished(self, record: EpisodeRecord) -> None:
        self.records.append(record)


class Run:
    """One rehearsal on a stage."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, stage: Stage) -> None:
        FakeChild.stage = stage
        monkeypatch.setattr(rehearsal, "Child", FakeChild)
        monkeypatch.setattr(rehearsal, "REPLY_TIMEOUT_S", 0.3)
        part = Part("x")
        setup = Setup("sitl", part, part, part, part, 2.0, NOTHING_INJECTED, 1.0, "persist")
        self.folder = RunFolder.create(folder / "run", "test", {}, setup=setup)
        self.stage = stage
        self.observer = Silent()
        process = ProcessPlan("nothing", [])
        self.plan = Plan(process, process, "corridor", 5, len(stage.scripts), 3.0, 60.0, 1.0, 2.0)

    def fly(self) -> list[EpisodeRecord]:
        with Rehearsal(self.plan, self.folder, self.observer) as flown:
            flown.run()
        return self.observer.records


@pytest.fixture
def play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    return lambda *scripts: Run(tmp_path, monkeypatch, Stage(*scripts))


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
        assert record.quality.computer_energy_j == pytest.approx(14.0)
    stage = run.stage
    assert stage.requests(COMPANION, Abort) == []
    assert [r.latency_seed for r in stage.requests(COMPANION, Fly)] == [5, 6]
    assert all(child.stopped for child in stage.children.values())
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


def test_time_given_up_is_taken_off_the_companions_clock(play: Callable[..., Run]) -> None:
    (record,) = play(
        [
            at(0.5),
            at(1.0, slipped_us=3_000_000),
            # 5 s by the companion's clock is 2 s by the simulator's.
            phase("navigating", 5.0),
            at(2.5, 1.0, slipped_us=3_000_000),
            at(9.0, 8.0, slipped_us=3_500_000),
            ended(),
        ],
    ).fly()
    assert record.navigation_us == START_US + 2_000_000
    assert record.slipped_us == 3_500_000


def test_decisions_are_joined_with_the_setpoints(play: Callable[..., Run]) -> None:
    run = play([*FLOWN])

    def leave_log() -> None:
        log = DecisionLog()
        second = START_US + 2_000_000
        log.record(
            second, second + 10, second + 20, second + 30, second + 40, second + 50, (1, 0, 0, 0)
        )
        np.savez(run.stage.children[COMPANION].decisions, **log.columns())

    run.stage.scripts[0].insert(0, leave_log)
    run.fly()
    stamps = load(run.folder.path).latency[0]
    assert stamps["accepted_us"].tolist() == [START_US + 2_100_000]
    assert stamps["motor_us"].tolist() == [START_US + 2_103_000]
    assert not list(run.folder.path.glob(".*"))


# --- somebody dies


def test_dead_companion_is_saved_as_aborted(play: Callable[..., Run]) -> None:
    run = play(
        [
            phase("navigating", 2.0),
            at(3.0, 1.0),
            (COMPANION, Exited(-9)),
            (FIRMWARE, Text(time_us=START_US + 4_100_000, severity=2, text="Failsafe activated")),
            at(5.0, 1.0),
            at(8.0, 1.0, armed=False),
        ],
        FLOWN,
    )
    with pytest.raises(RehearsalError, match="the companion process died: killed by signal 9"):
        run.fly()
    (record,) = run.observer.records
    assert record.outcome == "aborted"
    assert record.ended_us == START_US + 3_000_000
    assert record.notes == ("autopilot at 5.10 s: Failsafe activated",)
    assert all(child.stopped for child in run.stage.children.values())


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
    )
    with pytest.raises(RehearsalError, match="companion: no flight controller heard"):
        run.fly()
    (record,) = run.observer.records
    assert len(record.notes) == 1, record.notes


def test_dead_firmware_ends_at_once(play: Callable[..., Run]) -> None:
    run = play([at(1.0), (FIRMWARE, Exited(-11))], FLOWN)
    with pytest.raises(RehearsalError, match="the firmware process died: killed by signal 11"):
        run.fly()
    assert run.observer.records == []
    assert run.stage.requests(FIRMWARE, FinishEpisode) == []


def test_failed_firmware_is_not_waited_for(play: Callable[..., Run]) -> None:
    run = play([at(1.0), (FIRMWARE, Failed(message="no such thing")), (FIRMWARE, Exited(2))])
    with pytest.raises(RehearsalError, match="firmware: no such thing"):
        run.fly()
    assert run.stage.requests(FIRMWARE, FinishEpisode) == []


def test_firmware_that_dies_under_the_failsafe(play: Callable[..., Run]) -> None:
    run = play([at(1.0), (COMPANION, Exited(1)), at(2.0), (FIRMWARE, Exited(-9))])
    with pytest.raises(RehearsalError, match="the companion process died: exit code 1"):
        run.fly()
    assert run.stage.requests(FIRMWARE, FinishEpisode) == []


def test_success_and_then_a_dead_companion_is_a_success_and_an_error(
    play: Callable[..., Run],
) -> None:
    run = play([*FLOWN[:-1], (COMPANION, Exited(-9)), at(12.0, 8.0, armed=False)])
    with pytest.raises(RehearsalError, match="the companion process died"):
        run.fly()
    (record,) = run.observer.records
    assert record.outcome == "success"


def test_ended_but_never_saved(play: Callable[..., Run]) -> None:
    run = play(FLOWN)
    run.stage.saves = False
    with pytest.raises(RehearsalError, match="gave up waiting for the event 'Saved'"):
        run.fly()
    assert run.observer.records == []
    assert all(child.stopped for child in run.stage.children.values())


def test_companion_that_never_answers_is_ended(
    play: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hung for good: its end is what makes the flight controller's failsafe act."""
    for name in ("TAKEOFF_LIMIT_S", "WRAP_UP_S"):
        monkeypatch.setattr(rehearsal, name, 0.1)
    run = play([at(0.05), phase("navigating", 0.06), at(0.08)])
    run.plan = Plan(**{**vars(run.plan), "time_limit_s": 1.0})
    with pytest.raises(RehearsalError, match="gave up waiting for the flight"):
        run.fly()
    (record,) = run.observer.records
    assert record.outcome == "aborted"
    assert run.stage.children[COMPANION].stopped >= 1
    assert any("the vehicle to come down" in note for note in record.notes)


@pytest.mark.parametrize("name", [FIRMWARE, COMPANION])
def test_refusal_at_the_start_is_a_usage_error(play: Callable[..., Run], name: str) -> None:
    run = play(FLOWN)
    run.stage.ready = [(FIRMWARE, Ready()), (name, Failed(message="port 1 is taken"))]
    with pytest.raises(UsageError, match="port 1 is taken"):
        run.fly()
    assert all(child.stopped for child in run.stage.children.values())


def test_death_at_the_start(play: Callable[..., Run]) -> None:
    run = play(FLOWN)
    run.stage.ready = [(FIRMWARE, Ready()), (COMPANION, Exited(1))]
    with pytest.raises(RehearsalError, match=r"companion process died: exit code 1(.|\n)*last w"):
        run.fly()


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

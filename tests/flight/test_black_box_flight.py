"""A recorded flight with the real MAVSDK, and the run created from the recording."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter
from rich.console import Console
from scipy.spatial.transform import Rotation

from airl_mav.addons.identification.rehearse_flight import (
    FLOWN,
    REHEARSED,
    Rehearsals,
    from_its_start,
    rehearse_flight,
)
from airl_mav.addons.recordings.recorded_flight import episode_of, take_in
from airl_mav.black_box.mcap_file import BlackBoxFile, read_black_box
from airl_mav.black_box.messages import (
    Decision,
    End,
    Log,
    Phase,
    RawImage,
    Resources,
    Status,
    Telemetry,
)
from airl_mav.cli.report_command import ReportOptions
from airl_mav.cli.report_command import run as report
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.frames import quat_yaw
from airl_mav.experiments.experiment import Run, load_run
from airl_mav.flight.episode_record import Setup
from airl_mav.flight.judge import Outcome
from airl_mav.latency.stamps import STAMPS
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.report.comparison.show import compare_folders
from airl_mav.scenario.checks import TRANSPORT_US
from airl_mav.scenario.model import PilotSettings
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.addons.black_box.recorder import SAMPLE_US, open_recorder, run_of
from companion.pilot import MissionResult
from companion.program import prepare
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.lockstep_kit import demo_scenario, fly_as_companion

SEED = 3


@dataclass
class Recorded:
    """A flight, and its recording."""

    path: Path
    result: MissionResult
    simulation: Simulation


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("flights")
    scenario = demo_scenario(policy="greedy")
    arena = scenario.arena_of(SEED)
    goal = (float(arena.goal[0]), float(arena.goal[1]))
    asked = StandAloneCompanion(policy="greedy", goal=goal, seed=SEED, black_box=folder)
    run = run_of(asked, prepare(asked))
    setup = EpisodeSetup(scenario.vehicle, arena, SEED)
    results: list[MissionResult] = []
    with LockstepStage(transport_us=TRANSPORT_US) as stage:
        # Its thread would live by the wall clock, which this flight does not.
        recorder = open_recorder(folder, run, stage.link, stage.clock, goal)

        def look_on(simulation: Simulation) -> None:
            if simulation.time_us % SAMPLE_US == 0 and results == [] and heard:
                recorder.record(simulation.time_us)

        stage.firmware.on_tick = look_on
        heard: list[str] = []

        def phase(name: str) -> None:
            heard.append(name)
            recorder.phase(name)

        def program() -> None:
            stage.link.hear_texts(recorder.heard)
            result = fly_as_companion(
                *(stage, scenario.fresh_policy(SEED), goal),
                phase=phase,
                decided=recorder.decided,
            )
            results.append(result)

        simulation = stage.run(setup, program)
        recorder.end(results[0].reason, results[0].notes)
    (path,) = folder.glob("*.mcap")
    return Recorded(path, results[0], simulation)


@pytest.fixture(scope="module")
def run(recorded: Recorded) -> Run:
    return load_run(take_in(recorded.path))


def test_every_decision_is_there_with_its_stamps(recorded: Recorded, run: Run) -> None:
    box = read_black_box(recorded.path)
    assert box.whole
    wanted, found = recorded.result.log.columns(), run.stamps[0]
    assert len(box.all_of(Decision)) == len(recorded.result.log) > 5
    for name in STAMPS:
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)
    np.testing.assert_array_equal(found["setpoint"], wanted["setpoint"])
    assert [phase.phase for phase in box.all_of(Phase)] == [
        *("arming", "taking off", "navigating", "landing", "done")
    ]
    (end,) = box.all_of(End)
    assert end.reason == "goal reached"
    assert "Takeoff detected" in {log.message.strip() for log in box.all_of(Log)}
    assert box.all_of(Resources)[-1].memory_bytes > 10**7
    sent_us = np.array([decision.sent_us for decision in box.all_of(Decision)])
    assert len(box.all_of(RawImage)) == len(sent_us), "at 10 Hz, every image of a policy of 2 Hz"


def test_the_path_is_the_one_that_was_flown(recorded: Recorded, run: Run) -> None:
    path = run.trajectories[0]
    assert recorded.simulation.recorder is not None
    truth = recorded.simulation.recorder.arrays()
    true_us, true = truth["trajectory/time_us"], truth["trajectory/position"]
    told = read_black_box(recorded.path).all_of(Decision)
    begun_us = [decision.infer_start_us for decision in told]
    there = np.stack([np.interp(begun_us, true_us, column) for column in true.T], axis=1)
    seen = np.array([decision.position for decision in told], np.float64)
    # The estimate's error, and the age of the newest telemetry at a few metres a second.
    assert np.linalg.norm(seen - there, axis=1).max() < 0.6
    # Between its turns a companion in lockstep hears nothing: right places, at later times.
    flown = path.position[path.position[:, 2] < -1.0]
    away = np.linalg.norm(flown[:, None] - true[None], axis=2).min(axis=1)
    assert len(flown) > 50 and away.max() < 0.4
    assert np.diff(path.time_us).max() == SAMPLE_US


def test_it_is_judged_as_a_rehearsal_is(recorded: Recorded, run: Run) -> None:
    (record,) = run.episodes
    assert run.info.setup.level == "flight"
    assert record.outcome is Outcome.SUCCESS
    assert record.quality is not None and record.navigation_us is not None
    arrays = recorded.simulation.recorder.arrays() if recorded.simulation.recorder else {}
    times, power = arrays["trajectory/time_us"], arrays["trajectory/power_w"]
    flown = (times > record.navigation_us) & (times <= record.ended_us)
    true_j = float(np.sum(power[flown] * np.diff(times, prepend=times[0])[flown])) / US_PER_S
    assert record.quality.energy_j == pytest.approx(true_j, rel=0.1)
    straight_m = np.hypot(*record.goal) - record.goal_radius_m
    assert straight_m - 0.5 < record.quality.distance_m < 1.5 * straight_m


@pytest.mark.nightly
@pytest.mark.parametrize("told_a", [None, -1.0])
def test_where_no_current_is_measured_there_is_no_energy(
    recorded: Recorded, run: Run, tmp_path: Path, told_a: float | None
) -> None:
    """PX4 SITL's battery reports no current: older recordings contain its -1 A."""
    box = read_black_box(recorded.path)
    file = BlackBoxFile(tmp_path / "flight.mcap", box.run)
    for messages in box.messages.values():
        for message in messages:
            status = isinstance(message, Status)
            file.write(replace(message, current_a=told_a) if status else message, 0)
    file.finish()
    console = Console(record=True, width=100, quiet=True)
    assert report(ReportOptions(runs=(tmp_path / "flight.mcap",)), console) == 0
    ours = load_run(tmp_path / "flight")
    (record,) = ours.episodes
    assert record.quality is not None
    assert record.quality.energy_j is None and record.quality.total_energy_j is None
    assert record.quality.takeoff.energy_j is None and record.quality.endurance_s is None
    assert record.quality.distance_m > 10.0
    page = (tmp_path / "flight" / "report.html").read_text(encoding="utf-8")
    assert "Energy without the computer" in page
    # Only one of the two runs has energy: the other figures are compared.
    console = Console(record=True, width=100, quiet=True)
    assert report(ReportOptions(runs=(run.path, ours.path), out=tmp_path / "both"), console) == 0
    told = console.export_text()
    assert "nan" not in told.lower()


def test_airl_report_shows_it_and_what_a_crash_left_of_it(
    recorded: Recorded, run: Run, tmp_path: Path
) -> None:
    console = Console(record=True, width=100, quiet=True)
    assert report(ReportOptions(runs=(recorded.path,)), console) == 0
    page = (run.path / "report.html").read_text(encoding="utf-8")
    assert "in an unknown place, level flight: 1 of 1 goals reached" in page
    data = recorded.path.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    assert report(ReportOptions(runs=(cut,)), console) == 0
    (left,) = load_run(tmp_path / "cut").episodes
    assert left.outcome is Outcome.ABORTED
    assert left.reason.startswith("the recording ends while")
    assert "the companion, its computer or the power failed" in left.notes[0]
    # A second import reuses the run. Another file with the same name is rejected.
    assert take_in(cut) == tmp_path / "cut"
    shutil.copy(recorded.path, cut)
    with pytest.raises(UsageError, match="holds another run"):
        take_in(cut)


# --- rehearsed again


def test_rehearsed_where_it_flew_it_is_the_same_flight(
    recorded: Recorded, run: Run, tmp_path: Path
) -> None:
    """Tolerances cover the lockstep hold: no message arrives while an action is held."""
    out = tmp_path / "out"
    found = rehearse_flight(
        recorded.path, out, Rehearsals(arena=demo_scenario().arena_name, episodes=2)
    )
    (flown,) = run.episodes
    assert flown.quality is not None
    assert found.flown_s == flown.quality.flight_time_s
    assert (found.rehearsals, len(found.rehearsed_s)) == (2, 2)
    assert -0.1 < found.flown_s - found.rehearsed_s[0] < PilotSettings.hold_s + 0.2
    assert np.median(found.apart_m) < 0.5
    assert "2 of 2 rehearsals reached the goal, in " in found.sentences[0]
    # The two are a pair: the same arena, seed and goal.
    comparison, _ = compare_folders([out / REHEARSED, out / FLOWN])
    (contrast,) = comparison.contrasts
    assert contrast.paired.flight_time_s.difference.n == 1
    with pytest.raises(FieldError, match="a new or empty folder"):
        rehearse_flight(recorded.path, out)
    with pytest.raises(FieldError, match="one with the goal of the flight"):
        rehearse_flight(recorded.path, tmp_path / "other", Rehearsals("static-obstacles", 4))


def test_code_that_a_recording_names_is_not_run_unasked(tmp_path: Path) -> None:
    scenario = demo_scenario()
    config = {
        "policy": "evil.py:Policy",
        "goal": [9.0, 0.0],
        "seed": 1,
        "speed": 1.0,
        "pilot": {"hold_s": 0.5, "goal_radius_m": 3.0},
        "limits": {"flight_s": 60.0},
    }
    made = {"name": "flight", "created_utc": "", "seeds": [1], "versions": {}, "machine": {}}
    setup = TypeAdapter(Setup).dump_python(scenario.setup, mode="json")
    run = {**made, "git": None, "setup": setup, "config": config}
    file = BlackBoxFile(tmp_path / "flight.mcap", run)
    level = (1.0, 0.0, 0.0, 0.0)
    file.write(Phase(0, "navigating"), 0)
    for k in range(5):
        file.write(Telemetry(k * SAMPLE_US, (0.1 * k, 0.0, -2.5), (1.0, 0.0, 0.0), level), 0)
    still = (0.0, 0.0, 0.0)
    file.write(Decision(0, 0, 0, 0, 0, 0, -1, still, still, level, 9.0, level), 0)
    file.finish()
    with pytest.raises(FieldError, match="it is code that would run on this machine"):
        rehearse_flight(file.path, tmp_path / "out")


def test_a_flight_is_moved_to_where_its_navigation_began(recorded: Recorded) -> None:
    episode = episode_of(read_black_box(recorded.path))
    here = from_its_start(episode)
    # The same flight elsewhere, with another heading.
    yaw, offset = 2.0, np.array([30.0, -12.0, 0.0])
    turn = Rotation.from_euler("z", yaw)
    path = episode.trajectory
    xyzw = (turn * Rotation.from_quat(path.quaternion[:, [1, 2, 3, 0]])).as_quat()
    there = replace(
        path,
        position=turn.apply(path.position) + offset,
        velocity=turn.apply(path.velocity),
        quaternion=xyzw[:, [3, 0, 1, 2]],
    )
    north, east, _ = turn.apply([*episode.record.goal, 0.0]) + offset
    record = replace(episode.record, goal=(north, east))
    back = from_its_start(replace(episode, trajectory=there, record=record))
    np.testing.assert_allclose(back.trajectory.position, here.trajectory.position, atol=1e-9)
    np.testing.assert_allclose(back.trajectory.velocity, here.trajectory.velocity, atol=1e-9)
    turned = np.abs(np.sum(back.trajectory.quaternion * here.trajectory.quaternion, axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-9)
    assert back.record.goal == pytest.approx(here.record.goal)
    begun = np.searchsorted(here.trajectory.time_us, record.navigation_us or 0) - 1
    assert abs(quat_yaw(here.trajectory.quaternion[begun])) < 0.1

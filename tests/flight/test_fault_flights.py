"""Flights with faults, in lockstep: recorded, reported, and the same every time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from mavsdk.plugins.failure import Failure, FailureError, FailureType, FailureUnit
from mavsdk.plugins.param import Param
from rich.console import Console

from airl_mav.cli import sitl_command
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.experiments.evaluate import check_plain, matrix
from airl_mav.faults import Fault
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.profiles.loading import read_toml
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.episode import faults_of
from airl_mav.rehearsal.run_folder import load
from airl_mav.report.run_tables import faults_table
from airl_mav.scenario.model import Scenario
from firmware_sim.simulation import EpisodeSetup
from tests.support.lockstep_kit import SEED, demo_scenario


def flown(*faults: str) -> EpisodeRecord:
    resolved = demo_scenario(faults=faults, time_limit_s=30.0)
    return fly(resolved, resolved.fresh_policy(SEED), 0, SEED).record


@pytest.mark.nightly
def test_a_flight_with_every_sort_of_fault_is_the_same_every_time() -> None:
    faults = (
        "gyro noise 3x at 2s",
        "gps delay 200ms at climb",
        "motor1 weak 90% at offboard",
        "wind gust 3,0,0m/s at offboard for 1s",
        "camera delay 100ms at offboard",
        "link jitter 60ms",
        "downlink loss 20% at climb",
        "uplink duplicate 20%",
    )
    once, again = flown(*faults), flown(*faults)
    assert once == again
    assert once.outcome is Outcome.SUCCESS
    assert len(once.faults) == len(faults)
    gust = next(each for each in once.faults if each.fault.startswith("wind"))
    assert gust.to_us - gust.from_us == 1_000_000
    assert once.sha256 != flown().sha256


@pytest.mark.parametrize(
    ("fault", "outcome", "note"),
    [
        ("link cut at climb", Outcome.ABORTED, "leaving offboard failed: timeout"),
        ("uplink cut at offboard", Outcome.ABORTED, "taken over: the mode is return"),
        ("motor2 off at offboard+1s", Outcome.COLLISION, ""),
    ],
)
def test_what_becomes_of_a_mission(fault: str, outcome: Outcome, note: str) -> None:
    record = flown(fault)
    assert record.outcome is outcome
    assert note in "; ".join(record.notes)
    assert [each.fault for each in record.faults] == [fault]


@pytest.mark.nightly
def test_a_run_folder_tells_its_faults_and_flies_them_again(tmp_path: Path) -> None:
    out = tmp_path / "run"
    console = Console(record=True, width=200)
    fault = "camera stuck at offboard+500ms for 300ms"
    options = {"level": "lockstep", "episodes": 1, "seed": SEED, "out": out, "faults": [fault]}
    assert sitl_command.run(sitl_command.OPTIONS.model_validate(options), console) == 0
    run = load(out)
    table = faults_table(run)
    assert table is not None
    assert table.rows[0][:4] == ("0", "camera stuck at offboard+0.5s for 0.3s", "0.40", "0.70")
    assert "camera stuck at offboard+0.5s" in console.export_text()
    page = (out / "report.html").read_text()
    assert "camera stuck at offboard+0.5s for 0.3s" in page
    again = Scenario.model_validate(read_toml(out / "scenario.toml"))
    assert [str(each) for each in again.faults] == ["camera stuck at offboard+0.5s for 0.3s"]


def test_mavsdk_s_failure_plugin_makes_sensors_fail() -> None:
    """Match PX4 SITL: supported failures succeed, others fail; SYS_FAILURE_EN is required."""
    answers: list[str] = []

    def program(stage: LockstepStage) -> None:
        stage.clock.sleep_until(3 * US_PER_S)
        failure, param = Failure(stage.link._system), Param(stage.link._system)
        try:
            for unit, kind in (
                (FailureUnit.SENSOR_GPS, FailureType.OFF),
                (FailureUnit.SENSOR_GPS, FailureType.STUCK),
                (FailureUnit.SENSOR_BARO, FailureType.STUCK),
            ):
                answers.append(_told(lambda u=unit, k=kind: failure.inject(u, k, 0)))  # type: ignore[misc]
            stage.clock.sleep_until(4 * US_PER_S)
            answers.append(_told(lambda: failure.inject(FailureUnit.SENSOR_GPS, FailureType.OK, 0)))
            param.set_param_int("SYS_FAILURE_EN", 0)
            answers.append(
                _told(lambda: failure.inject(FailureUnit.SENSOR_MAG, FailureType.OFF, 0))
            )
        finally:
            failure.destroy()
            param.destroy()

    with LockstepStage() as stage:
        setup = EpisodeSetup(load_vehicle("quad"), None, 1)
        simulation = stage.run(setup, lambda: program(stage))
        acted = faults_of(simulation.arrays())
    assert answers == ["ok", "UNSUPPORTED", "ok", "ok", "DENIED"]
    assert [each.fault.split(" at ")[0] for each in acted] == ["gps off", "baro stuck"]
    assert acted[0].to_us - acted[0].from_us == US_PER_S


def _told(call: Callable[[], object]) -> str:
    """Return ok, or the name of MAVSDK's result."""
    try:
        call()
    except FailureError as error:
        return str(getattr(error.args[0], "name", error.args[0]))
    return "ok"


def test_each_fault_has_a_row_of_its_own() -> None:
    faults = ("camera delay 100ms", "gps off at offboard")
    asked = Scenario(
        level="lockstep",
        episodes=1,
        seed=SEED,
        workers=1,
        faults=tuple(_fault(text) for text in faults),
    )
    table = matrix(asked, ["static-obstacles"], each_fault=True)
    assert [[str(f) for f in cell.scenario.scenario.faults] for cell in table.cells] == [
        [],
        ["camera delay 0.1s"],
        ["gps off at offboard"],
    ]
    assert (
        len({cell.name for cell in table.cells}) == len({cell.label for cell in table.cells}) == 3
    )
    with pytest.raises(FieldError, match="each_fault"):
        matrix(Scenario(level="lockstep"), ["static-obstacles"], each_fault=True)
    with pytest.raises(FieldError, match="faults"):
        check_plain(table.cells[1:])


def _fault(text: str) -> Fault:
    return Fault.model_validate(text)

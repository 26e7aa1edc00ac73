"""Fault matrix: a handful of its flights, their results, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from rich.console import Console

from airl_mav.addons.fault_matrix import command as faults
from airl_mav.addons.fault_matrix import matrix as fault_matrix
from airl_mav.addons.fault_matrix.matrix import (
    CASES,
    FALLS,
    MATRIX_PHASES,
    End,
    FaultFlight,
    MatrixCell,
    cell_text,
    fly_fault,
    fly_matrix,
    markdown,
)
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.faults import Fault, Phase
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.report.document import print_table
from tests.support.flight_rig import quad


def test_the_catalogue_holds_faults_without_a_time() -> None:
    for case in CASES:
        fault = Fault.model_validate(case.fault)
        assert (fault.phase, fault.at_s) == (None, 0.0)
        assert str(fault) == case.fault or Fault.model_validate(str(fault)) == fault


def test_what_a_quadrotor_survives_and_what_not() -> None:
    gust = fly_fault(quad(), "wind gust 6,0,0m/s for 4s", "hold", 1)
    assert gust.end == "landed"
    assert gust.touchdown_m_s is not None
    assert gust.touchdown_m_s < 1.5
    assert gust == fly_fault(quad(), "wind gust 6,0,0m/s for 4s", "hold", 1)
    motor = fly_fault(quad(), "motor1 off", "hold", 1)
    assert motor.end == "crashed"
    assert motor.end in FALLS
    assert motor.touchdown_m_s is not None
    assert motor.touchdown_m_s > 2.0


@pytest.mark.parametrize(
    ("fault", "phase", "end"),
    [
        ("accel bias 0.5,0.5,0.5m/s2", "hold", "landed"),
        ("accel bias 0,0,-3m/s2", "climb", "landed"),
        ("gyro bias 2,2,2deg/s", "landing", "landed"),
        ("gyro bias 0,0,8deg/s", "hold", "landed"),
        ("gps stuck", "climb", "landed"),
        ("gps noise 5x", "ground", "landed"),
        ("gps delay 200ms", "hold", "landed"),
        # A fault before take-off keeps the vehicle on the ground.
        ("accel off", "ground", "not armed"),
        ("mag bias 0.1,0.1,0gauss", "ground", "not armed"),
        ("gps off", "ground", "not armed"),
    ],
)
def test_the_estimator_copes_with_sensors_that_fail(fault: str, phase: Phase, end: str) -> None:
    flown = fly_fault(quad(), fault, phase, 2)
    assert flown.end == end, flown
    assert (flown.touchdown_m_s or 0.0) < 1.0
    assert flown.farthest_m < 10.0
    told = any(text.startswith("Estimator biases reset") for text in flown.said)
    assert told is ("bias" in fault and end == "landed"), flown.said


def flight(end: End, touchdown_m_s: float | None = None) -> FaultFlight:
    return FaultFlight("baro off", "hold", 1, end, touchdown_m_s, 5.0, "LAND", ())


def test_six_phases_are_whole_in_a_terminal_of_eighty_columns() -> None:
    cases = ["wind gust 6,0,0m/s for 4s", "accel bias 0.5,0.5,0.5m/s2", "motor1 off"]
    ends = (*[flight("landed", 0.7)] * 19, flight("crashed"))
    cells = [MatrixCell(fault, phase, ends) for fault in cases for phase in MATRIX_PHASES]
    console = Console(record=True, width=80)
    print_table(faults.table_of(cases, MATRIX_PHASES, cells), console, wrap=True)
    text = console.export_text()
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80
    words = text.split()
    for word in ("gust", *MATRIX_PHASES):
        assert word in words
    assert words.count("crashed") == len(cells)
    assert text.count("m/s)") == len(cells)


def test_a_cell_counts_its_ends_and_marks_what_is_not_documented() -> None:
    good = MatrixCell("baro off", "hold", (flight("landed", 0.7), flight("landed", 0.9)))
    assert cell_text(good) == "2 landed (0.9 m/s)"
    bad = MatrixCell("baro off", "climb", (flight("landed", 0.7), flight("broken")))
    assert cell_text(bad) == "1 landed (0.7 m/s), 1 broken !"
    assert markdown([good, bad]).splitlines() == [
        "| fault | hold | climb |",
        "|---|---|---|",
        "| `baro off` | 2 landed (0.9 m/s) | 1 landed (0.7 m/s), 1 broken ! |",
    ]
    # On the ground a fault may also keep the vehicle from arming.
    assert not MatrixCell("baro off", "ground", (flight("not armed"),)).unexpected
    assert MatrixCell("baro off", "hold", (flight("not armed"),)).unexpected


@pytest.mark.nightly  # Nor of any other jobs: test_executors.py, test_campaign.py.
def test_workers_change_no_result() -> None:
    alone = fly_matrix(quad(), ("baro off",), ("landing",), (1, 2))
    assert fly_matrix(quad(), ("baro off",), ("landing",), (1, 2), workers=2) == alone


def test_the_command_flies_shows_and_saves(tmp_path: Path) -> None:
    options = faults.OPTIONS.model_validate(
        {"faults": ["mag off"], "phases": ["hold"], "episodes": 1, "workers": 1, "out": tmp_path}
    )
    console = Console(record=True, width=120)
    assert faults.run(options, console) == 0
    assert "1 landed" in console.export_text()
    assert "| `mag off` | 1 landed" in (tmp_path / "faults.md").read_text()
    flights = json.loads((tmp_path / "faults.json").read_text())["flights"]
    assert [(f["fault"], f["phase"], f["seed"]) for f in flights] == [("mag off", "hold", 1)]


def test_a_stopped_run_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only missing flights are flown. Another vehicle or version cannot resume the run."""

    def options(*faulty: str, **more: object) -> faults.FaultsOptions:
        asked = {"faults": faulty, "phases": ["ground"], "episodes": 1, "workers": 1}
        return faults.OPTIONS.model_validate({**asked, "out": tmp_path, **more})

    faults.run(options("accel off"), Console(quiet=True))
    asked: list[str] = []

    def spy(vehicle: VehicleProfile, fault: str, phase: Phase, seed: int) -> FaultFlight:
        asked.append(fault)
        return fly_fault(vehicle, fault, phase, seed)

    monkeypatch.setattr("airl_mav.addons.fault_matrix.matrix.fly_fault", spy)
    faults.run(options("accel off", "gyro off"), Console(quiet=True))
    assert asked == ["gyro off"]
    found = fault_matrix.load(tmp_path / "faults.json")
    assert [cell.fault for cell in found.cells] == ["accel off", "gyro off"]
    monkeypatch.setattr(fault_matrix, "vehicle_digest", lambda _: "another")
    with pytest.raises(UsageError, match="another vehicle"):
        faults.run(options("gyro off"))
    (tmp_path / "faults.json").write_text("{}")
    with pytest.raises(UsageError, match=r"faults\.json"):
        faults.run(options("gyro off"))


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"phases": ["dinner"]}, "phases 'dinner': accepted: ground, climb"),
        ({"faults": ["gps off at 3s"]}, "without a time"),
        ({"faults": ["link cut"]}, "it flies alone here"),
    ],
)
def test_what_cannot_be_flown_gets_one_line(fields: dict[str, object], line: str) -> None:
    with pytest.raises(FieldError, match=line):
        faults.run(faults.OPTIONS.model_validate(fields))


def test_every_phase_of_the_matrix_sets_its_faults_off() -> None:
    """A fault that never began would pass as survived."""
    for phase in MATRIX_PHASES:
        flown = fly_fault(quad(), "battery off", phase, 1)
        assert any("battery" in text.lower() for text in flown.said), phase

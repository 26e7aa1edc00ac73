"""Calibrations, by the real MAVSDK and by the texts that a ground station follows."""

from __future__ import annotations

from queue import Queue

import numpy as np
import pytest
from mavsdk.plugins.calibration import Calibration, CalibrationResult

from tests.support.mavlink_clients import Rig, mavsdk_over_memory

CALIBRATE, FIXED_YAW = 241, 42_006
ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
PATIENCE_S = 20.0


def calibrate(rig: Rig, number: int = 0, value: float = 0.0) -> int:
    """Send the command with one parameter set; the others are zero."""
    return rig.command(CALIBRATE, *(value if i == number else 0.0 for i in range(1, 8)))[0]


def texts(rig: Rig, seconds: float) -> list[str]:
    rig.bench.run(seconds)
    found = [m for m in rig.client.received() if m.get_type() == "STATUSTEXT"]
    return [m.text.removesuffix("\t") for m in found]


@pytest.mark.parametrize(
    "start", ["calibrate_gyro_async", "calibrate_level_horizon_async"], ids=["gyro", "level"]
)
def test_mavsdk_calibrates(start: str) -> None:
    with mavsdk_over_memory() as (companion, _):
        heard: Queue[tuple[CalibrationResult, float]] = Queue()
        getattr(companion.plugin(Calibration), start)(
            lambda result, progress, _: heard.put((result, progress.progress))
        )
        seen = []
        while True:
            result, progress = heard.get(timeout=PATIENCE_S)
            if result is not CalibrationResult.NEXT:
                break
            seen.append(progress)
        assert result is CalibrationResult.SUCCESS
        assert 1.0 in seen


def test_a_gyro_calibration_says_what_px4_says() -> None:
    rig = Rig()
    assert calibrate(rig, 1, 1) == ACCEPTED
    assert texts(rig, 3.0) == [
        "[cal] calibration started: 2 gyro",
        *(f"[cal] progress <{percent}>" for percent in range(0, 101, 10)),
        "[cal] calibration done: gyro",
    ]


def test_it_takes_its_time_in_which_no_other_begins() -> None:
    rig = Rig()
    calibrate(rig, 5, 2)
    assert calibrate(rig, 1, 1) == REJECTED
    assert rig.command(FIXED_YAW, 0)[0] == REJECTED
    assert len(texts(rig, 1.0)) < 5
    assert texts(rig, 5.0)[-1] == "[cal] calibration done: level"
    assert calibrate(rig, 1, 1) == ACCEPTED


def test_a_vehicle_that_moves_is_not_calibrated() -> None:
    rig = Rig()
    rig.autopilot.gyro = np.array([0.0, 0.5, 0.0])
    rig.bench.tick()
    calibrate(rig, 1, 1)
    assert texts(rig, 1.0)[-1] == "[cal] calibration failed: gyro"


@pytest.mark.parametrize(("number", "sensor"), [(5, "accel"), (2, "mag")])
def test_what_needs_the_vehicle_turned_waits_until_it_is_cancelled(
    number: int, sensor: str
) -> None:
    rig = Rig()
    assert calibrate(rig, number, 1) == ACCEPTED
    assert texts(rig, 20.0)[0] == f"[cal] calibration started: 2 {sensor}"
    assert calibrate(rig, 1, 1) == REJECTED
    assert calibrate(rig) == ACCEPTED
    assert texts(rig, 10.0) == [
        "[cal] calibration cancelled",
        f"[cal] calibration failed: {sensor}",
    ]
    assert calibrate(rig, 1, 1) == ACCEPTED


@pytest.mark.parametrize(
    ("number", "value", "result", "last"),
    [
        (3, 1, ACCEPTED, "[cal] calibration done: baro"),
        (4, 1, ACCEPTED, "Calibration: Disabling RC input"),
        (4, 2, ACCEPTED, "trim cal done"),
        (4, 9, UNSUPPORTED, None),
        (5, 4, ACCEPTED, None),
        (6, 1, ACCEPTED, "[cal] calibration failed: airspeed"),
        (7, 1, DENIED, None),
    ],
)
def test_the_others_answer_as_px4(number: int, value: int, result: int, last: str | None) -> None:
    rig = Rig()
    assert calibrate(rig, number, value) == result
    said = texts(rig, 8.0)
    assert last is None or said[-1] == last


def test_nothing_is_calibrated_while_armed() -> None:
    rig = Rig()
    rig.command(400, 1)
    assert calibrate(rig, 1, 1) == REJECTED

"""A compass that does not measure the earth's field, as PX4 checks its strength and dip."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.core.frames import MAGNETIC_FIELD_NED, quat_from_euler, quat_to_matrix
from firmware_sim.autopilot.alignment import INCLINATION_RAD, STRENGTH_GAUSS, FieldCheck
from firmware_sim.autopilot.autopilot_state import Result
from tests.support.flight_rig import Rig

STRENGTH, INCLINATION = 1, 2
TEXT = "Strong magnetic interference"
LEVEL = (1.0, 0.0, 0.0, 0.0)


def field(strength: float, inclination_rad: float) -> np.ndarray:
    """A field at rest, nose to magnetic north."""
    return strength * np.array([math.cos(inclination_rad), 0.0, math.sin(inclination_rad)])


def test_the_earth_s_field_is_that_of_the_place() -> None:
    assert pytest.approx(0.482, abs=1e-3) == STRENGTH_GAUSS
    assert math.degrees(INCLINATION_RAD) == pytest.approx(63.6, abs=0.1)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_each_bit_checks_to_its_limit(sign: float) -> None:
    check = FieldCheck(STRENGTH | INCLINATION, 0.2, math.radians(20.0))
    for share, disturbed in ((0.99, False), (1.01, True)):
        other = field(STRENGTH_GAUSS + sign * 0.2 * share, INCLINATION_RAD)
        assert check.disturbed(other, LEVEL) is disturbed
        assert not check._replace(checked=INCLINATION).disturbed(other, LEVEL)
        steep = field(STRENGTH_GAUSS, INCLINATION_RAD + sign * math.radians(20.0) * share)
        assert check.disturbed(steep, LEVEL) is disturbed
        assert not check._replace(checked=STRENGTH).disturbed(steep, LEVEL)
    assert not check._replace(checked=0).disturbed(np.zeros(3), LEVEL)
    assert check.disturbed(np.full(3, math.nan), LEVEL)


def test_the_attitude_does_not_disturb() -> None:
    check = FieldCheck(STRENGTH | INCLINATION, 0.01, math.radians(0.5))
    for roll, pitch, yaw in np.random.default_rng(1).uniform(-1.0, 1.0, (20, 3)):
        attitude = quat_from_euler(roll, pitch, yaw)
        measured = quat_to_matrix(attitude).T @ MAGNETIC_FIELD_NED
        q0, q1, q2, q3 = attitude.tolist()
        assert not check.disturbed(measured, (q0, q1, q2, q3))


@pytest.mark.parametrize(
    ("fault", "parameters"),
    [
        ("mag bias 0.4,0,0gauss", {}),
        ("mag bias 0.1,0.1,0gauss", {"EKF2_MAG_CHECK": 3.0, "EKF2_MAG_CHK_INC": 8.0}),
    ],
)
def test_no_heading_comes_of_a_field_that_is_wrong_from_the_first_sample(
    fault: str, parameters: dict[str, float]
) -> None:
    rig = Rig(1, faults=(fault,), parameters=parameters)
    rig.run(3.0)
    assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
    assert not math.isnan(rig.said(TEXT))


def test_a_field_that_is_right_again_lets_the_vehicle_get_ready() -> None:
    rig = Rig(1, faults=("mag bias 0.4,0,0gauss for 2s",))
    rig.arm()
    assert 2.0 < rig.time_s < 6.0
    assert math.isnan(rig.said(TEXT))


@pytest.mark.parametrize(
    ("asked", "result", "said"),
    [
        (0.0, Result.ACCEPTED, ""),
        (1.0, Result.TEMPORARILY_REJECTED, f"Preflight Fail: {TEXT}"),
        (2.0, Result.ACCEPTED, f"Preflight: {TEXT}"),
    ],
)
def test_interference_warns_or_denies_as_asked(asked: float, result: Result, said: str) -> None:
    rig = Rig(
        1,
        faults=("mag bias 0.4,0,0gauss at 4s for 2500ms",),
        parameters={"COM_ARM_MAG_STR": asked},
    )
    rig.run(4.5)
    assert rig.ap.arm(force=False) is result
    assert [text for _, text in rig.texts if TEXT in text][:1] == ([said] if said else [])

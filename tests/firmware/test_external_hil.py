"""HIL messages against pymavlink's own decoder and numbers worked by hand."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.frames import HOME, Geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.external import hil_messages as hil
from firmware_sim.interfaces import BatterySample, GpsFix, SensorSample, TrueState
from firmware_sim.mavlink.codec import Encoder, Values, WireLayout
from firmware_sim.mavlink.streams.status import hil_state_quaternion

BATTERY = BatterySample(16.0, 10.0, 100.0, 0.9)


def decoded(layout: WireLayout, values: Values) -> Any:
    """Return the message that pymavlink finds in the frame."""
    frame = Encoder().frame(layout, layout.payload(values))
    (message,) = dialect.MAVLink(None).parse_buffer(frame)
    return message


def sample(**slow: Any) -> SensorSample:
    accel, gyro = np.array([0.1, -0.2, -9.81]), np.array([0.01, -0.02, 0.03])
    return SensorSample(8_000, accel, gyro, 11.8, BATTERY, **slow)


def controls_message(motors: Sequence[float], mode: int = 129, flags: int = 1) -> Any:
    packed = dialect.MAVLink_hil_actuator_controls_message(
        7_000, [*motors, *[0.0] * (16 - len(motors))], mode, flags
    ).pack(dialect.MAVLink(None))
    (message,) = dialect.MAVLink(None).parse_buffer(packed)
    return message


def test_an_inertial_sample_updates_nothing_else() -> None:
    message = decoded(hil.SENSOR, hil.sensor(sample(), 1_004_000))
    assert message.get_type() == "HIL_SENSOR"
    assert (message.time_usec, message.id) == (1_004_000, 0)
    assert message.fields_updated == 0b111111
    felt = (message.xacc, message.yacc, message.zacc)
    assert felt == pytest.approx((0.1, -0.2, -9.81))
    turning = (message.xgyro, message.ygyro, message.zgyro)
    assert turning == pytest.approx((0.01, -0.02, 0.03))


def test_inertial_sensors_saturate_like_the_16_bits_behind_them() -> None:
    hard = SensorSample(1, np.array([0.0, 500.0, -240.0]), np.array([40.0, 0, -40.0]), 1.0, BATTERY)
    message = decoded(hil.SENSOR, hil.sensor(hard, 1))
    # PX4 counts in g/2048 and 2000/32768 deg/s.
    counts = [v / (9.80665 / 2048) for v in (message.xacc, message.yacc, message.zacc)]
    assert counts == pytest.approx([0.0, 32_767, -32_767], abs=0.01)
    turns = [math.degrees(v) / (2000 / 32_768) for v in (message.xgyro, message.zgyro)]
    assert turns == pytest.approx([32_767, -32_767], abs=0.01)


def test_compass_in_gauss_is_flagged() -> None:
    message = decoded(hil.SENSOR, hil.sensor(sample(mag=np.array([0.21, 0.01, 0.43])), 1))
    assert message.fields_updated == 0b111_111_111
    assert (message.xmag, message.ymag, message.zmag) == pytest.approx((0.21, 0.01, 0.43))


def test_barometer_has_pressure_altitude_and_temperature() -> None:
    # The standard atmosphere's table: 954.61 hPa at 500 m.
    message = decoded(hil.SENSOR, hil.sensor(sample(pressure_hpa=954.61), 1))
    assert message.fields_updated == 0b1_1010_0011_1111
    assert message.abs_pressure == pytest.approx(954.61)
    assert message.pressure_alt == pytest.approx(500.0, abs=0.1)
    assert message.temperature == pytest.approx(11.8)
    assert message.diff_pressure == 0.0


def test_a_fix_in_the_units_of_the_message() -> None:
    fix = GpsFix(
        Geodetic(47.3977421, -8.5455941, 488.123), np.array([3.0, -4.0, -1.5]), 0.9, 1.8, 12
    )
    message = decoded(hil.GPS, hil.gps(fix, 1_200_000))
    assert (message.time_usec, message.fix_type, message.id) == (1_200_000, 3, 0)
    assert (message.lat, message.lon, message.alt) == (473_977_421, -85_455_941, 488_123)
    assert (message.eph, message.epv, message.satellites_visible) == (90, 180, 12)
    assert (message.vel, message.vn, message.ve, message.vd) == (500, 300, -400, -150)
    # Towards the north-west: 360 - atan(4 / 3).
    assert message.cog == 30_687
    assert message.yaw == 0


@pytest.mark.parametrize(
    ("velocity", "course"),
    [
        ((0.0, 0.0, 0.0), 65_535),
        ((0.05, 0.0, 9.0), 65_535),
        ((1.0, 0.0, 0.0), 0),
        ((1.0, -1e-9, 0.0), 0),
        ((0.0, 2.0, 0.0), 9_000),
        ((-1.0, 0.0, 0.0), 18_000),
    ],
)
def test_course_over_ground(velocity: Vec, course: int) -> None:
    fix = GpsFix(HOME, np.array(velocity), 1.0, 1.0, 12)
    assert decoded(hil.GPS, hil.gps(fix, 1)).cog == course


def test_what_does_not_fit_is_clamped() -> None:
    fix = GpsFix(HOME, np.array([400.0, -400.0, 0.0]), 1e4, math.inf, 12)
    message = decoded(hil.GPS, hil.gps(fix, 1))
    assert (message.vn, message.ve, message.eph, message.epv) == (32_767, -32_768, 65_535, 65_535)


def test_the_true_state() -> None:
    half = math.sqrt(0.5)
    truth = TrueState(
        1,
        np.array([0.0, 0.0, -10.0]),
        np.array([1.0, -2.0, 0.25]),
        np.array([half, 0.0, 0.0, half]),
        np.array([0.1, 0.2, -0.3]),
        100.0,
        1.0,
    )
    message = decoded(hil.STATE, hil_state_quaternion(truth, 5_000))
    assert message.time_usec == 5_000
    assert message.attitude_quaternion == pytest.approx([half, 0.0, 0.0, half])
    rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
    assert rates == pytest.approx((0.1, 0.2, -0.3))
    assert (message.lat, message.lon, message.alt) == (473_977_430, 85_455_940, 499_400)
    assert (message.vx, message.vy, message.vz) == (100, -200, 25)


def test_a_metre_north_and_east_on_the_globe() -> None:
    truth = TrueState(
        1, np.array([1.0, 1.0, 0.0]), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3), 0.0, 1.0
    )
    message = decoded(hil.STATE, hil_state_quaternion(truth, 1))
    # On a sphere of 6 371 km a metre is 89.93e-7 deg, over the cosine of the latitude to the east.
    assert message.lat - 473_977_430 == 90
    assert message.lon - 85_455_940 == round(89.93 / math.cos(math.radians(47.397743)))


def test_motor_commands_while_armed() -> None:
    controls = hil.controls(controls_message([0.1, 0.2, 0.3, 1.0]), 42)
    assert (controls.time_us, controls.armed) == (42, True)
    assert controls.motors == pytest.approx((0.1, 0.2, 0.3, 1.0))


def test_rounding_is_clamped() -> None:
    controls = hil.controls(controls_message([-1e-4, 1.0005, 0.0, 0.5]), 1)
    assert controls.motors == (0.0, 1.0, 0.0, 0.5)


def test_disarmed_motors_stand_still_whatever_is_commanded() -> None:
    controls = hil.controls(controls_message([0.5, math.nan, -1.0, 0.5], mode=1), 1)
    assert (controls.motors, controls.armed) == ((0.0, 0.0, 0.0, 0.0), False)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -0.5, 1.5])
def test_a_command_that_is_no_motors_is_named(value: float) -> None:
    with pytest.raises(hil.ControlsError, match=r"controls\[2\] = .*0\.\.1"):
        hil.controls(controls_message([0.5, 0.5, value, 0.5]), 1)


def test_flags_and_mode() -> None:
    assert hil.lockstep(controls_message([0.0], flags=1))
    assert not hil.lockstep(controls_message([0.0], flags=0))
    assert hil.armed(controls_message([0.0], mode=129))
    assert not hil.armed(controls_message([0.0], mode=1))


def test_layouts_take_every_value_the_plant_can_have() -> None:
    big = sample(mag=np.full(3, 9.9), pressure_hpa=1100.0)
    assert len(hil.SENSOR.payload(hil.sensor(big, 2**60))) <= struct.calcsize("<Q13fIB")

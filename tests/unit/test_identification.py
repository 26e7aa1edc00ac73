"""The parts of an identification, against closed forms and simulations of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from airl_mav.addons.identification.air import fit_air, fit_thrust
from airl_mav.addons.identification.files import Override, identified_profile, overrides_of
from airl_mav.addons.identification.flown import Flown, block_intervals, mean_interval
from airl_mav.addons.identification.response import TELEMETRY_AGE_S, fit_response
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.vehicle_log import Series, VehicleLog, empty, marzullo, read_vehicle_log
from firmware_sim.addons.flight_log.topics import TOPICS
from firmware_sim.addons.flight_log.ulog_writer import UlogWriter

QUAD = load_vehicle("quad")
STILL = np.zeros(0, np.int64)


# --- intervals


@pytest.mark.nightly
def test_intervals_hold_the_truth_as_often_as_they_say_when_noise_lasts() -> None:
    """A line through noise that depends on its neighbours, 150 times: 95 % +- three deviations."""
    rng = np.random.default_rng(1)
    times = np.arange(500) / 25.0
    design = np.stack([np.ones_like(times), np.sin(times)], axis=1)
    inside = 0
    for _ in range(150):
        noise = np.zeros(len(times))
        white = rng.standard_normal(len(times))
        for k in range(1, len(times)):
            noise[k] = 0.8 * noise[k - 1] + white[k]
        found = np.linalg.lstsq(design, design @ (1.0, 2.0) + noise, rcond=None)[0]
        residuals = design @ found - (design @ (1.0, 2.0) + noise)
        low, high = block_intervals(design, residuals, times, rng) + found
        inside += int(low[1] <= 2.0 <= high[1])
    assert 0.90 <= inside / 150 <= 0.99


def test_the_interval_of_a_mean_is_students_where_samples_are_independent() -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(3.0, 1.0, 1000)
    low, high = mean_interval(values, np.arange(1000) / 25.0, rng)
    assert low < values.mean() < high
    # 40 blocks: t of 39 degrees of freedom is 3 % wider than the normal distribution's.
    assert high - low == pytest.approx(2 * 2.02 / np.sqrt(1000), rel=0.25)


def test_marzullo_finds_what_most_ranges_hold() -> None:
    # The example of Marzullo's algorithm in Wikipedia: 8-12, 11-13, 14-15 give 11-12.
    ranges = np.array([[8.0, 12.0], [11.0, 13.0], [14.0, 15.0]])
    assert marzullo(ranges) == (11.0, 12.0, 2)
    assert marzullo(ranges[:1]) == (8.0, 12.0, 1)


# --- a synthetic flight


def flown(path: Trajectory, sent_us: np.ndarray, setpoints: np.ndarray) -> Flown:
    ended_us = int(path.time_us[-1])
    return Flown(path, sent_us.astype(np.int64), setpoints, 0, ended_us, (0, ended_us))


def path_of(times: np.ndarray, velocity: np.ndarray, quaternion: np.ndarray) -> Trajectory:
    time_us = np.round(times * US_PER_S).astype(np.int64)
    return Trajectory(time_us, np.zeros_like(velocity), velocity, quaternion, np.zeros(len(times)))


def attitude(t: float, turning_rad_s: float) -> Rotation:
    lean = [0.15 * np.sin(1.1 * t), 0.2 * np.sin(0.8 * t + 1.0), 0.0]
    return Rotation.from_euler("z", 0.7 + turning_rad_s * t) * Rotation.from_euler("xyz", lean)


def in_wind(
    drag_1_s: float,
    wind: tuple[float, float],
    seconds: float = 20.0,
    turning_rad_s: float = 0.0,
) -> Flown:
    """A vehicle that leans as it likes, by the equations of motion alone (scipy's integrator)."""

    def slope(t: float, velocity: np.ndarray) -> np.ndarray:
        up = attitude(t, turning_rad_s).apply([0.0, 0.0, -1.0])
        against = velocity - np.array([*wind, 0.0])
        thrust = GRAVITY_M_S2 * (1.0 + 0.05 * np.sin(2.0 * t))
        return np.array([0.0, 0.0, GRAVITY_M_S2]) + thrust * up - drag_1_s * against

    times = np.arange(0.0, seconds, 0.04)
    solved = solve_ivp(slope, (0.0, seconds), np.zeros(3), t_eval=times, rtol=1e-6, atol=1e-6)
    turns = np.stack([attitude(t, turning_rad_s).as_quat(scalar_first=True) for t in times])
    return flown(path_of(times, solved.y.T, turns), STILL, np.zeros((0, 4)))


def logged(
    drag_1_s: float, wind: tuple[float, float], bias_m_s2: tuple[float, float], tilt_rad: float
) -> Flown:
    """The same, turning, of a log whose accelerometer is biased and whose attitude is tilted."""
    turning_rad_s = 0.4
    told = in_wind(drag_1_s, wind, turning_rad_s=turning_rad_s)
    path = told.path
    seconds = path.time_us / US_PER_S
    true = Rotation.from_quat(path.quaternion, scalar_first=True)
    against = path.velocity - np.array([*wind, 0.0])
    noise = np.random.default_rng(3).normal(0.0, 0.05, path.velocity.shape)
    felt = true.inv().apply(-drag_1_s * against) + np.array([*bias_m_s2, 0.0]) + noise
    # Rates by a small turn there and back.
    rates = np.stack(
        [
            (
                attitude(t - 5e-5, turning_rad_s).inv() * attitude(t + 5e-5, turning_rad_s)
            ).as_rotvec()
            for t in seconds
        ]
    )
    tilted = (Rotation.from_euler("x", tilt_rad) * true).as_quat(scalar_first=True)
    at = path.time_us
    held: dict[str, Any] = {
        "attitude": Series(at, tilted),
        "motion": Series(at, np.hstack([path.position, path.velocity])),
        "raw_specific_force": Series(at, felt),
        "raw_rates": Series(at, rates / 1e-4),
    }
    widths = {"motors": 4, "specific_force": 3, "setpoint": 4, "yaw_rate_setpoint": 1}
    widths |= {"more_than_velocity": 6, "nav_state": 1, "battery": 3, "wind": 2}
    widths |= {"attitude_setpoint": 5, "rates_setpoint": 4}
    held |= {name: empty(width) for name, width in widths.items()}
    log = VehicleLog(Path("made.ulg"), **held)
    turned = replace(path, quaternion=tilted)
    return replace(told, path=turned, log=log)


@pytest.mark.parametrize(("drag_1_s", "wind"), [(0.2, (3.0, -2.0)), (0.1, (0.0, 4.0))])
def test_drag_and_wind_are_those_of_the_equations_of_motion(
    drag_1_s: float, wind: tuple[float, float]
) -> None:
    air = fit_air(in_wind(drag_1_s, wind), QUAD, np.random.default_rng(0))
    assert air.drag_1_s.value == pytest.approx(drag_1_s, rel=0.02)
    assert air.wind == pytest.approx(wind, abs=0.1)


def test_an_accelerometer_tells_the_wind_where_the_attitude_is_wrong() -> None:
    """From the tilt alone, half a degree of error equals 0.4 m/s of wind at this drag."""
    wind = (3.0, -2.0)
    made = logged(0.2, wind, bias_m_s2=(0.03, -0.02), tilt_rad=np.radians(0.5))
    air = fit_air(made, QUAD, np.random.default_rng(0))
    assert "accelerometer" in air.drag_1_s.source
    assert air.drag_1_s.value == pytest.approx(0.2, rel=0.02)
    assert air.wind == pytest.approx(wind, abs=0.1)
    lean = fit_air(replace(made, log=None), QUAD, np.random.default_rng(0))
    assert lean.wind is not None and lean.wind != pytest.approx(wind, abs=0.2)


def test_where_nothing_is_dragged_no_wind_is_claimed() -> None:
    air = fit_air(in_wind(0.0, (3.0, 0.0)), QUAD, np.random.default_rng(0))
    assert air.wind is None and air.drag_1_s.value is None
    assert "the drag is too small" in air.drag_1_s.unobservable
    short = fit_air(in_wind(0.2, (3.0, 0.0), seconds=1.5), QUAD, np.random.default_rng(0))
    assert short.drag_1_s.unobservable == "the flight is too short"


def stepped(dead_s: float, lag_s: float, turn_lag_s: float, noise_m_s: float) -> Flown:
    """The closed form of a first-order lag behind steps, at 25 Hz, with a turning nose."""
    rng = np.random.default_rng(4)
    sent_s = np.arange(1.0, 12.0, 0.5)
    setpoints = np.stack(
        [rng.uniform(-4, 4, len(sent_s)), rng.uniform(-4, 4, len(sent_s)), 0.0 * sent_s,
         rng.uniform(-1, 1, len(sent_s))], axis=1,
    )  # fmt: skip
    fine = np.arange(0.0, 12.5, 0.001)
    at = np.searchsorted(sent_s + dead_s, fine, side="right") - 1
    wanted = np.where(at[:, None] >= 0, setpoints[np.maximum(at, 0)], 0.0)
    rate, heading, velocity = 0.0, 0.0, 0j
    rows = np.zeros((len(fine), 3))
    for k in range(len(fine)):
        rows[k] = velocity.real, velocity.imag, heading
        rate += 0.001 / turn_lag_s * (wanted[k, 3] - rate)
        heading += 0.001 * rate
        goal = (wanted[k, 0] + 1j * wanted[k, 1]) * np.exp(1j * heading)
        velocity += 0.001 / lag_s * (goal - velocity)
    told = rows[::40]
    noisy = np.column_stack([told[:, :2] + noise_m_s * rng.standard_normal((len(told), 2)),
                             np.zeros(len(told))])  # fmt: skip
    turns = Rotation.from_euler("z", told[:, 2:]).as_quat(scalar_first=True)
    path = path_of(fine[::40], noisy, turns)
    return flown(path, np.round(sent_s * US_PER_S), setpoints)


def test_the_response_is_that_of_the_model() -> None:
    fit = fit_response(stepped(0.18, 0.45, 0.15, 0.05), QUAD.response, np.random.default_rng(0))
    # Where no log is, the mean age of telemetry is taken off.
    assert fit.dead_time_s.value == pytest.approx(0.18 - TELEMETRY_AGE_S, abs=0.005)
    assert fit.velocity_time_s.value == pytest.approx(0.45, rel=0.02)
    assert fit.yaw_rate_time_s.value == pytest.approx(0.15, rel=0.1)
    assert "the link's time is in it" in fit.dead_time_s.source
    table = fit.response(0.2, None)
    assert table is not None and table.drag_1_s == 0.2


def test_setpoints_that_do_not_change_tell_no_response() -> None:
    steady = stepped(0.18, 0.45, 0.15, 0.05)
    steady = replace(steady, setpoints=np.tile([2.0, 0.0, 0.0, 0.0], (len(steady.sent_us), 1)))
    fit = fit_response(steady, QUAD.response, np.random.default_rng(0))
    assert fit.dead_time_s.unobservable == "setpoints change by 0.00 m/s; 1 are needed"
    assert QUAD.response is not None
    assert fit.response(0.2, QUAD.response) == QUAD.response.model_copy(update={"drag_1_s": 0.2})
    assert fit.response(0.2, None) is None


# --- files


def test_an_identified_profile_that_could_not_hover_is_refused() -> None:
    heavy = Override("body", "mass_kg", 3.0, "")
    with pytest.raises(UsageError, match="cannot hover"):
        identified_profile(QUAD, [heavy])
    light = identified_profile(QUAD, [Override("body", "mass_kg", 1.2, "")])
    assert isinstance(light, VehicleProfile) and light.body.mass_kg == 1.2


def test_gains_of_the_log_become_those_of_the_profile_where_they_can() -> None:
    made_up = stepped(0.18, 0.45, 0.15, 0.05)
    rng = np.random.default_rng(0)
    air = fit_air(made_up, QUAD, rng)
    thrust = fit_thrust(made_up, QUAD, air, "thrust", rng)
    response = fit_response(made_up, QUAD.response, rng)
    logged = {"MPC_XY_VEL_P_ACC": 2.5, "MPC_THR_HOVER": 5.0, "MPC_TKO_SPEED": 1.5, "COM_X": 1.0}
    found = overrides_of(QUAD, QUAD, response, thrust, air, logged)
    # Out of range, as the profile has it, not known here: none of these.
    parameters = [each for each in found if each.table == "parameters"]
    assert [(each.key, each.value) for each in parameters] == [("MPC_XY_VEL_P_ACC", 2.5)]
    assert identified_profile(QUAD, found).parameters["MPC_XY_VEL_P_ACC"] == 2.5


@pytest.mark.parametrize("content", [b"", b"not a log at all", b"ULog\x01\x12\x35\x01" + bytes(40)])
def test_what_is_no_log_is_refused_in_a_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.ulg"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=r"x\.ulg: accepted: a ULog"):
        read_vehicle_log(path)
    with pytest.raises(UsageError, match="No such file"):
        read_vehicle_log(tmp_path / "none.ulg")


def test_a_current_that_px4_does_not_measure_is_no_number(tmp_path: Path) -> None:
    path = tmp_path / "x.ulg"
    topics = {logged.topic.name: logged.topic for logged in TOPICS}
    names = ("vehicle_attitude", "vehicle_local_position", "battery_status")
    writer = UlogWriter(path, 0, [topics[name] for name in names], (), ())
    for k, current_a in enumerate((12.5, -1.0)):
        for number, name in enumerate(names):
            known = {"current_a": current_a, "voltage_v": 15.5, "timestamp_sample": k + 1}
            values: list[float] = []
            for field in topics[name].fields:
                kind, _, field_name = field.partition(" ")
                length = int(kind.rstrip("]").partition("[")[2] or 1)
                values += [known.get(field_name, 0)] * length
            writer.sample(number, k + 1, tuple(values))
    writer.close()
    battery = read_vehicle_log(path).battery.values
    np.testing.assert_array_equal(battery[:, 0], 15.5)
    np.testing.assert_array_equal(battery[:, 1], [12.5, np.nan])

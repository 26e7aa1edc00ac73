"""Optical flow: sensor model, estimation, and flight."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect
from scipy.spatial.transform import Rotation

from airl_mav.addons.fault_matrix.matrix import FITTED_CASES, Case, fly_fault
from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import TICK_S
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import HOME, Vector
from airl_mav.profiles.vehicle import OpticalFlow as Profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.addons.auxiliary_estimation.optical_flow import (
    STUCK,
    OpticalFlowFusion,
    flow_by_errors,
)
from firmware_sim.addons.auxiliary_estimation.sensors import OPTICAL_FLOW, optical_flow_rad
from firmware_sim.addons.auxiliary_estimation.simulated_sensors import (
    BEST,
    INVALID,
    PlantOpticalFlow,
)
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.engine.dynamics import WIDTH
from firmware_sim.external import hil_messages as hil
from firmware_sim.interfaces import FlowReading, SensorSample
from firmware_sim.mavlink.codec import Encoder, layout
from firmware_sim.mavlink.telemetry import payload
from firmware_sim.plant.sensors import Site
from firmware_sim.simulation import TOUCHDOWN_M_S
from tests.support import mavlink_clients
from tests.support.flight_rig import Rig, aids_of, velocity_setpoint

NAN = math.nan
QUIET = Profile(
    rate_hz=50.0, least_m=0.08, greatest_m=12.0, greatest_rad_s=7.4, noise_rad_s=0.0, down_m=0.0
)
INTERVAL_S = 0.02


def row_of(
    height_m: float,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0),
    attitude: Rotation | None = None,
) -> Vector:
    """Return a motion (16,), its velocity NED and its rates FRD."""
    row = np.zeros(WIDTH)
    row[2], row[3:6], row[10:13] = -height_m, velocity, rates
    x, y, z, w = (attitude or Rotation.identity()).as_quat()
    row[6:10] = w, x, y, z
    return row


def seen(profile: Profile, row: Vector, arena: Arena | None = None) -> FlowReading:
    """Return what is measured over an interval of the same motion."""
    sensor = PlantOpticalFlow(profile, Site(arena, np.random.default_rng(1), 1.0, TICK_S))
    sensor.read(row, 0)
    for _ in range(round(INTERVAL_S / TICK_S)):
        sensor.pass_tick(row)
    return sensor.read(row, 0)


# --- the sensor


@pytest.mark.parametrize(
    ("velocity", "rates", "flow"),
    [
        # Signs as MAVLink's OPTICAL_FLOW_RAD has them.
        ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.5)),
        ((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (-0.5, 0.0)),
        ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.3, -0.2, 0.7), (0.3, -0.2)),
    ],
)
def test_what_the_sensor_sees(
    velocity: tuple[float, float, float],
    rates: tuple[float, float, float],
    flow: tuple[float, float],
) -> None:
    reading = seen(QUIET, row_of(2.0, velocity, rates))
    assert reading.flow / INTERVAL_S == pytest.approx(flow)
    assert reading.interval_s == pytest.approx(INTERVAL_S)
    assert reading.quality == BEST and np.isnan(reading.turned).all()


def test_a_leaning_vehicle_sees_the_flow_of_its_own_axes() -> None:
    """Against the closed form: the point in the middle of the image, as the body turns and moves.

    It is R e_z d away from the sensor; in the body's axes it moves by -(v + w x r) - w x (d e_z).
    """
    lean = Rotation.from_euler("ZYX", [0.7, 0.2, -0.15])
    velocity, rates = np.array([1.5, -0.8, 0.3]), np.array([0.2, -0.4, 0.5])
    place = np.array([0.1, -0.05, 0.04])
    profile = QUIET.model_copy(update={"forward_m": 0.1, "right_m": -0.05, "down_m": 0.04})
    down = lean.apply([0.0, 0.0, 1.0])
    away = (3.0 - lean.apply(place)[2]) / down[2]
    moved = -(lean.inv().apply(velocity) + np.cross(rates, place)) - np.cross(rates, [0, 0, away])
    reading = seen(profile, row_of(3.0, tuple(velocity), tuple(rates), lean))
    # Motion to the right in the image is a positive turn about x; backward, one about y.
    assert reading.flow / INTERVAL_S == pytest.approx([moved[1] / away, -moved[0] / away], rel=1e-6)


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row_of(0.05), id="too near"),
        pytest.param(row_of(13.0), id="out of reach"),
        pytest.param(row_of(1.0, (8.0, 0.0, 0.0)), id="too fast"),
    ],
)
def test_out_of_its_limits_it_says_so(row: Vector) -> None:
    reading = seen(QUIET, row)
    assert reading.quality == INVALID and not reading.flow.any()


def test_its_noise_is_that_of_the_profile() -> None:
    profile = QUIET.model_copy(update={"noise_rad_s": 0.2})
    sensor = PlantOpticalFlow(profile, Site(None, np.random.default_rng(2), 1.0, TICK_S))
    row, found = row_of(2.0), []
    sensor.read(row, 0)
    for _ in range(2_000):
        for _ in range(5):
            sensor.pass_tick(row)
        found.append(sensor.read(row, 0).flow / INTERVAL_S)
    assert np.std(found, axis=0) == pytest.approx([0.2, 0.2], rel=0.1)


# --- the measurement's model


def test_the_jacobian_is_that_of_the_flow() -> None:
    """Against differences of the closed form, through the error state's own injection."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        state, ground = es.new_state(), rng.uniform(-0.5, 0.5)
        state[es.P : es.V] = rng.uniform(-1.0, 1.0, 3) - np.array([0.0, 0.0, 3.0])
        state[es.V : es.Q] = rng.uniform(-3.0, 3.0, 3)
        x, y, z, w = Rotation.from_euler("ZYX", rng.uniform(-0.5, 0.5, 3)).as_quat()
        state[es.Q : es.RATES] = w, x, y, z

        def flow(row: Vector, down: float) -> Vector:
            w, x, y, z = row[es.Q : es.RATES]
            lean = Rotation.from_quat([x, y, z, w])
            body = lean.inv().apply(row[es.V : es.Q])
            scale = lean.as_matrix()[2, 2] / (down - row[es.P + 2])
            return np.array([body[1] * scale, -body[0] * scale])

        w, x, y, z = state[es.Q : es.RATES]
        lean = Rotation.from_quat([x, y, z, w]).as_matrix()
        found = flow_by_errors(lean, state[es.V : es.Q], ground - state.item(es.P + 2))
        step, expected = 1e-6, np.zeros((2, es.N_STATES + 1))
        for i in range(es.N_STATES):
            ends = []
            for sign in (1.0, -1.0):
                error, moved = np.zeros(es.N_STATES), state.copy()
                error[i] = sign * step
                es.inject(moved, error)
                ends.append(flow(moved, ground))
            expected[:, i] = (ends[0] - ends[1]) / (2.0 * step)
        expected[:, -1] = (flow(state, ground + step) - flow(state, ground - step)) / (2.0 * step)
        assert found == pytest.approx(expected, abs=1e-6)


# --- the estimate in flight


def flown_by_flow(**changes: float) -> Rig:
    """The shipped vehicle with flow, on the ground."""
    profile = load_vehicle("quad-flow")
    parameters = {**profile.parameters, **changes}
    rig = Rig(3, vehicle=profile.model_copy(update={"parameters": parameters}))
    rig.run(1.0)
    assert rig.ap.set_origin(HOME) is Result.ACCEPTED
    rig.run(2.0)
    return rig


def flow_of(rig: Rig) -> OpticalFlowFusion:
    found = aids_of(rig).flow
    assert found is not None
    return found


def test_a_flight_by_flow_alone() -> None:
    """Against the truth: a velocity without drift, a position that drifts by little."""
    rig = flown_by_flow()
    assert rig.ap.estimator.healthy and not flow_of(rig).fused
    rig.take_off(2.5)
    assert flow_of(rig).fused
    errors: list[Vector] = []

    def look() -> None:
        estimate, truth = rig.ap.estimator.estimate(), rig.truth
        errors.append((estimate.velocity - truth.velocity)[:2])

    rig.go_offboard(velocity_setpoint(2.0, 0.0, 0.0))
    for north, east in ((2.0, 0.0), (0.0, 2.0), (-2.0, 0.0), (0.0, -2.0)):
        rig.stream(velocity_setpoint(north, east, 0.0))
        rig.run(4.0, look)
    assert np.sqrt(np.mean(np.square(errors))) < 0.06
    assert np.abs(np.mean(errors, axis=0)).max() < 0.03
    estimate, truth = rig.ap.estimator.estimate(), rig.truth
    off = (estimate.position - truth.position)[:2]
    assert math.hypot(*off.tolist()) < 0.6  # of a way of 32 m
    assert np.abs(off).max() < 3.0 * estimate.sigma[:2].max()
    state = rig.ap.state()
    assert payload("LOCAL_POSITION_NED", state) is not None
    assert optical_flow_rad(state) is not None


def test_flow_tells_how_far_the_ground_is_where_gps_tells_the_velocity() -> None:
    outdoors, profile = load_vehicle("quad"), load_vehicle("quad-flow")
    sensors = outdoors.sensors.model_copy(update={"optical_flow": profile.sensors.optical_flow})
    rig = Rig(3, vehicle=outdoors.model_copy(update={"sensors": sensors}))
    rig.run(3.0)
    rig.take_off(4.0)
    rig.go_offboard(velocity_setpoint(3.0, 0.0, 0.0))
    rig.run(6.0)
    found = rig.ap.state().clearance
    assert found is not None and found.valid
    assert found.dist_bottom_m == pytest.approx(-rig.truth.position[2], rel=0.15)


def test_switched_off_it_tells_nothing() -> None:
    rig = flown_by_flow(EKF2_OF_CTRL=0)
    assert not rig.ap.estimator.knows_position(rig.sim.time_us, flying=False)
    assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED


def tampered(rig: Rig, change: Callable[[FlowReading], FlowReading | None]) -> None:
    """Change what flow measures from now on."""
    step = rig.ap.step

    def changed(sample: SensorSample) -> SensorSample:
        return sample if sample.flow is None else sample._replace(flow=change(sample.flow))

    rig.step_through(lambda sample: step(changed(sample)))


@pytest.mark.nightly
def test_absurd_flow_has_no_part_in_where_the_velocity_is_put() -> None:
    rig = flown_by_flow()
    rig.take_off(2.5)
    fails, rng = [True], np.random.default_rng(5)

    def absurd(told: FlowReading) -> FlowReading:
        if not fails[0]:
            return told
        return told._replace(flow=1e30 * rng.standard_normal(2), interval_s=1e-6, quality=BEST)

    tampered(rig, absurd)
    rig.run(1.5)
    fails[0] = False
    rig.run(4.0)
    assert flow_of(rig).fused
    estimate = rig.ap.estimator.estimate()
    assert np.abs(estimate.velocity - rig.truth.velocity).max() < 0.2


def test_a_low_quality_is_not_fused_in_the_air() -> None:
    rig = flown_by_flow(EKF2_OF_QMIN=60)
    rig.take_off(2.5)
    fused_us = flow_of(rig).fused_us
    assert fused_us is not None
    tampered(rig, lambda told: told._replace(quality=50))
    rig.run(2.0)
    assert not flow_of(rig).fused
    assert flow_of(rig).fused_us == pytest.approx(fused_us, abs=30_000)


def test_what_repeats_itself_is_fused_a_few_times_and_zeros_always() -> None:
    rig = flown_by_flow()
    rig.take_off(2.5)
    flow = flow_of(rig)
    held = FlowReading(np.array([0.001, -0.002]), INTERVAL_S, BEST, np.full(3, NAN))
    told = [held]
    tampered(rig, lambda _: told[0])
    rig.run(0.5)
    assert rig.sim.time_us - (flow.fused_us or 0) > 200_000
    assert (flow.fused_us or 0) - (rig.sim.time_us - 500_000) <= (STUCK + 1) * 20_000
    told[0] = held._replace(flow=np.zeros(2))
    rig.run(0.5)
    assert rig.sim.time_us - (flow.fused_us or 0) <= 40_000


@pytest.mark.nightly
@pytest.mark.parametrize(
    "case",
    [case for case in FITTED_CASES if case.fault.startswith("flow")],
    ids=lambda case: case.fault,
)
def test_how_a_flight_ends_with_flow_that_fails(case: Case) -> None:
    found = fly_fault(load_vehicle("quad-flow"), case.fault, "offboard", 1)
    assert found.end in case.ends
    assert found.touchdown_m_s is not None and found.touchdown_m_s < TOUCHDOWN_M_S


def test_flow_that_a_vehicle_lacks_cannot_fail() -> None:
    with pytest.raises(FieldError, match=r"with a vehicle that has flow"):
        resolve(Scenario(vehicle="quad-vio", faults=("flow off",), level="lockstep"))


# --- messages


def flow_message(**changes: Any) -> Any:
    fields: dict[str, Any] = {
        "time_usec": 1,
        "sensor_id": 0,
        "integration_time_us": 20_000,
        "integrated_x": 0.01,
        "integrated_y": -0.02,
        "integrated_xgyro": 0.001,
        "integrated_ygyro": 0.002,
        "integrated_zgyro": 0.003,
        "temperature": 0,
        "quality": 200,
        "time_delta_distance_us": 0,
        "distance": -1.0,
    }
    return dialect.MAVLink_optical_flow_rad_message(**{**fields, **changes})


def read(message: Any) -> list[FlowReading]:
    """Return what a message hands to the autopilot."""
    rig = mavlink_clients.Rig()
    rig.client.send(message)
    rig.bench.tick()
    return rig.autopilot.received["flow"]


def test_what_a_client_s_sensor_says() -> None:
    (reading,) = read(flow_message())
    assert reading.flow == pytest.approx([0.01, -0.02])
    assert reading.turned == pytest.approx([0.001, 0.002, 0.003])
    assert (reading.interval_s, reading.quality) == (0.02, 200)


@pytest.mark.parametrize(
    "changes",
    [
        {"integrated_x": NAN},
        {"integration_time_us": 0},
        {"integration_time_us": 1_000_000},
        {"integrated_y": math.inf},
    ],
)
def test_what_is_no_measurement_is_not_taken(changes: dict[str, Any]) -> None:
    (reading,) = read(flow_message(**changes))
    rig = flown_by_flow()
    before = flow_of(rig).reading_us
    tampered(rig, lambda _: None)
    rig.run(0.1)
    rig.ap.receive("flow", reading)
    assert flow_of(rig).reading_us == before


def test_what_px4_is_told_is_read_as_it_was_meant() -> None:
    """There and back: the simulator's message to PX4, read by pymavlink."""
    meant = FlowReading(np.array([0.01, -0.02]), 0.02, 200, np.full(3, NAN))
    frame = Encoder().frame(hil.FLOW, hil.FLOW.payload(hil.flow(meant, 5_000)))
    (message,) = dialect.MAVLink(None).parse_buffer(frame)
    assert (message.time_usec, message.integration_time_us) == (5_000, 20_000)
    assert (message.integrated_x, message.integrated_y) == pytest.approx((0.01, -0.02))
    assert math.isnan(message.integrated_xgyro) and message.quality == 200
    assert message.distance < 0.0  # PX4 takes it for a range where it is not negative


def test_what_clients_and_the_log_are_told() -> None:
    rig = flown_by_flow()
    rig.take_off(2.5)
    state = rig.ap.state()
    told, time_us = state.readings["flow"]
    sent = optical_flow_rad(state)
    assert sent is not None
    assert sent[:5] == (time_us, 0, 20_000, *told.flow.tolist())
    frame = Encoder().frame(layout("OPTICAL_FLOW_RAD"), layout("OPTICAL_FLOW_RAD").payload(sent))
    (message,) = dialect.MAVLink(None).parse_buffer(frame)
    assert message.integrated_x == pytest.approx(told.flow.item(0), rel=1e-6)
    assert (message.quality, message.distance) == (BEST, -1.0)
    # The sensor has no gyro: the vehicle's turn stands in.
    assert np.isfinite(sent[5:8]).all() and sent[5:8] == tuple(told.turned.tolist())
    logged = OPTICAL_FLOW.topics["vehicle_optical_flow"].values(state)
    assert logged is not None
    assert logged[2:4] == tuple(told.flow.tolist()) and logged[8] == 20_000
    tampered(rig, lambda _: None)
    rig.run(0.3)
    assert optical_flow_rad(rig.ap.state()) is None

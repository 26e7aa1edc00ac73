"""A rangefinder in flight: terrain estimate, height control, and messages to clients."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.addons.fault_matrix.matrix import FITTED_CASES, STANDS, Case, fly_fault
from airl_mav.arena.geometry import Arena, Bounds, Obstacles
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import HOME
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.addons.auxiliary_estimation.range_finder import RangeFinder
from firmware_sim.addons.auxiliary_estimation.sensors import distance_sensor
from firmware_sim.addons.flight_log import topics
from firmware_sim.autopilot.autopilot_state import Clearance, Result
from firmware_sim.autopilot.error_state import V
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.land_detector import LandDetector
from firmware_sim.autopilot.modes.automatic import landing_speed
from firmware_sim.autopilot.modes.interface import Source, Sticks
from firmware_sim.autopilot.modes.sticks import Piloting, TerrainHold
from firmware_sim.engine.record import LANDING, new_controller
from firmware_sim.engine.ticks import detect_record
from firmware_sim.external import hil_messages as hil
from firmware_sim.interfaces import DOWNWARD, DistanceReading, SensorSample
from firmware_sim.mavlink import telemetry
from firmware_sim.mavlink.codec import Encoder
from firmware_sim.mavlink.streams import sensors, status
from firmware_sim.simulation import TOUCHDOWN_M_S
from tests.support import mavlink_clients
from tests.support.flight_rig import Rig, aids_of, velocity_setpoint

NAN = math.nan
CENTRED = Sticks(0.0, 0.0, 0.0, 0.0)
BOX_M = 1.0


def box() -> Arena:
    """A room with a box of 3 x 3 x 1 m, 6 m north of the start."""
    return Arena(
        "one-box",
        0,
        Bounds(-20.0, 40.0, -20.0, 20.0, 6.0),
        (200, 200, 200),
        Obstacles(
            np.zeros(1, np.int8),
            np.array([[6.0, 0.0, -0.5 * BOX_M]]),
            np.array([[1.5, 1.5, 0.5 * BOX_M]]),
            np.zeros(1),
        ),
        (),
        np.array([30.0, 0.0]),
    )


def indoors(arena: Arena | None = None, *, gps: bool = False, **changes: float) -> Rig:
    """Return a rig of the shipped vehicle with a rangefinder; `gps` replaces vision."""
    profile = load_vehicle("quad-indoor")
    parameters = {**profile.parameters, **changes}
    if gps:
        outdoors = load_vehicle("quad")
        sensors = outdoors.sensors.model_copy(update={"rangefinder": profile.sensors.rangefinder})
        own = {n: v for n, v in profile.parameters.items() if "RNG" in n}
        profile = outdoors.model_copy(update={"sensors": sensors})
        parameters = {**outdoors.parameters, **own, **changes}
    rig = Rig(3, arena=arena, vehicle=profile.model_copy(update={"parameters": parameters}))
    if not gps:
        assert rig.ap.set_origin(HOME) is Result.ACCEPTED
    rig.run(3.0)
    return rig


def finder(rig: Rig) -> RangeFinder:
    found = aids_of(rig).range
    assert found is not None
    return found


def clearance(rig: Rig) -> Clearance:
    found = rig.ap.state().clearance
    assert found is not None
    return found


def tampered(rig: Rig, change: Callable[[SensorSample], SensorSample]) -> None:
    """Change what is measured from now on."""
    step = rig.ap.step
    rig.step_through(lambda sample: step(change(sample)))


def farther(sample: SensorSample, by_m: float) -> SensorSample:
    told = sample.distance
    if told is None:
        return sample
    return sample._replace(distance=told._replace(distance_m=told.distance_m + by_m))


# --- the estimate


def test_a_flight_over_a_box() -> None:
    """Compare the ground distance over floor and box, as clients receive it, with the truth."""
    rig = indoors(box())
    on_ground = clearance(rig)
    # Nearer than it measures: it stands as high as the profile says.
    assert on_ground.valid and on_ground.dist_bottom_m == pytest.approx(0.055, abs=1e-3)
    rig.take_off(2.5)
    rig.go_offboard(velocity_setpoint(1.0, 0.0, 0.0))
    errors: dict[str, list[float]] = {"floor": [], "box": []}

    def look() -> None:
        north, _, down = rig.truth.position.tolist()
        beside = abs(north - 6.0) - 1.5
        if abs(beside) > 0.5:
            below = BOX_M if beside < 0.0 else 0.0
            part = "box" if below else "floor"
            errors[part].append(clearance(rig).dist_bottom_m + down + below)

    rig.run(11.0, look)
    assert len(errors["box"]) > 300 and len(errors["floor"]) > 1000
    for part in errors.values():
        # PX4 1.16: means of -7 to 3 mm, 16 mm (rms), scripts/rangefinder_compared.py.
        assert np.mean(part) == pytest.approx(0.0, abs=0.02)
        assert np.std(part) < 0.04
    state = rig.ap.state()
    ground, told, down = (
        state.clearance,
        state.readings["distance"].reading,
        float(state.estimate.position[2]),
    )
    assert ground is not None and told is not None and ground.by_range
    terrain, bottom = sensors.clearance(state, float(state.estimate.position[2]))
    assert bottom == ground.dist_bottom_m and terrain == -down - ground.dist_bottom_m
    sent = distance_sensor(state)
    assert sent is not None
    assert sent[1:7] == (10, 1200, int(told.distance_m * 100.0), 0, 0, DOWNWARD)
    sent_status = status.estimator_status(state)
    assert sent_status[1] & dialect.ESTIMATOR_POS_VERT_AGL
    assert 0.0 < sent_status[6] < 1.0
    (logged,) = (each for each in topics.TOPICS if each.topic.name == "vehicle_local_position")
    row = logged.messages(topics.Moment(telemetry.flown_of(state), np.zeros(0), state))
    assert row is not None
    assert row["dist_bottom"] == pytest.approx(ground.dist_bottom_m)
    assert row["dist_bottom_var"] == pytest.approx(ground.variance_m2)
    assert row["dist_bottom_valid"] and row["dist_bottom_reset_counter"] == ground.resets
    assert row["dist_bottom_sensor_bitfield"] == 1
    # Down to the floor: slowest below MPC_LAND_ALT3.
    rig.stream(velocity_setpoint(0.0, 0.0, 0.0))
    rig.run(2.0)
    assert rig.ap.set_mode(Mode.LAND) is Result.ACCEPTED
    rig.until(lambda: rig.height < 0.5, 20.0)
    took_s = rig.until(lambda: rig.height < 0.2, 20.0)
    assert 0.3 / took_s == pytest.approx(0.3, abs=0.06)
    rig.until(lambda: rig.ap.flight.phase == 1, 40.0)


def test_ranges_that_are_not_fused_tell_no_ground() -> None:
    rig = indoors(EKF2_RNG_CTRL=0)
    rig.take_off(2.0)
    assert not clearance(rig).valid and not finder(rig).tells_ground
    state = rig.ap.state()
    terrain, bottom = sensors.clearance(state, float(state.estimate.position[2]))
    assert math.isnan(terrain) and math.isnan(bottom)
    assert distance_sensor(rig.ap.state()) is not None


def test_the_ground_as_the_reference_of_height() -> None:
    """A barometer that goes wrong by 4 m does not lift a vehicle that counts from the ground."""
    rig = indoors(gps=True, EKF2_HGT_REF=2, EKF2_RNG_CTRL=2, EKF2_MIN_RNG=0.055)
    ranges = finder(rig)
    assert ranges.is_reference and ranges.tells_height and not ranges.tells_ground
    # The body's centre, as high above the floor as it is known to be.
    assert rig.ap.state().estimate.position[2] == pytest.approx(-0.055, abs=0.05)
    rig.take_off(2.5)
    assert ranges.is_reference
    tampered(
        rig,
        lambda s: s if s.pressure_hpa is None else s._replace(pressure_hpa=s.pressure_hpa - 0.5),
    )
    errors: list[float] = []
    rig.run(
        8.0,
        lambda: errors.append(float(rig.ap.state().estimate.position[2] - rig.truth.position[2])),
    )
    assert np.abs(errors).max() < 0.1
    assert rig.height == pytest.approx(2.5, abs=0.3)


def test_conditional_aid_is_for_low_and_slow_flight() -> None:
    rig = indoors(EKF2_RNG_A_HMAX=4.0, EKF2_RNG_A_VMAX=1.0)
    ranges = finder(rig)
    rig.take_off(2.0)
    rig.run(3.0)
    assert ranges.tells_height and ranges.tells_ground and not ranges.is_reference
    rig.go_offboard(velocity_setpoint(3.0, 0.0, 0.0))
    rig.run(3.0)
    assert ranges.tells_ground and not ranges.tells_height
    rig.stream(velocity_setpoint(0.0, 0.0, -1.0))
    rig.run(4.0)
    # Slow again, and above EKF2_RNG_A_HMAX.
    assert rig.height > 4.2
    assert ranges.tells_ground and not ranges.tells_height


def test_ranges_that_stay_while_the_vehicle_climbs_are_given_up() -> None:
    rig = indoors()
    rig.take_off(2.0)
    held: list[DistanceReading] = []

    def stuck(sample: SensorSample) -> SensorSample:
        if sample.distance is None:
            return sample
        if not held:
            held.append(sample.distance)
        return sample._replace(distance=held[0])

    tampered(rig, stuck)
    before = rig.ap.state().estimate.position[2] - rig.truth.position[2]
    # Of ranges 50 ms apart, each of 5 cm: 3 m/s are seen, by PX4 as well.
    rig.go_offboard(velocity_setpoint(0.0, 0.0, -3.0))
    rig.run(4.0)
    assert not finder(rig).consistency.is_consistent
    assert not finder(rig).tells_ground and not finder(rig).tells_height
    rig.run(1.5)
    assert not clearance(rig).valid
    after = rig.ap.state().estimate.position[2] - rig.truth.position[2]
    assert after == pytest.approx(before, abs=0.25)


# --- what is flown by it


@pytest.mark.nightly
@pytest.mark.parametrize(("mode", "follows"), [(2, True), (0, False), (1, False)])
def test_position_keeps_the_height_above_ground_while_it_stands(mode: int, follows: bool) -> None:
    """Ground that rises by 0.6 m in 6 s lifts the vehicle, where MPC_ALT_MODE says so."""
    rig = indoors(MPC_ALT_MODE=mode, COM_RC_IN_MODE=1.0)
    rig.take_off(2.0)
    rig.ap.manual_control(CENTRED, Source.JOYSTICK, rig.sim.time_us)
    assert rig.ap.set_mode(Mode.POSITION) is Result.ACCEPTED

    def fly(seconds: float) -> None:
        rig.run(
            seconds,
            lambda: rig.ap.manual_control(CENTRED, Source.JOYSTICK, rig.sim.time_us),
        )

    fly(3.0)
    began_us, before = rig.sim.time_us, rig.height
    tampered(rig, lambda s: farther(s, -min(0.6, 0.1 * (s.time_us - began_us) / US_PER_S)))
    fly(11.0)
    assert rig.height - before == pytest.approx(0.6 if follows else 0.0, abs=0.2)


def piloting(**changes: Any) -> Piloting:
    return Piloting(
        **{
            "level": 0.0,
            "climbing": False,
            "speed_m_s": 0.0,
            "climb_m_s": 0.0,
            "down_m": -2.0,
            "ground_m": 2.0,
            "resets": 0,
            **changes,
        }
    )


def test_when_the_ground_is_held() -> None:
    """The branches of PX4's FlightTaskManualAltitude::_updateAltitudeLock."""
    asked = {"MPC_ALT_MODE": 2.0, "MPC_HOLD_MAX_XY": 0.8, "MPC_HOLD_MAX_Z": 0.6}
    hold = TerrainHold(asked.__getitem__)
    # Too fast: the altitude, and at half the speed the ground, with the error that there was.
    assert hold.place(piloting(speed_m_s=0.5), -2.3) == -2.3 and not hold.holds
    assert hold.place(piloting(speed_m_s=0.3), -2.3) == pytest.approx(-2.3)
    assert hold.holds and hold.locked_m == pytest.approx(2.3)
    # The ground rises by 0.5 m.
    assert hold.place(piloting(ground_m=1.5), -2.3) == pytest.approx(-2.8)
    # A little speed is no reason to let go, a deflected stick is.
    assert hold.place(piloting(speed_m_s=0.7), -2.3) == pytest.approx(-2.3) and hold.holds
    assert hold.place(piloting(level=0.2), -2.1) == -2.1 and not hold.holds
    hold.place(piloting(), -2.3)
    assert hold.place(piloting(ground_m=NAN), -2.1) == -2.1 and not hold.holds
    # The throttle unlocks; the height after the vehicle has stopped is held.
    hold.place(piloting(), -2.3)
    assert math.isnan(hold.place(piloting(climbing=True), NAN)) and hold.holds
    assert math.isnan(hold.place(piloting(climb_m_s=0.7), NAN))
    assert hold.place(piloting(down_m=-3.0, ground_m=3.0), NAN) == pytest.approx(-3.0)
    # Ground that was reset is locked again.
    assert hold.place(piloting(down_m=-3.0, ground_m=2.0, resets=1), NAN) == pytest.approx(-3.0)
    asked["MPC_ALT_MODE"] = 1.0
    assert hold.place(piloting(), -2.3) == -2.3 and not hold.holds


def test_the_speed_of_landing_over_ground_that_is_known() -> None:
    asked = {
        "MPC_LAND_ALT1": 10.0,
        "MPC_LAND_ALT2": 5.0,
        "MPC_LAND_ALT3": 1.0,
        "MPC_LAND_SPEED": 0.7,
        "MPC_LAND_CRWL": 0.3,
        "MPC_Z_V_AUTO_DN": 1.5,
    }
    value = asked.__getitem__
    assert landing_speed(value, 0.5) == 0.7
    assert landing_speed(value, 0.5, 0.5) == 0.3
    assert landing_speed(value, 0.5, 7.5) == pytest.approx(1.1)
    assert landing_speed(value, 20.0, 4.0) == 0.7


def ground(dist_bottom_m: float, *, valid: bool = True, by_range: bool = True) -> Clearance:
    return Clearance(dist_bottom_m, valid, 0.01, by_range, 0, 0.1)


@pytest.mark.parametrize(
    ("told", "needed_s"),
    [
        (None, 1.0),
        (ground(0.1), 1.0),
        (ground(2.0), NAN),
        (ground(2.0, valid=False), 3.0),
        # Ranges that never determined the ground have no effect.
        (ground(2.0, by_range=False), 1.0),
    ],
)
def test_landing_is_believed_near_the_ground(told: Clearance | None, needed_s: float) -> None:
    assert landing_s(told) == pytest.approx(needed_s, nan_ok=True)


@pytest.mark.parametrize(
    ("down_m_s", "needed_s"), [(NAN, 1.0), (0.1, 1.0), (0.0, NAN), (-0.1, NAN)]
)
def test_landing_is_believed_unless_the_height_is_held(down_m_s: float, needed_s: float) -> None:
    assert landing_s(None, down_m_s) == pytest.approx(needed_s, nan_ok=True)


def landing_s(told: Clearance | None, down_m_s: float = 0.1) -> float:
    """Return the landing time [s] of a vehicle at rest with a downward setpoint; NaN = never."""
    asked = {
        "LNDMC_TRIG_TIME": 1.0,
        "LNDMC_Z_VEL_MAX": 0.25,
        "LNDMC_XY_VEL_MAX": 1.5,
        "MPC_THR_MIN": 0.12,
        "MPC_THR_HOVER": 0.5,
    }
    record = new_controller()
    LandDetector(asked.__getitem__, record).see(told)
    record["detecting"], record["state"][0, V + 2] = LANDING, 0.1
    record["output"][0, 7:] = 0.0, 0.0, down_m_s, 0.12  # velocity, thrust

    def detected(ms: int) -> bool:
        record["time_us"] = ms * 1_000
        return detect_record(record)

    return next((ms / 1e3 for ms in range(0, 10_000, 100) if detected(ms)), NAN)


# --- messages


def read(message: Any) -> list[DistanceReading]:
    rig = mavlink_clients.Rig()
    rig.client.send(message)
    rig.bench.tick()
    return rig.autopilot.received["distance"]


def distance_message(**changes: Any) -> Any:
    fields: dict[str, Any] = {
        "time_boot_ms": 1,
        "min_distance": 10,
        "max_distance": 1200,
        "current_distance": 345,
        "type": dialect.MAV_DISTANCE_SENSOR_LASER,
        "id": 3,
        "orientation": dialect.MAV_SENSOR_ROTATION_PITCH_270,
        "covariance": 4,
        "signal_quality": 0,
    }
    return dialect.MAVLink_distance_sensor_message(**{**fields, **changes})


@pytest.mark.parametrize(
    ("told", "quality"), [(0, -1), (1, 0), (100, 100), (50, 49), (101, 100), (255, 100)]
)
def test_what_a_client_s_sensor_says(told: int, quality: int) -> None:
    (reading,) = read(distance_message(signal_quality=told))
    assert reading.distance_m == pytest.approx(3.45)
    assert (reading.least_m, reading.greatest_m) == pytest.approx((0.1, 12.0))
    assert reading.variance_m2 == pytest.approx(4e-4)
    assert (reading.quality, reading.orientation, reading.kind) == (quality, DOWNWARD, 0)


def test_what_px4_is_told_is_read_as_it_was_meant() -> None:
    """There and back: the simulator's message to PX4, read as a message of a companion."""
    for quality in (-1, 0, 100):
        meant = DistanceReading(2.345, 0.1, 12.0, 0.0004, quality)
        frame = Encoder().frame(hil.DISTANCE, hil.DISTANCE.payload(hil.distance(meant, 5_000)))
        (message,) = dialect.MAVLink(None).parse_buffer(frame)
        (found,) = read(message)
        assert found.distance_m == pytest.approx(meant.distance_m, abs=0.0051)
        assert found._replace(distance_m=0.0) == pytest.approx(meant._replace(distance_m=0.0))


def test_a_client_s_rangefinder_tells_the_ground_and_another_direction_does_not() -> None:
    rig = Rig(3, vehicle=load_vehicle("quad"))
    rig.run(3.0)
    assert rig.ap.state().clearance is None
    every = [0]

    def tell(reading: Callable[[], DistanceReading]) -> None:
        every[0] += 1
        if every[0] % 10 == 0:
            rig.ap.receive("distance", reading())

    forward = DistanceReading(4.0, 0.1, 12.0, quality=100, orientation=0)
    rig.run(2.0, lambda: tell(lambda: forward))
    assert rig.ap.state().readings["distance"].reading == forward
    assert not clearance(rig).valid
    down = DistanceReading(0.3, 0.1, 12.0, quality=100)
    rig.run(2.0, lambda: tell(lambda: down))
    assert clearance(rig).valid
    assert clearance(rig).dist_bottom_m == pytest.approx(0.3, abs=0.02)
    # Without new ranges, the message stops and fusion ends.
    rig.run(1.0)
    assert distance_sensor(rig.ap.state()) is None
    assert not finder(rig).tells_ground


# --- failures


@pytest.mark.nightly
@pytest.mark.parametrize(
    "case",
    [case for case in FITTED_CASES if case.fault.startswith("rangefinder")],
    ids=lambda case: case.fault,
)
def test_how_a_flight_ends_with_a_rangefinder_that_fails(case: Case) -> None:
    found = fly_fault(load_vehicle("quad-indoor"), case.fault, "offboard", 1)
    assert found.end in case.ends
    # Stuck at 5 m no ground is near: a real PX4 1.16 does not know that it stands, either.
    # (scripts/rangefinder_compared.py --faults "rangefinder stuck at 25s")
    assert (found.end == "flying") is (case.ends == STANDS)
    if found.touchdown_m_s is not None:
        assert found.touchdown_m_s < TOUCHDOWN_M_S


def test_a_rangefinder_that_a_vehicle_lacks_cannot_fail() -> None:
    with pytest.raises(FieldError, match=r"with a vehicle that has rangefinder"):
        resolve(Scenario(vehicle="quad-vio", faults=("rangefinder off",), level="lockstep"))


def test_arming_waits_for_a_sensor_that_is_asked_for() -> None:
    rig = Rig(3, parameters={"SYS_HAS_NUM_DIST": 1.0})
    bit = dialect.MAV_SYS_STATUS_SENSOR_LASER_POSITION
    rig.boot()
    rig.run(1.0)
    assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
    assert not math.isnan(rig.said("Preflight Fail: Distance Sensor 0 missing"))
    assert not status.sensor_bits(rig.ap.state())[0] & bit
    reading = DistanceReading(0.3, 0.1, 12.0, quality=100)
    rig.run(0.5, lambda: rig.ap.receive("distance", reading))
    assert all(field & bit for field in status.sensor_bits(rig.ap.state()))
    rig.run(1.5)
    present, enabled, healthy = status.sensor_bits(rig.ap.state())
    assert present & bit and enabled & bit and not healthy & bit
    assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
    assert not math.isnan(rig.said("Preflight Fail: No valid distance sensor 0 data"))
    rig.run(0.5, lambda: rig.ap.receive("distance", reading))
    assert rig.ap.arm(force=False) is Result.ACCEPTED

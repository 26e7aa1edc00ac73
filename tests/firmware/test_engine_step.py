"""Compiled ticks against plain Python: control, sensors, fusion, events and logs.

Motion and power are compared with recorded values. `python -m tests.firmware.test_engine_step`
records them again, after a change on purpose.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.control import cascade
from airl_mav.control.demand import (
    AnyDemand,
    AttitudeDemand,
    Demand,
    Gains,
    RateDemand,
    TrajectoryDemand,
)
from airl_mav.core import frames
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S, TICK_US, US_PER_S
from airl_mav.vehicle import atmosphere
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.alignment import ALIGN_US
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.land_detector import LandDetector
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.autopilot.recovery import FAR, REFUSED_US
from firmware_sim.engine import record, ticks
from firmware_sim.engine.controller import Controller
from firmware_sim.engine.record import GPS, MAG, PRESSURE, Record
from firmware_sim.interfaces import BatterySample, GpsFix, SensorSample
from firmware_sim.plant.plant import Plant
from tests.support.flight_rig import quad

RECORDED = Path(__file__).parents[1] / "support" / "engine_step.json"
PARAMETERS = Parameters(quad().parameters)
GAINS = Gains.from_parameters(PARAMETERS.value)
NAN = math.nan
NAN3 = (NAN, NAN, NAN)
START_US = 500 * TICK_US
ROWS = 64
"""Rows of each noise block."""

DEMANDS: dict[str, AnyDemand | None] = {
    "idle": None,
    "position": Demand((1.0, -2.0, -6.0), NAN3, 0.4, NAN),
    "velocity": Demand(NAN3, (1.0, -0.5, 0.3), NAN, 0.5),
    "trajectory": TrajectoryDemand((1.0, 2.0, NAN), (0.1, 0.2, -0.5), (0.3, 0.1, 0.2), 0.25, 0.15),
    "attitude": AttitudeDemand((0.98, 0.12, -0.1, 0.12), 0.3, 0.6),
    "rates": RateDemand((0.4, -0.3, 0.2), 0.55),
}


@dataclass
class Craft:
    """Vehicle in flight: its records, the noise of its sensors, wind, and logs."""

    aircraft: Record
    sample: Record
    controller: Record
    noise: list[np.ndarray]
    wind: np.ndarray
    truths: Record
    flown: Record

    @property
    def a(self) -> Any:
        return self.aircraft[0]

    @property
    def c(self) -> Any:
        return self.controller[0]

    @property
    def s(self) -> Any:
        return self.sample[0]

    def copy(self) -> Craft:
        every = (self.aircraft, self.sample, self.controller, self.truths, self.flown)
        aircraft, sample, controller, truths, flown = (each.copy() for each in every)
        return Craft(aircraft, sample, controller, self.noise, self.wind, truths, flown)

    def fly(self, number: int, first: int = 0) -> tuple[int, int]:
        """Fly ticks; return the number of complete ticks, and the event."""
        logs = self.truths[first:], self.flown[first:]
        inertial, compass, barometer, gps = self.noise
        vehicle = self.aircraft, self.sample, self.controller
        told = ticks.stretch(*vehicle, number, inertial, compass, barometer, gps, self.wind, *logs)
        return told >> ticks.EVENT_BITS, told & ticks.EVENT_MASK

    def bytes(self) -> bytes:
        every = (self.aircraft, self.sample, self.controller, self.truths, self.flown)
        return b"".join(each.tobytes() for each in every)


@cache
def constants() -> Record:
    plant = Plant(quad(), None, np.random.default_rng(0))
    plant.close()
    return plant.record


def estimator_of(controller: Record) -> Estimator:
    """Return the estimator in Python on a copy of a flight controller's record."""
    copy = record.new_controller()
    estimator = Estimator(PARAMETERS.value, record=copy)
    copy[:] = controller
    estimator.origin = frames.Geodetic(*controller["origin"][0].tolist())
    return estimator


def craft(seed: int = 0, demand: str = "position") -> Craft:
    """Return a vehicle in flight, with the estimate near the truth, and all sensors due."""
    rng = np.random.default_rng(seed)
    aircraft, controller, sample = constants().copy(), record.new_controller(), record.new_sample()
    motion = np.zeros(16)
    motion[:3] = rng.uniform(-3, 3, 3) - [0, 0, 6]
    motion[3:6], motion[10:13] = rng.uniform(-2, 2, 3), rng.uniform(-0.5, 0.5, 3)
    motion[6:10] = frames.quat_from_euler(*rng.uniform([-0.3, -0.3, -1.2], [0.3, 0.3, 1.2]))
    motion[13:16] = rng.normal(0, 0.3, 3) - [0, 0, GRAVITY_M_S2]
    for name, value in (
        ("ticks", START_US // TICK_US),
        ("time_us", START_US),
        ("motion", motion),
        ("speeds", rng.uniform(0.5, 0.8, 4)),
        ("acceleration", rng.normal(0, 0.5, 3)),
        ("charge", 0.8),
        ("room_m", 60.0),
        ("closing_m_s", 0.7),
        ("gps_error", rng.normal(0, 0.1, 3)),
        ("accel_bias", rng.normal(0, 0.02, 3)),
        ("gyro_bias", rng.normal(0, 0.002, 3)),
        ("baro_drift_pa", 3.0),
        ("mag_rate", (125.0, 0.0, 0.0)),
        ("baro_rate", (83.0, 0.0, 0.0)),
        ("gps_rate", (50.0, 0.0, 0.0)),
    ):
        aircraft[name] = value
    sample["gps_epv_m"] = 0.2 + 0.6 * (seed % 2)
    estimator = Estimator(PARAMETERS.value, record=controller)
    estimator.origin, estimator.aligned = frames.HOME, True
    estimator.prepare()
    controller["origin"] += [2e-5, -1e-5, 3.0]
    LandDetector(PARAMETERS.value, controller)
    Controller(GAINS, controller).command(DEMANDS[demand])
    state = controller["state"][0]
    state[:13] = motion[:13] + rng.normal(0, 1e-3, 13)
    state[6:10] /= np.linalg.norm(state[6:10])
    # The fixes are relative to HOME, the state to the filter's origin.
    here = frames.local_to_geodetic(state[:3], frames.HOME)
    state[:3] = frames.geodetic_to_local(here, frames.Geodetic(*controller["origin"][0]))
    state[13:20] = rng.normal(0, 0.01, 7)
    root = rng.normal(0, 0.03, (16, 16)) * es.INITIAL_SIGMA[:, None]
    controller["covariance"] = root @ root.T + np.diag((0.1 * es.INITIAL_SIGMA) ** 2)
    controller["baro_origin_m"] = frames.HOME.altitude_m + 3.0
    controller["time_us"], controller["gps_horizontal_us"] = START_US, START_US - TICK_US
    controller["flying"] = controller["healthy"] = 1
    controller["still_since_us"] = 7
    noise = [rng.standard_normal((ROWS, width)) for width in (12, 3, 2, 9)]
    wind = rng.normal(0, 1.5, (ROWS, 3))
    logs = np.zeros(ROWS, record.TRUE_TICK), np.zeros(ROWS, record.FLOWN_TICK)
    return Craft(aircraft, sample, controller, noise, wind, *logs)


def same(ours: Record, theirs: Record, *but: str, rtol: float = 1e-9, atol: float = 1e-11) -> None:
    for name in ours.dtype.names or ():
        if name not in but and name != "gains":
            np.testing.assert_allclose(ours[name], theirs[name], rtol=rtol, atol=atol, err_msg=name)


# --- many ticks


@pytest.mark.parametrize("demand", DEMANDS)
def test_ticks_together_are_those_one_by_one(demand: str) -> None:
    together = craft(3, demand)
    alone = together.copy()
    assert together.fly(12) == (12, ticks.NONE)
    assert [alone.fly(1, k) for k in range(12)] == [(1, ticks.NONE)] * 12
    assert together.bytes() == alone.bytes()
    assert together.a["time_us"] == together.c["time_us"] == START_US + 12 * TICK_US
    assert together.truths["time_us"][:13].tolist() == [
        *range(START_US + TICK_US, START_US + 13 * TICK_US, TICK_US),
        0,
    ]
    assert together.flown["time_us"][:12].tolist() == [START_US + k * TICK_US for k in range(12)]
    assert together.a["noise_at"][[0, 4]].tolist() == [12, 12]


@pytest.mark.parametrize("block", range(5))
def test_a_used_up_block_of_noise_ends_a_stretch_before_its_tick(block: int) -> None:
    vehicle = craft(1)
    for name in ("mag_rate", "baro_rate", "gps_rate"):
        vehicle.aircraft[name] = 250.0, 0.0, 0.0
    whole = vehicle.copy()
    assert whole.fly(2) == (2, ticks.NONE)
    if block < 4:
        vehicle.noise[block] = vehicle.noise[block][:2]
    else:
        vehicle.wind = vehicle.wind[:2]
    assert vehicle.fly(9) == (2, ticks.NOISE)
    assert vehicle.bytes() == whole.bytes()
    assert vehicle.fly(9) == (0, ticks.NOISE)
    assert vehicle.bytes() == whole.bytes()


def test_constant_wind_is_one_row() -> None:
    steady, rows = craft(2), craft(2)
    steady.wind, rows.wind = steady.wind[:1], np.repeat(rows.wind[:1], ROWS, axis=0)
    steady.aircraft["noise_at"][0, 4] = rows.aircraft["noise_at"][0, 4] = 5
    assert steady.fly(8) == rows.fly(8) == (8, ticks.NONE)
    assert steady.a["noise_at"][4] == 5
    assert rows.a["noise_at"][4] == 13
    rows.aircraft["noise_at"] = steady.aircraft["noise_at"]
    assert steady.bytes() == rows.bytes()


def test_a_stretch_ends_where_a_contact_is_possible() -> None:
    vehicle = craft(4)
    # The speed of approach in 3 ticks and the gap: the fourth tick may touch.
    motion, a = vehicle.a["motion"], vehicle.a
    nearing = TICK_S * (
        0.7 + np.linalg.norm(motion[3:6]) + a["reach_m"] * np.linalg.norm(motion[10:13])
    )
    vehicle.aircraft["room_m"] = a["clear_m"] + 3.5 * nearing
    flew, event = vehicle.fly(20)
    assert (flew, event) == (3, ticks.ROOM)
    before = vehicle.copy()
    assert vehicle.fly(20) == (0, ticks.ROOM)
    assert vehicle.bytes() == before.bytes()


@pytest.mark.parametrize("seed", range(8))
def test_contacts_are_possible_within_a_tick_of_motion(seed: int) -> None:
    vehicle = craft(seed)
    a, motion = vehicle.a, vehicle.a["motion"]
    speed, spin = np.linalg.norm(motion[3:6]), np.linalg.norm(motion[10:13])
    far = a["clear_m"] + a["tick_s"] * (a["closing_m_s"] + speed + a["reach_m"] * spin)
    for share, clear in ((1.0 - 1e-9, False), (1.0 + 1e-9, True)):
        vehicle.aircraft["room_m"] = far * share
        assert ticks.is_clear_record(vehicle.aircraft) is clear
    motion[3:6] = motion[10:13] = 0.0
    vehicle.aircraft["closing_m_s"] = 0.0
    vehicle.aircraft["room_m"] = a["clear_m"]
    assert not ticks.is_clear_record(vehicle.aircraft)


def at_rest(seed: int = 0) -> Craft:
    """Return a vehicle that stands on the floor, level, facing west, motors stopped."""
    vehicle = craft(seed, "idle")
    vehicle.aircraft["motion"] = [
        0,
        0,
        -0.055,
        0,
        0,
        0,
        *frames.quat_from_euler(0.02, 0.01, -1.5),
    ] + [0.0] * 6
    vehicle.aircraft["speeds"], vehicle.aircraft["resting"] = 0.0, 1
    vehicle.aircraft["held"], vehicle.controller["flying"] = 1, 0
    vehicle.controller["state"][0, 3:6] = 0.0
    vehicle.controller["state"][0, 10:13] = 0.0
    vehicle.wind = 0.1 * vehicle.wind
    return vehicle


def test_the_floor_holds_a_vehicle_at_rest() -> None:
    vehicle = at_rest()
    before = vehicle.a["motion"].copy()
    vehicle.controller["origin"], vehicle.controller["gps"] = NAN, record.OFF
    vehicle.controller["compass"] = record.OFF
    vehicle.controller["state"][0, :3] = before[:3]
    flew, event = vehicle.fly(10)
    assert (flew, event) == (10, ticks.NONE)
    np.testing.assert_array_equal(vehicle.a["motion"][:13], before[:13])
    force = -GRAVITY_M_S2 * frames.quat_to_matrix(before[6:10]).T[:, 2]
    np.testing.assert_allclose(vehicle.a["motion"][13:], force, rtol=1e-12)
    assert vehicle.a["room_m"] == pytest.approx(60.0 - 10 * 0.7 * TICK_S, rel=1e-12)
    assert vehicle.a["held"] == 1
    assert vehicle.a["acceleration"].tolist() == [0.0, 0.0, 0.0], "standing"
    # A gust lifts the hold within a tick; the next one needs the contact physics.
    vehicle.wind = np.full((1, 3), 60.0)
    assert vehicle.fly(10) == (1, ticks.ROOM)
    assert vehicle.a["held"] == 0
    assert vehicle.fly(10) == (0, ticks.ROOM)
    vehicle.aircraft["resting"] = 0
    vehicle.wind = np.zeros((1, 3))
    assert vehicle.fly(1) == (1, ticks.NONE), "in the air nothing must be held"
    assert vehicle.a["motion"][5] > 0.0


def test_a_climb_that_ends_stops_before_its_tick() -> None:
    vehicle = craft()
    vehicle.controller["climbs"] = record.RISING
    before = vehicle.copy()
    assert vehicle.fly(3) == (0, ticks.CLIMBED)
    before.controller["climbs"] = record.CLIMB_ENDED
    assert vehicle.bytes() == before.bytes()


def test_a_tick_that_python_must_fuse_is_flown_but_not_complete() -> None:
    vehicle = craft()
    vehicle.controller["compass"] = record.SUSPECT
    vehicle.aircraft["mag_rate"] = 125.0, START_US + 3 * TICK_US, 0.0
    assert vehicle.fly(9) == (2, ticks.FUSE)
    assert vehicle.a["time_us"] == vehicle.s["time_us"] == START_US + 3 * TICK_US
    assert vehicle.c["left"] == MAG
    assert vehicle.truths["time_us"][2:4].tolist() == [START_US + 3 * TICK_US, 0]


@pytest.mark.parametrize("healthy", [0, 1])
def test_a_change_of_health_ends_a_stretch(healthy: int) -> None:
    vehicle = craft()
    vehicle.controller["healthy"] = 1 - healthy
    if not healthy:
        vehicle.controller["covariance"][0, 0, 0] = 9.0
        vehicle.controller["gps"] = record.OFF
    assert vehicle.fly(9) == (1, ticks.HEALTH)
    assert vehicle.c["healthy"] == healthy
    assert vehicle.fly(9, 1) == (9, ticks.NONE)
    assert vehicle.flown["healthy"][:2].tolist() == [1 - healthy, healthy]


def test_lift_off_ends_a_stretch() -> None:
    vehicle = craft()
    vehicle.controller["state"][0, 5] = vehicle.aircraft["motion"][0, 5] = -3.0
    vehicle.controller["detecting"] = record.LIFT_OFF
    assert vehicle.fly(9) == (1, ticks.DETECTED)
    assert vehicle.c["detected"] == 1
    vehicle.controller["detecting"] = record.NOTHING
    assert vehicle.fly(9) == (9, ticks.NONE)
    assert vehicle.c["detected"] == 0


def test_an_empty_battery_ends_a_stretch_once_and_stops_the_motors() -> None:
    vehicle = craft()
    whole = vehicle.copy()
    assert whole.fly(3) == (3, ticks.NONE)
    used = 0.8 - whole.a["charge"]
    vehicle.aircraft["charge"] = 0.9 * used
    assert vehicle.fly(20) == (3, ticks.EMPTY)
    assert vehicle.a["charge"] == 0.0
    assert vehicle.c["motors"].min() > 0.0
    before = vehicle.a["speeds"].copy()
    assert vehicle.fly(4, 3) == (4, ticks.NONE)
    left = float(vehicle.a["rotor_lag"]) ** 4
    np.testing.assert_allclose(vehicle.a["speeds"], left * before, rtol=1e-9)


# --- motion and power


def pinned(vehicle: Craft) -> dict[str, list[float]]:
    """Return the fields of an aircraft that its motion and power determine."""
    names = ("motion", "speeds", "acceleration", "charge", "power_w", "battery", "room_m", "held")
    return {name: np.ravel(vehicle.aircraft[name]).tolist() for name in names}


def moved() -> dict[str, dict[str, list[float]]]:
    """Return aircraft after a few ticks: each demand, an attitude of half a turn, and rest."""
    found = {}
    for seed, demand in enumerate(DEMANDS, start=20):
        vehicle = craft(seed, demand)
        assert vehicle.fly(7) == (7, ticks.NONE)
        found[demand] = pinned(vehicle)
    vehicle = craft(1, "rates")
    for name, motors in (("pushed", (0.2, 0.9, 0.4, 0.7)), ("rested", (0.0, 0.1, 0.0, 0.2))):
        vehicle = craft(7)
        (ticks.push_record if name == "pushed" else ticks.rest_record)(
            vehicle.aircraft, motors, vehicle.wind[0]
        )
        found[name] = pinned(vehicle)
    return found


def test_motion_and_power_are_the_recorded_ones() -> None:
    recorded, found = json.loads(RECORDED.read_text()), moved()
    assert list(found) == list(recorded)
    for name, fields in found.items():
        for field, values in fields.items():
            np.testing.assert_allclose(
                values, recorded[name][field], rtol=1e-6, atol=1e-8, err_msg=f"{name} {field}"
            )


@pytest.mark.parametrize("spin", [-2.0, 2.0])
def test_an_attitude_has_a_first_component_of_at_least_zero(spin: float) -> None:
    vehicle = craft(1, "idle")
    vehicle.aircraft["motion"][0, 6:10] = before = np.array([1e-3, 0.6, -0.36, math.sqrt(0.5104)])
    vehicle.aircraft["motion"][0, 10:13] = 0.0, 0.0, spin
    vehicle.controller["gps"] = vehicle.controller["compass"] = record.OFF
    assert vehicle.fly(1)[0] == 1
    c, s = math.cos(0.5 * spin * TICK_S), math.sin(0.5 * spin * TICK_S)
    w, x, y, z = before
    after = np.array([c * w - s * z, c * x + s * y, c * y - s * x, c * z + s * w])
    assert (after[0] < 0.0) == (spin > 0.0)
    np.testing.assert_allclose(vehicle.a["motion"][6:10], after * -np.sign(spin), atol=1e-4)


@pytest.mark.parametrize("rate_hz", [240, 250, 1000])
def test_time_follows_the_tick_count(rate_hz: int) -> None:
    vehicle = craft()
    vehicle.aircraft["rate_hz"], vehicle.aircraft["start_us"] = rate_hz, 5
    vehicle.aircraft["ticks"] = 6
    for tick in range(7, 12):
        ticks.rest_record(vehicle.aircraft, (0.0,) * 4, np.zeros(3))
        assert vehicle.a["ticks"] == tick
        assert vehicle.a["time_us"] == 5 + tick * 1_000_000 // rate_hz


def test_the_floor_holds_within_half_of_friction_and_tipping() -> None:
    """Forces from `push_record`, for winds and commands of all strengths."""
    rng, seen = np.random.default_rng(0), set()
    vehicle = at_rest()
    for _ in range(400):
        yaws = rng.uniform(-0.3, 0.3) * np.array([1.0, 1.0, -1.0, -1.0]) * rng.integers(2)
        speeds = rng.uniform(0, 1) + yaws + rng.uniform(-0.1, 0.1, 4) * rng.integers(2)
        vehicle.aircraft["speeds"] = speeds
        vehicle.aircraft["footing_m"] = footing = 10 ** rng.uniform(-3, -0.5)
        wind = rng.normal(0, 1, 3) * 10 ** rng.uniform(-1, 1.5)
        here, force, torque = ticks.push_record(
            vehicle.aircraft, tuple(np.clip(speeds, 0, 1).tolist()), wind
        )
        weight = vehicle.a["airframe"][0] * GRAVITY_M_S2
        pressing = weight + force[2]
        grip = 0.5 * 0.8 * pressing
        holds = (
            pressing > 0.1 * weight,
            math.hypot(*force[:2]) <= grip,
            math.hypot(*torque[:2]) <= 0.5 * pressing * footing,
            abs(torque[2]) <= grip * footing,
        )
        assert vehicle.a["held"] == all(holds)
        assert here == tuple(vehicle.a["motion"][:3].tolist())
        seen.add(tuple(map(bool, holds)))
    assert seen >= {
        (True,) * 4,
        (True, False, True, True),
        (True, True, False, True),
        (True, True, True, False),
    }


@pytest.mark.parametrize("share", [0.5, 0.89, 0.91])
def test_the_floor_holds_a_vehicle_that_presses_with_a_tenth_of_its_weight(share: float) -> None:
    """Level, without wind and turn rate: no force moves it to a side."""
    vehicle = at_rest()
    vehicle.aircraft["motion"][0, 6:10] = 1.0, 0.0, 0.0, 0.0
    low, high, weight = 0.0, 1.0, vehicle.a["airframe"][0] * GRAVITY_M_S2
    for _ in range(60):
        speed = 0.5 * (low + high)
        vehicle.aircraft["speeds"] = speed
        _, force, _ = ticks.push_record(vehicle.aircraft, (speed,) * 4, np.zeros(3))
        low, high = (speed, high) if -force[2] < share * weight else (low, speed)
    assert -force[2] == pytest.approx(share * weight, rel=1e-9)
    assert vehicle.a["held"] == (share < 0.9)


def test_a_tick_with_contacts_begins_and_ends_like_a_compiled_one() -> None:
    """Begin with the pushes of the motor commands; end with the motion of a compiled tick."""
    vehicle = craft(5)
    whole, pushed = vehicle.copy(), vehicle.copy()
    assert whole.fly(1) == (1, ticks.NONE)
    here = ticks.begin_touch(
        vehicle.controller, vehicle.aircraft, vehicle.flown[:1], vehicle.wind[0]
    )
    motors = tuple(whole.c["motors"].tolist())
    assert here == ticks.push_record(pushed.aircraft, motors, vehicle.wind[0])
    event = ticks.end_touch(
        *(vehicle.aircraft, vehicle.sample, vehicle.controller, whole.a["motion"].copy()),
        *(vehicle.wind[0], False, *vehicle.noise, vehicle.truths[:1]),
    )
    assert event == ticks.NONE
    assert vehicle.a["room_m"] == 60.0
    vehicle.aircraft["room_m"] = whole.aircraft["room_m"]
    vehicle.aircraft["noise_at"] = whole.aircraft["noise_at"]
    assert vehicle.bytes() == whole.bytes()


@pytest.mark.parametrize("standing", [False, True])
def test_the_plant_ends_a_tick_of_any_motion(standing: bool) -> None:
    vehicle = craft(5)
    whole, other = vehicle.copy(), vehicle.copy()
    assert whole.fly(1) == (1, ticks.NONE)
    motors = tuple(whole.c["motors"].tolist())
    ticks.push_record(other.aircraft, motors, vehicle.wind[0])
    ticks.finish_record(other.aircraft, whole.a["motion"].copy(), vehicle.wind[0], standing)
    expected = pinned(whole) | {"room_m": [60.0]}
    if standing:
        assert other.a["acceleration"].tolist() == [0.0] * 3
        assert other.a["power_w"] != whole.a["power_w"]
        expected = {name: expected[name] for name in ("motion", "speeds", "room_m", "held")}
    assert expected.items() <= pinned(other).items()


def ended(vehicle: Craft, *, standing: bool = False) -> int:
    return ticks.end_touch(
        *(vehicle.aircraft, vehicle.sample, vehicle.controller, vehicle.a["motion"].copy()),
        *(vehicle.wind[0], standing, *vehicle.noise, vehicle.truths[:1]),
    )


def test_the_end_of_a_tick_names_its_event() -> None:
    vehicle = craft()
    vehicle.controller["healthy"] = 0
    assert ended(vehicle.copy()) == ticks.HEALTH
    vehicle.controller["compass"] = record.SUSPECT
    left = vehicle.copy()
    assert ended(left) == ticks.FUSE
    assert left.c["left"] == MAG
    assert left.c["healthy"] == 0, "settled by Python"
    vehicle.controller["aligned"] = 0
    vehicle.controller["rest_count"][0, 3] = 5
    assert ended(vehicle.copy()) == ticks.NONE
    vehicle.controller["rest_count"][0, 3] = 0
    assert ended(vehicle.copy()) == ticks.ALIGN


# --- logs


def test_logs_are_the_records() -> None:
    vehicle = craft(6, "rates")
    assert vehicle.fly(3) == (3, ticks.NONE)
    vehicle.flown[0], vehicle.truths[0] = np.zeros_like(vehicle.flown[1]), vehicle.truths[9]
    ticks.log_flown_record(vehicle.controller, vehicle.flown[:1])
    ticks.log_record(vehicle.aircraft, vehicle.truths[:1])
    assert record.DEMAND_SIZE == record.OUTPUT_SIZE == len(vehicle.c["output"])
    for log, source in (
        (vehicle.flown[0], vehicle.c),
        (vehicle.truths[0], vehicle.a),
    ):
        for name in log.dtype.names or ():
            if name != "battery":
                np.testing.assert_array_equal(log[name], source[name], err_msg=name)
    battery = vehicle.a["battery"].copy()
    vehicle.fly(1)
    assert vehicle.flown["battery"][0].tolist() == battery.tolist()


# --- control


CASCADE: dict[str, tuple[Any, str]] = {
    "position": (cascade.cascade_tick, "pvqw"),
    "velocity": (cascade.cascade_tick, "pvqw"),
    "trajectory": (cascade.trajectory_tick, "pvqw"),
    "attitude": (cascade.attitude_tick, "vqw"),
    "rates": (cascade.rate_tick, "vqw"),
}
"""Ticks of the cascade by demand, with their arguments: position, velocity, attitude, rates."""


@pytest.mark.parametrize("demand", CASCADE)
def test_control_is_a_tick_of_the_cascade(demand: str) -> None:
    wanted = DEMANDS[demand]
    vehicle = craft(8, demand)
    memory, weights = vehicle.c["memory"].copy(), cascade.filters(GAINS, TICK_S)
    rng, state = np.random.default_rng(1), vehicle.controller["state"][0]
    for _ in range(4):
        state[:13] += rng.normal(0, 0.01, 13)
        ticks.control_record(vehicle.controller)
        p, v, q, w = (tuple(part.tolist()) for part in np.split(state[:13], (3, 6, 10)))
        tick, arguments = CASCADE[demand]
        known = {"p": p, "v": v, "q": q, "w": w}
        out = tick(*(known[each] for each in arguments), wanted, memory, GAINS, weights, TICK_S)
        output = [*out.attitude, *out.rates, *out.velocity, out.thrust]
        np.testing.assert_allclose(vehicle.c["output"], output, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(vehicle.c["motors"], out.motors, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(vehicle.c["memory"], memory, rtol=1e-9, atol=1e-12)


def test_stopped_motors_leave_the_loops_at_rest() -> None:
    vehicle = craft(8, "idle")
    vehicle.controller["motors"] = 0.5
    before = vehicle.controller.copy()
    ticks.control_record(vehicle.controller)
    assert vehicle.c["motors"].tolist() == [0.0] * 4
    same(vehicle.controller, before, "motors", rtol=0.0, atol=0.0)


SINKING, LIFTING = 0.4, -0.4


def detect(**fields: Any) -> tuple[bool, int]:
    """Return the result of a detection at 2 s, and the start of the time at rest."""
    controller = craft().controller
    down_m_s, thrust = fields.pop("down", 0.0), fields.pop("thrust", 0.0)
    controller["state"][0, 3:6] = 0.0, 0.0, down_m_s
    controller["output"][0, 10] = thrust
    controller["output"][0, 9] = fields.pop("setpoint", SINKING)
    controller["land"][0] = 1_000_000.0, 0.2, 0.3, 1.5, 0.5, 0.75, 1.0
    controller["still_since_us"] = fields.pop("since", 900_000)
    controller["time_us"], controller["detecting"] = 2_000_000, fields.pop("kind")
    return bool(ticks.detect_record(controller)), int(controller["still_since_us"][0])


def test_landing_is_rest_for_a_time_while_the_setpoint_descends() -> None:
    landing = record.LANDING
    assert detect(kind=landing) == (True, 900_000)
    assert detect(kind=landing, since=1_000_000) == (True, 1_000_000)
    assert detect(kind=landing, since=1_000_001) == (False, 1_000_001)
    assert detect(kind=landing, since=0) == (True, 0)
    assert detect(kind=landing, since=-1) == (False, 2_000_000)
    assert detect(kind=landing, setpoint=0.0) == (False, -1)
    assert detect(kind=landing, setpoint=-0.1) == (False, -1)
    assert detect(kind=landing, down=0.4) == (False, -1)
    assert detect(kind=landing, thrust=0.3) == (False, -1)
    assert detect(kind=record.NOTHING) == (False, 900_000)
    assert detect(kind=record.NOTHING, down=-1.0) == (False, 900_000)


def test_lift_off_is_a_fast_climb_or_a_climb_at_thrust() -> None:
    kind = record.LIFT_OFF
    assert detect(kind=kind, down=-1.0) == (True, -1)
    assert detect(kind=kind, down=-0.3, thrust=0.6) == (True, -1)
    assert detect(kind=kind, down=-0.3, thrust=0.4) == (False, -1)
    assert detect(kind=kind) == (False, -1)


# --- sensors


def noise_free(vehicle: Craft, **sigmas: float) -> None:
    for name in ("imu_sigma", "mag_sigma", "baro_noise_pa", "baro_step_pa", "gps_drive"):
        vehicle.aircraft[name] = sigmas.get(name, 0.0)
    for name in ("gps_noise_m", "gps_noise_m_s"):
        vehicle.aircraft[name] = sigmas.get(name, 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_samples_are_the_motion_with_bias_drift_and_noise(seed: int) -> None:
    vehicle = craft(seed)
    vehicle.aircraft["imu_sigma"] = np.linspace(0.1, 0.4, 12)
    a, s = vehicle.a, vehicle.s
    field, turn = frames.MAGNETIC_FIELD_NED, frames.quat_to_matrix(a["motion"][6:10])
    biases = np.concatenate([a["accel_bias"], a["gyro_bias"]])
    drift, error = float(a["baro_drift_pa"]), a["gps_error"].copy()
    used = [0, 0, 0]
    for tick in range(1, 9):
        vehicle.aircraft["time_us"] = time_us = START_US + tick * TICK_US
        ticks.sense_record(vehicle.aircraft, vehicle.sample, *vehicle.noise)
        inertial = vehicle.noise[0][tick - 1] * a["imu_sigma"]
        biases += inertial[6:]
        measured = np.concatenate([a["motion"][13:16], a["motion"][10:13]])
        np.testing.assert_allclose(
            [*s["accel"], *s["gyro"]], measured + biases + inertial[:6], rtol=1e-12
        )
        due = int(s["measured"])
        height = frames.HOME.altitude_m - a["motion"][2]
        assert s["time_us"] == time_us
        assert s["battery_left"] == a["battery"][3]
        assert s["temperature_c"] == pytest.approx(atmosphere.temperature_c(height))
        if due & MAG:
            white = vehicle.noise[1][used[0]]
            np.testing.assert_allclose(s["mag"], turn.T @ field + a["mag_sigma"] * white)
        if due & PRESSURE:
            white = vehicle.noise[2][used[1]]
            drift += a["baro_step_pa"] * white[0]
            off_hpa = (drift + a["baro_noise_pa"] * white[1]) / 100.0
            assert s["pressure_hpa"] == pytest.approx(
                atmosphere.pressure_hpa(height) + off_hpa, rel=1e-12
            )
        if due & GPS:
            white = vehicle.noise[3][used[2]]
            error = a["gps_keep"] * error + a["gps_drive"] * white[:3]
            place = a["motion"][:3] + error + a["gps_noise_m"] * white[3:6]
            np.testing.assert_allclose(s["gps_position"], place, rtol=1e-12)
            speed = a["motion"][3:6] + a["gps_noise_m_s"] * white[6:]
            np.testing.assert_allclose(s["gps_velocity"], speed, rtol=1e-12)
        used = [n + bool(due & bit) for n, bit in zip(used, (MAG, PRESSURE, GPS), strict=True)]
        assert a["noise_at"].tolist() == [tick, *used, 0]
        np.testing.assert_allclose(a["gps_error"], error, rtol=1e-12)
        np.testing.assert_allclose([*a["accel_bias"], *a["gyro_bias"]], biases, rtol=1e-12)
        assert a["baro_drift_pa"] == pytest.approx(drift, rel=1e-12)
    assert used == [5, 3, 2], "rates of 125, 83 and 50 Hz"


def test_a_vehicle_without_a_receiver_has_no_fixes() -> None:
    vehicle = craft()
    vehicle.aircraft["gps_fitted"] = 0
    ticks.sense_record(vehicle.aircraft, vehicle.sample, *vehicle.noise)
    assert vehicle.s["measured"] == MAG | PRESSURE
    assert vehicle.a["noise_at"].tolist() == [1, 1, 1, 0, 0]


@pytest.mark.parametrize("rate_hz", [3.0, 30.0, 49.7, 83.0, 125.0, 250.0])
def test_a_sample_is_due_at_the_first_tick_of_each_period(rate_hz: float) -> None:
    schedule, last = np.array([rate_hz, 0.0, 0.0]), -1
    for time_us in range(0, 1_500_000, TICK_US):
        period = math.floor(Fraction(rate_hz) * time_us / US_PER_S)
        assert ticks.is_due(schedule, time_us) == (period > last)
        last = period
        assert schedule[2] == period
        assert schedule[1] == pytest.approx((period + 1) * US_PER_S / rate_hz, rel=1e-12)


@pytest.mark.parametrize(
    ("rate_hz", "time_us", "period"),
    [(0.7, 90_000_000, 63), (2.8, 22_500_000, 63), (20.4, 12_500_000, 255)],
)
def test_a_period_begins_in_spite_of_rounding(rate_hz: float, time_us: int, period: int) -> None:
    """The product of time and rate rounds to just below a whole number."""
    assert time_us * rate_hz / US_PER_S < period
    schedule = np.array([rate_hz, 0.0, 0.0])
    assert ticks.is_due(schedule, time_us)
    assert schedule[2] == period
    assert not ticks.is_due(schedule, time_us)


# --- estimator

COMPILED = (
    *("watch", "innovation", "innovation2", "innovation4"),
    *("variance", "variance2", "variance4"),
)
"""Fields of compiled ticks alone; Python monitors and computes them elsewhere."""


def measure(seed: int, measured: int = MAG | PRESSURE | GPS) -> Craft:
    """Return a vehicle with a new sample that its estimator has not read."""
    vehicle = craft(seed)
    vehicle.controller["pressure_hpa"] = 940.0
    vehicle.aircraft["time_us"] = START_US + TICK_US
    ticks.sense_record(vehicle.aircraft, vehicle.sample, *vehicle.noise)
    vehicle.sample["measured"] = measured
    return vehicle


def sample_of(vehicle: Craft) -> SensorSample:
    s, measured = vehicle.s, int(vehicle.s["measured"])
    fix = GpsFix(
        frames.local_to_geodetic(s["gps_position"], frames.HOME),
        s["gps_velocity"].copy(),
        0.1,
        float(s["gps_epv_m"]),
        12,
    )
    return SensorSample(
        int(s["time_us"]),
        s["accel"].copy(),
        s["gyro"].copy(),
        float(s["temperature_c"]),
        BatterySample(12.0, 5.0, 0.0, float(s["battery_left"])),
        s["mag"].copy() if measured & MAG else None,
        float(s["pressure_hpa"]) if measured & PRESSURE else None,
        fix if measured & GPS else None,
    )


@pytest.mark.parametrize("flying", [0, 1])
@pytest.mark.parametrize("measured", range(8))
def test_compiled_fusion_is_that_of_python(measured: int, flying: int) -> None:
    for seed in (10 + measured, 30 + measured):
        vehicle = measure(seed, measured)
        vehicle.controller["flying"] = flying
        python = estimator_of(vehicle.controller)
        python.step(sample_of(vehicle))
        assert ticks.estimate(vehicle.c, vehicle.s) == 0
        ticks.settle_record(vehicle.controller)
        same(vehicle.controller, python.record, *COMPILED, rtol=1e-7, atol=1e-9)


NOW_US = START_US + TICK_US
FUSED = ("gps_horizontal_us", "gps_vertical_us", "baro_fused_us", "heading_fused_us")


def left_of(vehicle: Craft) -> tuple[int, list[bool]]:
    """Return the measurements that a tick leaves to Python, and whether each was fused."""
    left = int(ticks.estimate(vehicle.c, vehicle.s))
    return left, [bool(vehicle.c[name] == vehicle.s["time_us"]) for name in FUSED]


EVERY, ALL, NO = MAG | PRESSURE | GPS, [True] * 4, [False] * 4


@pytest.mark.parametrize(
    ("fields", "left", "fused"),
    [
        ({}, 0, ALL),
        ({"compass": record.SUSPECT}, MAG, [True, True, True, False]),
        ({"compass": record.OFF}, 0, [True, True, True, False]),
        ({"gps": record.OFF}, 0, [False, False, True, True]),
        ({"gps": record.SUSPECT}, EVERY, NO),
        ({"origin": NAN}, EVERY, NO),
        ({"gps_horizontal_us": -1}, EVERY, NO),
        ({"gps_horizontal_us": NOW_US - REFUSED_US}, EVERY, NO),
        ({"gps_horizontal_us": NOW_US - REFUSED_US + 1}, 0, ALL),
    ],
    ids=str,
)
def test_which_sensors_python_must_check(
    fields: dict[str, Any], left: int, fused: list[bool]
) -> None:
    vehicle = measure(11)
    for name, value in fields.items():
        vehicle.controller[name] = value
    assert left_of(vehicle) == (left, fused)


def test_a_fix_at_time_zero_counts() -> None:
    for since, left in ((0, 0), (-1, EVERY)):
        vehicle = measure(11)
        vehicle.sample["time_us"], vehicle.controller["gps_horizontal_us"] = TICK_US, since
        assert left_of(vehicle)[0] == left


def predicted(vehicle: Craft) -> Craft:
    """Return a copy after the prediction of the tick, without measurements."""
    copy = vehicle.copy()
    copy.sample["measured"] = 0
    assert ticks.estimate(copy.c, copy.s) == 0
    return copy


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_python_checks_velocities_beyond_three_deviations(axis: int, sign: float) -> None:
    vehicle = measure(12)
    after = predicted(vehicle).c
    sigma = math.sqrt(after["covariance"][3 + axis, 3 + axis] + after["gps_variance"][1])
    for share, left in ((1.0 - 1e-6, 0), (1.0 + 1e-6, EVERY), (NAN, EVERY)):
        copy = vehicle.copy()
        off = sign * share * FAR * sigma
        copy.sample["gps_velocity"][0, axis] = after["state"][3 + axis] + off
        assert left_of(copy)[0] == left
        assert copy.c["fixes"] == (left == 0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_python_checks_headings_beyond_sixty_percent_of_the_gate(sign: float) -> None:
    vehicle = measure(12, MAG)
    after = predicted(vehicle).c
    q, h, off = after["state"][6:10].copy(), np.zeros((1, 16)), np.zeros(1)
    turn = frames.quat_to_matrix(q)
    field = turn.T @ frames.MAGNETIC_FIELD_NED
    assert es.observe_heading(
        *(after["state"], field, frames.MAGNETIC_DECLINATION, ticks.HEADING_BY_TURN_NED, off, h)
    )
    total = float((h @ after["covariance"] @ h.T)[0, 0] + after["heading_variance"])
    for share, left in ((1.0 - 1e-6, 0), (1.0 + 1e-6, MAG), (NAN, MAG)):
        copy, angle = vehicle.copy(), sign * share * 0.6 * es.GATE * math.sqrt(total) - off[0]
        c, s = math.cos(angle), math.sin(angle)
        about = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        copy.sample["mag"] = turn.T @ about @ frames.MAGNETIC_FIELD_NED
        assert left_of(copy) == (left, [False, False, False, left == 0])


def test_at_steep_pitch_there_is_no_heading() -> None:
    vehicle = measure(12, MAG | PRESSURE)
    vehicle.controller["state"][0, 6:10] = frames.quat_from_euler(0.0, 1.5, 0.0)
    assert left_of(vehicle) == (0, [False, False, True, False])


@pytest.mark.parametrize(
    ("field", "off", "slot", "fused"),
    [
        ("gps_position", (900.0, 0.0, 0.0), 0, [False, True, True, True]),
        ("gps_position", (0.0, 900.0, 0.0), 0, [False, True, True, True]),
        ("gps_position", (0.0, 0.0, 900.0), 3, [True, False, True, True]),
        ("pressure_hpa", -90.0, 1, [True, True, False, True]),
    ],
)
def test_measurements_beyond_the_gate_are_not_fused(
    field: str, off: Any, slot: int, fused: list[bool]
) -> None:
    vehicle = measure(13)
    vehicle.sample[field] += off
    python = estimator_of(vehicle.controller)
    python.step(sample_of(vehicle))
    before = vehicle.controller.copy()
    assert left_of(vehicle) == (0, fused)
    for name, is_fused in zip(FUSED, fused, strict=True):
        assert is_fused or vehicle.c[name] == before[name][0]
    assert [bool(ratio > 1.0) for ratio in vehicle.c["state"][es.RATIO :]] == [
        each == slot for each in range(4)
    ]
    ticks.settle_record(vehicle.controller)
    same(vehicle.controller, python.record, *COMPILED, rtol=1e-7, atol=1e-9)


REPEATS = {
    MAG: {"mag"},
    PRESSURE: {"pressure_hpa"},
    GPS: {"gps_position", "gps_velocity"},
}


@pytest.mark.parametrize("repeated", range(8))
@pytest.mark.parametrize("measured", range(8))
def test_repeated_samples_are_left_to_python(measured: int, repeated: int) -> None:
    vehicle = measure(14, measured)
    watch = vehicle.controller["watch"][0]
    watch[:] = np.arange(15).reshape(5, 3)
    watch[record.BARO_ROW, record.FIRST] = -1
    for bit, names in REPEATS.items():
        for name in names if repeated & bit else ():
            vehicle.controller[name] = vehicle.sample[name]
    before, expected = vehicle.copy(), watch.copy()
    again = measured & repeated
    for bit, row in ((MAG, 2), (PRESSURE, 3), (GPS, 4)):
        if measured & bit and not again & bit:
            expected[row] = NOW_US, NOW_US, NOW_US if bit == PRESSURE else 3 * row + 2
    left = ticks.estimate(vehicle.c, vehicle.s)
    assert left == (measured | again << 3 if again else 0)
    np.testing.assert_array_equal(watch, expected)
    for bit, names in REPEATS.items():
        source = vehicle if measured & bit else before
        for name in names:
            new = source.sample[name] if measured & bit else source.controller[name]
            np.testing.assert_array_equal(vehicle.controller[name], new)
    if again:
        plain = predicted(before)
        np.testing.assert_array_equal(vehicle.c["state"], plain.c["state"])
        assert [vehicle.c[name] for name in FUSED] == [before.c[name] for name in FUSED]


@pytest.mark.parametrize("name", ["mag", "gps_position", "gps_velocity"])
@pytest.mark.parametrize("axis", range(3))
def test_a_change_of_one_axis_is_no_repetition(name: str, axis: int) -> None:
    vehicle = measure(14)
    bit = MAG if name == "mag" else GPS
    for each in REPEATS[bit]:
        vehicle.controller[each] = vehicle.sample[each]
    vehicle.controller[name][0, axis] += 1.0
    assert ticks.estimate(vehicle.c, vehicle.s) == 0
    for each in REPEATS[bit]:
        np.testing.assert_array_equal(vehicle.controller[each], vehicle.sample[each])


# --- alignment


def standing(rest_since_us: int = -1, fixes: int = 0) -> Craft:
    vehicle = at_rest()
    vehicle.controller["aligned"], vehicle.controller["healthy"] = 0, 0
    vehicle.controller["rest_since_us"] = rest_since_us
    vehicle.controller["rest_count"] = 0, 0, 0, fixes
    return vehicle


def test_the_first_fix_can_be_the_origin() -> None:
    vehicle = standing()
    vehicle.aircraft["gps_rate"] = 50.0, START_US + 2 * TICK_US, 0.0
    assert vehicle.fly(9) == (2, ticks.ALIGN)
    assert vehicle.c["rest_since_us"] == START_US + TICK_US
    assert vehicle.c["rest_count"].tolist() == [2, 2, 1, 1]
    assert vehicle.fly(3, 2) == (3, ticks.NONE), "only once, also while no fix is new"
    assert vehicle.c["rest_count"][0] == 5
    np.testing.assert_array_equal(vehicle.c["accel"], vehicle.s["accel"])
    assert vehicle.c["covariance"].tobytes() == standing().c["covariance"].tobytes()


def test_alignment_takes_half_a_second() -> None:
    vehicle = standing(START_US + 4 * TICK_US - ALIGN_US, 3)
    assert vehicle.fly(9) == (4, ticks.ALIGN)
    assert vehicle.fly(9, 4) == (1, ticks.ALIGN), "again, until it is aligned"


def record_again() -> None:
    data = {
        case: {name: [float(f"{x:.9g}") for x in values] for name, values in fields.items()}
        for case, fields in moved().items()
    }
    RECORDED.write_text(json.dumps(data))


if __name__ == "__main__":
    record_again()

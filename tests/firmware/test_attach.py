"""A vehicle that flies elsewhere, as telemetry over UDP: clock, poses, arena, contacts."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import Any, cast

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.core.constants import TICK_US
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.frames import quat_from_euler, quat_yaw
from airl_mav.flight.judge import Outcome, Referee, Task, TruthSample
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.episode import EpisodeSupervisor, Order
from airl_mav.scenario.aircraft import Aircraft, RealFirmware
from airl_mav.scenario.checks import check_firmware
from firmware_sim.addons.attach.vehicle import (
    BEHIND_US,
    SOURCES,
    AttachedBody,
    VehicleClock,
    VehicleTelemetry,
    attach_parts,
)
from firmware_sim.external.flight_stack import FirmwareRequest, real_firmware
from firmware_sim.external.hil_messages import STILL
from firmware_sim.interfaces import ActuatorControls, FirmwareLostError, FirmwareMissingError
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.mavlink.px4_links import UdpLinks
from firmware_sim.plant.plant import Plant
from tests.support.ports import free_ports

QUAD = load_vehicle("quad")
HALF_M = 0.5 * QUAD.body.height_m
BOOTED_US = 7_000_000
"""Time of the vehicle's clock at our time 0 [µs]."""
LAT, LON, ALT = 47.397743, 8.545594, 489.4
METRE = 1.0 / 111_194.93
"""A metre to the north [deg] on PX4's sphere."""


class Vehicle:
    """A scripted vehicle on a link: stands, then flies north at 4 m/s, with heading `yaw`."""

    def __init__(self, port: int, yaw: float = 0.0, *, truth: bool = True) -> None:
        self.to = "127.0.0.1", port
        self.yaw, self.truth, self.armed, self.pace = yaw, truth, False, 1.0
        self.moving_us: int | None = None
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.mav = common.MAVLink(None, 1, 1)

    def close(self) -> None:
        self.socket.close()

    def send(self, *messages: Any) -> None:
        for message in messages:
            self.socket.sendto(message.pack(self.mav), self.to)

    def north_m(self, time_us: int) -> float:
        return 0.0 if self.moving_us is None else 4.0 * max(0, time_us - self.moving_us) / 1e6

    def tell(self, now_us: int) -> None:
        """Send the telemetry of a moment, by our clock."""
        time_us = BOOTED_US + round(self.pace * now_us)
        speed, x = (0.0 if self.moving_us is None else 4.0), 10.0 + self.north_m(now_us)
        mode = 0x80 if self.armed else 0
        q = quat_from_euler(0.0, 0.0, self.yaw).tolist()
        self.send(
            common.MAVLink_heartbeat_message(2, 12, 1 | mode, 4 << 16 | 3 << 24, 3, 3),
            common.MAVLink_sys_status_message(0, 0, 1 << 28, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
            common.MAVLink_local_position_ned_message(time_us // 1000, x, 20.0, -1.0, speed, 0, 0),
            common.MAVLink_attitude_quaternion_message(time_us // 1000, *q, 0, 0, 0),
        )
        if self.truth:
            lat = LAT + (self.north_m(now_us) + 100.0) * METRE
            place = round(lat * 1e7), round(LON * 1e7), round(ALT * 1e3)
            self.send(
                # PX4 sends no time.
                common.MAVLink_hil_state_quaternion_message(
                    0, q, 0, 0, 0, *place, round(100 * speed), 0, 0, 0, 0, 0, 0, 0
                )
            )


@contextmanager
def linked(**options: Any) -> Iterator[tuple[VehicleTelemetry, Vehicle]]:
    (port,), _ = free_ports(1, 0)
    endpoint = UdpEndpoint(("127.0.0.1", port), None, "", "")
    told = VehicleTelemetry(endpoint, "observer")
    with closing(told), closing(Vehicle(port, **options)) as vehicle:
        yield told, vehicle


def exchange(
    told: VehicleTelemetry, vehicle: Vehicle, first_ms: int, last_ms: int, late_ms: int = 0
) -> None:
    """Let the vehicle send its state every 10 ms; each arrives `late_ms` later."""
    for now_us in range(first_ms * 1000, last_ms * 1000, 10_000):
        vehicle.tell(now_us)
        told.receive(now_us + late_ms * 1000)
        told.send(now_us + late_ms * 1000)


@pytest.mark.parametrize("pace", [1.0, 0.97])
def test_a_late_message_moves_no_clock(pace: float) -> None:
    clock, errors = VehicleClock(), []
    random = np.random.default_rng(1)
    for now_us in range(0, 10_000_000, 10_000):
        stalls = 5_000_000 < now_us < 5_100_000
        came_us = 5_100_000 if stalls else now_us + int(random.exponential(2000.0))
        clock.hear(BOOTED_US + round(pace * now_us), came_us)
        if now_us > 100_000:
            errors.append(clock.at(now_us) - BOOTED_US - pace * now_us)
    assert np.percentile(np.abs(errors), 50) < 5_000
    assert np.abs(errors).max() < 25_000
    assert clock.pace == pytest.approx(pace, abs=0.005)


@pytest.mark.parametrize("truth", [True, False])
def test_poses_are_those_of_the_exposure(truth: bool) -> None:
    """4 m/s: an error of 20 ms would be 8 cm."""
    with linked(yaw=0.5, truth=truth) as (told, vehicle):
        exchange(told, vehicle, 0, 3000)
        assert told.lacking is None
        told.place(HALF_M)
        source = "HIL_STATE_QUATERNION" if truth else "ATTITUDE_QUATERNION"
        assert told.source == source
        assert ("true state" in SOURCES[source]) is truth
        vehicle.moving_us = 3_000_000
        errors = []
        for now_ms in range(3000, 5000, 10):
            exchange(told, vehicle, now_ms, now_ms + 10, late_ms=2)
            told.tick_us = now_ms * 1000 + 3 * TICK_US
            moved = told.motion()
            north = vehicle.north_m(told.tick_us - BEHIND_US)
            # The arena's north is the heading at the start.
            expected = north * np.array([math.cos(0.5), -math.sin(0.5), 0.0])
            errors.append(np.linalg.norm(moved[:3] - expected - [0.0, 0.0, -HALF_M]))
            assert quat_yaw(moved[6:10]) == pytest.approx(0.0, abs=1e-3)
        assert max(errors[20:]) < 4.0 * 0.02
        assert np.median(errors) < 4.0 * 0.006


def test_a_goal_is_ahead_of_the_vehicle() -> None:
    with linked(yaw=math.pi / 2) as (told, vehicle):
        exchange(told, vehicle, 0, 3000)
        told.place(HALF_M)
        assert told.local((5.0, 0.0)) == pytest.approx((10.0, 25.0), abs=1e-3)
        assert told.local((5.0, 1.0, -2.0)) == pytest.approx((9.0, 25.0, -3.0), abs=1e-3)


def test_what_is_missing_is_told() -> None:
    with linked() as (told, vehicle):
        assert told.lacking == "no heartbeat of a flight controller"
        vehicle.armed = True
        exchange(told, vehicle, 0, 3000)
        assert told.lacking == "it is armed (accepted: landed and disarmed)"
        vehicle.armed, vehicle.pace = False, 2.0
        told.restart()
        exchange(told, vehicle, 3000, 6000)
        assert told.lacking == "its clock runs at 2 x real time (accepted: 1)"


def request(port: int, timeout_s: float) -> FirmwareRequest:
    real = RealFirmware(connect=f"udpin://127.0.0.1:{port}", firmware_timeout=timeout_s)

    def no_ends() -> UdpLinks:
        raise AssertionError

    return FirmwareRequest(Aircraft(firmware="attach", real=real), QUAD, None, no_ends)


def test_a_silent_vehicle_ends_the_wait() -> None:
    (port,), _ = free_ports(1, 0)
    stack = real_firmware(request(port, 1.0))
    silent = pytest.raises(FirmwareMissingError, match="not ready in 1 s: no heartbeat")
    with closing(stack), silent:
        stack.boot(cast(Any, None))


def test_a_vehicle_that_falls_silent_is_lost() -> None:
    (port,), _ = free_ports(1, 0)
    launcher, watching = attach_parts(request(port, 10.0))
    ended = threading.Event()
    with closing(watching), closing(Vehicle(port)) as vehicle:

        def fly() -> None:
            while not ended.is_set():
                vehicle.tell(time.monotonic_ns() // 1000)
                time.sleep(0.01)

        flying = threading.Thread(target=fly)
        flying.start()
        try:
            bridge = launcher.launch()
        finally:
            ended.set()
            flying.join()
        plant = Plant(QUAD, None, np.random.default_rng(0), body_by=launcher.body_by)
        sample = plant.sense()
        for _ in range(250):
            sample = plant.step(bridge.step(sample))
        assert plant.position == pytest.approx((0.0, 0.0, -HALF_M), abs=0.02)
        with pytest.raises(FirmwareLostError, match="no HIL_STATE_QUATERNION for 1 s"):
            bridge.step(sample)
        launcher.stop()


class Path:
    """Telemetry of a straight flight north through an obstacle, 0.02 m a tick."""

    def __init__(self) -> None:
        self.ticks = 0

    def motion(self) -> Any:
        self.ticks += 1
        return np.array([0.02 * self.ticks, 0, -2.0, 5.0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0])


def test_a_contact_is_seen_and_moves_nothing() -> None:
    box = Obstacles(
        np.array([Shape.BOX], np.int8),
        np.array([[6.0, 0.0, -2.0]]),
        np.array([[1.0, 1.0, 2.0]]),
        np.zeros(1),
    )
    bounds = Bounds(-20.0, 20.0, -20.0, 20.0, 6.0)
    arena = Arena("box", 0, bounds, (0, 0, 0), box, (), np.array([15.0, 0.0]))
    plant = Plant(
        QUAD, arena, np.random.default_rng(0), body_by=partial(AttachedBody, cast(Any, Path()))
    )
    hit_m = None
    for _ in range(400):
        plant.step(ActuatorControls(0, STILL, armed=True))
        if plant.collisions and hit_m is None:
            hit_m = plant.position[0]
    assert plant.position[0] == pytest.approx(8.0)
    assert hit_m == pytest.approx(5.0 - 0.5 * QUAD.body.width_m, abs=0.05)
    assert [hit.what for hit in plant.collisions] == [arena.name_of(0)]


def test_a_collision_lands_a_vehicle_elsewhere() -> None:
    hit = TruthSample(1_000_000, (1.0, 0.0, -2.0), "box", 1.0)
    task = Task((20.0, 0.0), 3.0, 60.0)
    elsewhere = EpisodeSupervisor(Referee(task), 0, lands=True)
    here = EpisodeSupervisor(Referee(task), 0)
    assert (elsewhere.see(hit), here.see(hit)) == (Order.LAND, Order.ABANDON)
    assert elsewhere.verdict is not None
    assert elsewhere.verdict.outcome is Outcome.COLLISION


@pytest.mark.parametrize(
    ("asked", "level", "speed", "words"),
    [
        ({}, "lockstep", None, "firmware 'attach': accepted: at level sitl"),
        ({}, "sitl", 2.0, "speed 2: accepted: 1 with firmware attach"),
        ({"wind": {"north_m_s": 3.0}}, "sitl", None, "wind.north_m_s"),
        ({"faults": ["gps off at 8s"]}, "sitl", None, "accepted: its default with firmware attach"),
        ({"battery_charge": 0.5}, "sitl", None, "battery_charge"),
        ({"real": {}}, "sitl", None, "firmware 'attach': accepted: with connect"),
    ],
    ids=str,
)
def test_what_needs_our_plant_is_told(
    asked: dict[str, Any], level: Any, speed: float | None, words: str
) -> None:
    link = {"real": {"connect": "udpin://127.0.0.1:14550"}}
    aircraft = Aircraft.model_validate({"firmware": "attach", **link, **asked})
    with pytest.raises(FieldError) as raised:
        check_firmware(aircraft, level, speed)
    assert words in str(raised.value)


@pytest.mark.parametrize("url", ["14550", "tcpout://127.0.0.1:5760", "udpin://:14550"])
def test_a_wrong_link_is_told(url: str) -> None:
    real = RealFirmware(connect=url)
    asked = FirmwareRequest(Aircraft(firmware="attach", real=real), QUAD, None, cast(Any, None))
    with pytest.raises(FieldError, match="accepted: udpin://HOST:PORT"):
        attach_parts(asked)


def test_the_link_listens_at_the_given_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """Like the companion's --connect, it needs no --insecure."""
    bound: list[Any] = []

    def bind(address: Any, *_rest: Any, insecure: bool) -> UdpEndpoint:
        bound.append((address, insecure))
        raise UsageError

    monkeypatch.setattr("firmware_sim.addons.attach.vehicle.UdpEndpoint", bind)
    real = RealFirmware(connect="udpin://192.0.2.1:14550")
    asked = FirmwareRequest(Aircraft(firmware="attach", real=real), QUAD, None, cast(Any, None))
    with pytest.raises(UsageError):
        attach_parts(asked)
    assert bound == [(("192.0.2.1", 14550), True)]

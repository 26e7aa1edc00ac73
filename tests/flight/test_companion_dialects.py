"""The companion's link with flight controllers other than PX4: real MAVSDK, stand-ins."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from mavsdk.autopilot import Autopilot
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import WallClock
from companion.link_interface import STOP, BodyVelocity, LinkError
from companion.mavsdk_connection import ARDUPILOT, PX4, dialect_of
from companion.mavsdk_link import MavsdkLink
from firmware_sim.mavlink.endpoint import UdpEndpoint
from tests.support.ardupilot_copter import BRAKE, GUIDED, LAND, STABILIZE
from tests.support.ardupilot_stage import Stage, bridged
from tests.support.mavlink_clients import Bench, Pacer, wait_for
from tests.support.ports import LOOPBACK, free_ports

SPEED = 2.0
NEVER = threading.Event()


@contextmanager
def link_on(port: int, heard: Callable[[], bool] | None = lambda: True) -> Iterator[MavsdkLink]:
    """A link that takes heartbeats for regular: on a busy machine simulated time may crawl."""
    link = MavsdkLink(f"udpin://{LOOPBACK}:{port}", WallClock(SPEED), heard=heard)
    try:
        yield link
    finally:
        link.close()


@contextmanager
def ardupilot(link_port: int, **settings: float) -> Iterator[Stage]:
    """A stand-in for ArduCopter behind bridge and plant, time running."""
    with bridged([link_port], rate_hz=250, **settings) as stage, stage.flying(SPEED):
        yield stage


def until(condition: Callable[[], bool], link: MavsdkLink) -> None:
    """Wait while the link repeats the last setpoint."""
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline, f"timed out at {link.kinematics()}"
        time.sleep(0.01)


def test_kinds() -> None:
    assert dialect_of(Autopilot.ARDUPILOT) is ARDUPILOT
    for other in (Autopilot.PX4, Autopilot.GENERIC, Autopilot.UNKNOWN):
        assert dialect_of(other) is PX4


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("flight")
def test_a_flight_on_ardupilot() -> None:
    (port,), _ = free_ports(1, 0)
    with link_on(port) as link, ardupilot(port, position_s=4.0) as stage:
        copter = stage.peer.copter
        link.connect(20.0)
        link.prepare(10.0)
        assert link.dialect is ARDUPILOT
        assert copter.mode == STABILIZE
        link.arm(link.dialect.arm_timeout_s, NEVER)
        assert copter.position_ok
        link.takeoff(3.0, 60.0, NEVER)
        assert copter.mode == GUIDED
        assert -stage.simulation.truth.position[2] == pytest.approx(3.0, abs=0.7)

        link.enter_offboard()
        link.send_setpoint(BodyVelocity(1.5, 0.0, 0.0, 0.0))
        until(lambda: stage.simulation.truth.velocity[0] > 1.3, link)
        until(lambda: link.kinematics().velocity[0] > 1.3, link)
        link.send_setpoint(BodyVelocity(0.0, 1.0, 0.0, math.radians(20.0)))
        until(lambda: stage.simulation.truth.velocity[1] > 0.6, link)
        link.send_setpoint(STOP)
        until(lambda: math.hypot(*stage.simulation.truth.velocity[:2]) < 0.1, link)
        link.leave_offboard()
        assert copter.mode == BRAKE
        link.land(60.0)
        assert copter.mode == LAND
        assert not copter.armed
        link.arm(link.dialect.arm_timeout_s, NEVER)
        assert copter.mode == GUIDED


@pytest.mark.slow
@pytest.mark.xdist_group("flight")
def test_what_was_heard_of_the_last_ardupilot_does_not_count() -> None:
    """Between two episodes the firmware restarts; the link stays."""
    (port,), _ = free_ports(1, 0)
    with link_on(port) as link:
        with ardupilot(port, position_s=1.0):
            link.connect(20.0)
            link.prepare(10.0)
            wait_for(lambda: not link.missing_health())
        with ardupilot(port, position_s=1e6) as stage:
            wait_for(lambda: stage.simulation.time_us > 3e6)
            link.prepare(10.0)
            assert link.missing_health()
            assert math.isnan(link.kinematics().position[0])
            # Messages of the second vehicle arrive: attitudes are requested again.
            wait_for(lambda: not math.isnan(link.kinematics().quaternion[0]))
            assert link.missing_health()
            with pytest.raises(LinkError, match="refuses to arm"):
                link.arm(2.0, NEVER)
        with ardupilot(port, position_s=1.0):
            link.prepare(10.0)
            link.arm(60.0, NEVER)


def test_nobody_to_prepare() -> None:
    (port,), _ = free_ports(1, 0)
    with link_on(port, heard=None) as link:
        with ardupilot(port):
            link.connect(20.0)
            link.prepare(10.0)
        wait_for(lambda: not link.connected)
        with pytest.raises(LinkError, match=r"no flight controller heard on udpin://.* in 0\.3 s"):
            link.prepare(0.3)
        stop = threading.Event()
        stop.set()
        with pytest.raises(LinkError, match="stopped"):
            link.prepare(60.0, stop)


def test_px4_is_asked_for_two_streams_and_for_nothing_right_after_connecting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (port,), _ = free_ports(1, 0)
    endpoint = UdpEndpoint(
        (LOOPBACK, 0), (LOOPBACK, port), local_option="local", remote_option="remote"
    )
    bench = Bench(endpoint)
    asked: list[int] = []
    onboard = next(link for link in bench.server._links if link.name == "onboard")
    scheduler = next(iter(onboard)).link.scheduler
    set_interval = scheduler.set_interval

    def note(name: str, interval_us: int, now_us: int) -> None:
        asked.append(getattr(dialect, f"MAVLINK_MSG_ID_{name}"))
        set_interval(name, interval_us, now_us)

    monkeypatch.setattr(scheduler, "set_interval", note)
    kinematics = [dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED]
    kinematics.append(dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION)
    pacer = Pacer(bench)
    with link_on(port) as link:
        pacer.start()
        try:
            link.connect(20.0)
            assert link.dialect is PX4
            assert [number for number in asked if number in kinematics] == kinematics
            before = Counter(asked)
            link.prepare(10.0)
            assert Counter(asked) == before
            wait_for(lambda: not link.missing_health())
            link.prepare(10.0)
            assert [number for number in asked if number in kinematics] == kinematics * 2
            wait_for(lambda: not link.missing_health())
        finally:
            pacer.stop()
    bench.server.close()


@pytest.mark.parametrize(("sent_a", "told_a"), [(12.34, 12.34), (-1.0, None)])
def test_a_current_that_px4_does_not_measure_is_not_known(
    sent_a: float, told_a: float | None
) -> None:
    (port,), _ = free_ports(1, 0)
    bench = Bench(
        UdpEndpoint((LOOPBACK, 0), (LOOPBACK, port), local_option="local", remote_option="remote")
    )
    bench.autopilot.battery = bench.autopilot.battery._replace(current_a=sent_a)
    pacer = Pacer(bench)
    with link_on(port) as link:
        pacer.start()
        try:
            link.connect(20.0)
            # Of SYS_STATUS MAVSDK takes the voltage, of BATTERY_STATUS the current.
            wait_for(lambda: math.isfinite(link._telemetry.battery().current_battery_a))
            battery = link.battery()
            assert battery.voltage_v == pytest.approx(15.8, abs=1e-3)
            assert battery.current_a == (told_a if told_a is None else pytest.approx(told_a))
            assert battery.remaining == pytest.approx(0.83)
        finally:
            pacer.stop()
    bench.server.close()

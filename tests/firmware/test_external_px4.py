"""The bridge to PX4's simulator interface, against a peer that behaves as PX4 was measured to."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US
from airl_mav.core.errors import UsageError
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.autopilot.commander import CommanderState
from firmware_sim.external.launcher import FirmwareProcess
from firmware_sim.external.programs import find_px4
from firmware_sim.external.px4_sitl import EPOCH_US, Px4Bridge
from firmware_sim.interfaces import (
    ActuatorControls,
    FirmwareLostError,
    FirmwareMissingError,
    SensorSample,
)
from firmware_sim.simulation import EpisodeSetup, Simulation
from firmware_sim.warm_up import warm_up
from tests.support.flight_rig import quad
from tests.support.ports import LOOPBACK, free_ports
from tests.support.px4_peer import SILENT_SAMPLES, Ports, Px4Peer, write_build

PATIENCE_S = 60.0
PATIENT = {"answer_s": PATIENCE_S, "start_s": PATIENCE_S}


def fine() -> None:
    """The process is well."""


class Flown:
    """A bridge as a flight controller. Implements `FlightController`."""

    on_message: Callable[[OperatorText], None] | None = None
    internals = None
    body_by = None
    flight = CommanderState()

    def __init__(self, bridge: Px4Bridge) -> None:
        self.bridge = bridge
        self.rate_hz = bridge.rate_hz
        self.use_truth, self.close = bridge.use_truth, bridge.close
        self.last: ActuatorControls | None = None

    @property
    def controls(self) -> ActuatorControls:
        assert self.last is not None, "no tick yet"
        return self.last

    def step(self, sample: SensorSample) -> ActuatorControls:
        self.last = self.bridge.step(sample)
        return self.last


class Scene:
    """Our vehicle on the ground, its motors in the hands of a peer."""

    def __init__(self, bridge: Px4Bridge, peer: Px4Peer | None, start_us: int) -> None:
        self.bridge, self._peer = bridge, peer
        self.controller = Flown(bridge)
        setup = EpisodeSetup(quad(), None, 1)
        self.sim = Simulation(setup, start_us=start_us, clock=SimClock(), autopilot=self.controller)

    @property
    def peer(self) -> Px4Peer:
        assert self._peer is not None, "a scene without one"
        return self._peer

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * 250)):
            self.sim.tick()

    def until(self, met: Callable[[], bool], limit_s: float) -> None:
        for _ in range(round(limit_s * 250)):
            if met():
                return
            self.sim.tick()
        raise AssertionError(f"not within {limit_s} s")

    def height(self) -> float:
        return -float(self.sim.truth.position[2])


def peer_ports(simulator: int) -> Ports:
    udp, _ = free_ports(8, 0)
    api, gcs, payload, gimbal = zip(udp[::2], udp[1::2], strict=True)
    return Ports(simulator, api, gcs, payload, gimbal)


@contextmanager
def listening(**settings: Any) -> Iterator[Px4Bridge]:
    bridge = Px4Bridge(0, **{**PATIENT, **settings})
    try:
        yield bridge
    finally:
        bridge.close()


@contextmanager
def scene(
    *,
    start_us: int = TICK_US,
    settings: dict[str, Any] | None = None,
    alive: Callable[[], None] = fine,
    **faults: float,
) -> Iterator[Scene]:
    """Yield a flight with a peer that has these faults, `no_lockstep=0.0`."""
    with listening(**(settings or {})) as bridge:
        named = {kind.replace("_", "-"): at_s for kind, at_s in faults.items()}
        peer = Px4Peer(peer_ports(bridge.port), named)
        thread = threading.Thread(target=peer.run, daemon=True)
        thread.start()
        try:
            bridge.wait_connected(PATIENCE_S, alive)
            flight = Scene(bridge, peer, start_us)
            try:
                yield flight
            finally:
                flight.sim.close()
        finally:
            peer.stop.set()
            thread.join(PATIENCE_S)
    assert not thread.is_alive()


def lost(flight: Scene, seconds: float = 10.0) -> str:
    """Fly until the firmware is lost; return the error message."""
    with pytest.raises(FirmwareLostError) as caught:
        flight.fly(seconds)
    text = str(caught.value)
    assert "\n" not in text
    assert f"PX4 on TCP port {flight.bridge.port}" in text
    return text


# --- the order of messages


def test_start_runs_free_and_then_every_sample_is_answered() -> None:
    with scene() as flight:
        still: list[ActuatorControls] = []
        while flight.bridge.time_us == 0:
            flight.sim.tick()
            still.append(flight.controller.controls)
        assert len(still) - 1 <= flight.bridge.unanswered <= len(still)
        assert flight.bridge.unanswered >= SILENT_SAMPLES
        assert all(c.motors == (0.0, 0.0, 0.0, 0.0) and not c.armed for c in still)
        assert [c.time_us for c in still] == [TICK_US * (i + 1) for i in range(len(still))]
        for _ in range(50):
            flight.sim.tick()
            controls = flight.controller.controls
            assert controls.time_us == flight.sim.time_us - TICK_US
            assert flight.bridge.time_us == controls.time_us - TICK_US + EPOCH_US
        assert flight.bridge.duplicates == 0


def test_firmware_time_begins_anew_whatever_the_simulated_time() -> None:
    with scene(start_us=3_600_000_000) as flight:
        flight.fly(1.0)
        heard = [m for m in flight.peer.heard if m.get_type() == "HIL_SENSOR"]
        assert [m.time_usec for m in heard[:3]] == [1_000_000, 1_004_000, 1_008_000]


def test_slower_sensors_come_at_their_own_rates_and_the_truth_as_asked() -> None:
    with scene() as flight:
        flight.until(lambda: flight.bridge.time_us > 0, 5.0)
        flight.peer.heard.clear()
        flight.fly(2.0)
        heard = list(flight.peer.heard)
        sensors = [m for m in heard if m.get_type() == "HIL_SENSOR"]
        profile = quad().sensors
        count = {
            name: sum(bool(m.fields_updated & bit) for m in sensors)
            for name, bit in (("imu", 1), ("mag", 64), ("baro", 512))
        }
        assert count["imu"] == len(sensors) == 500
        assert count["mag"] == pytest.approx(2.0 * profile.magnetometer.rate_hz, abs=1)
        assert count["baro"] == pytest.approx(2.0 * profile.barometer.rate_hz, abs=1)
        fixes = [m for m in heard if m.get_type() == "HIL_GPS"]
        assert len(fixes) == pytest.approx(2.0 * profile.gps.rate_hz, abs=1)
        # The peer requests one every 5 ms: four of five samples.
        states = [m for m in heard if m.get_type() == "HIL_STATE_QUATERNION"]
        assert len(states) == pytest.approx(400, abs=2)
        assert states[-1].alt == pytest.approx(489_400, abs=200)


def test_a_fix_arrives_as_late_as_px4_assumes(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene() as flight:
        measured: list[int] = []
        step = flight.bridge.step

        def noted(sample: SensorSample) -> ActuatorControls:
            if sample.gps is not None:
                measured.append(sample.time_us - TICK_US + EPOCH_US)
            return step(sample)

        monkeypatch.setattr(flight.bridge, "step", noted)
        flight.fly(2.0)
        fixes = [m.time_usec for m in flight.peer.heard if m.get_type() == "HIL_GPS"]
        assert len(fixes) > 5
        # EKF2_GPS_DELAY, 10 ms, and the stamp of the previous sample, 4 ms, in whole ticks.
        assert {late - due for late, due in zip(fixes, measured, strict=False)} == {16_000}


def test_takeoff_hover_and_landing() -> None:
    with scene() as flight:
        client = Client(flight.peer.ports.api)
        try:
            flight.until(client.ready, 20.0)
            client.command(400, 1.0)
            flight.until(lambda: flight.bridge.armed, 2.0)
            client.command(22)
            flight.until(lambda: flight.height() > 2.0, 20.0)
            flight.fly(5.0)
            assert flight.height() == pytest.approx(2.5, abs=0.5)
            assert np.hypot(*flight.sim.truth.position[:2]) < 0.5
            client.command(21)
            flight.until(lambda: not flight.bridge.armed, 30.0)
            assert flight.height() < 0.2
        finally:
            client.close()


class Client:
    """A raw client on one UDP link."""

    def __init__(self, ports: tuple[int, int]) -> None:
        self.mav = dialect.MAVLink(None, 245, 190)
        self.vehicle, local = (LOOPBACK, ports[0]), (LOOPBACK, ports[1])
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(local)
        self.socket.setblocking(False)
        self.standing_by = False

    def ready(self) -> bool:
        while True:
            try:
                data = self.socket.recv(4096)
            except BlockingIOError:
                return self.standing_by
            for message in self.mav.parse_buffer(data) or []:
                if message.get_type() == "HEARTBEAT":
                    self.standing_by = message.system_status == 3

    def command(self, number: int, *params: float) -> None:
        filled = [*params, *[float("nan")] * (7 - len(params))]
        message = dialect.MAVLink_command_long_message(1, 1, number, 0, *filled)
        self.socket.sendto(message.pack(self.mav), self.vehicle)

    def close(self) -> None:
        self.socket.close()


class Wire:
    """Connection that sends the answers a test specifies."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection((LOOPBACK, port), PATIENCE_S)
        self.mav = dialect.MAVLink(None, 1, 1)
        self.us = EPOCH_US

    def send(self, *messages: Any) -> None:
        self.socket.sendall(b"".join(m.pack(self.mav) for m in messages))

    def answer(self, us: int) -> None:
        self.send(dialect.MAVLink_hil_actuator_controls_message(us, [0.0] * 16, 1, 1))

    def ask(self, command: int, what: float, interval_us: float) -> None:
        ask = (command, 0, what, interval_us, 0, 0, 0, 0, 0)
        self.send(dialect.MAVLink_command_long_message(0, 0, *ask))

    def heard(self) -> list[str]:
        """Return the messages that wait to be read, all that were sent by now."""
        self.socket.settimeout(0.05)
        names = []
        try:
            while data := self.socket.recv(65_536):
                names += [m.get_type() for m in self.mav.parse_buffer(data) or []]
        except TimeoutError:
            return names
        return names


INTERVALS = [
    pytest.param((511, 115, -1.0), 1, id="off"),
    pytest.param((511, 115, 0.0), 6, id="default"),
    pytest.param((511, 115, 100_000.0), 11, id="10 Hz"),
    pytest.param((511, 115, float("nan")), 5, id="no number"),
    pytest.param((511, 31, 4_000.0), 5, id="another message"),
    pytest.param((512, 115, 4_000.0), 5, id="another command"),
]


@pytest.mark.parametrize(("asked", "states"), INTERVALS)
def test_how_often_the_truth_is_asked_for(asked: tuple[int, int, float], states: int) -> None:
    with listening() as bridge:
        wire = Wire(bridge.port)
        with wire.socket:
            bridge.wait_connected(PATIENCE_S, fine)
            flight = Scene(bridge, None, TICK_US)
            # The first state goes before the question is heard, the second one right after it.
            # Every answer is on its way before its sample is: one thread is enough.
            wire.ask(*asked)
            wire.answer(EPOCH_US)
            while bridge.time_us == 0:
                flight.sim.tick()
            sent = bridge.unanswered
            for i in range(250 - sent):
                wire.answer(EPOCH_US + (sent + i) * TICK_US)
                flight.sim.tick()
            names = wire.heard()
            flight.sim.close()
    assert names.count("HIL_SENSOR") == 250
    assert names.count("HIL_STATE_QUATERNION") == states


# --- faults


def test_it_dies() -> None:
    with scene(die=0.5) as flight:
        text = lost(flight)
        assert "closed its connection" in text
        assert "at 1.5" in text


def test_it_stalls() -> None:
    with scene(stall=0.5, settings={"answer_s": 1.0}) as flight:
        assert "did not answer within 1 s, at 1." in lost(flight)


def test_disarmed_it_may_leave_samples_unanswered() -> None:
    """Real PX4 does, in Offboard on the ground without a setpoint: the time must advance."""
    with scene(idle=0.2) as flight:
        flight.until(lambda: flight.bridge.time_us > 0, 5.0)
        flight.fly(0.3)
        before = flight.bridge.time_us
        flight.fly(0.1)
        assert flight.bridge.time_us > before
        assert not flight.bridge.armed


def test_whose_process_died_is_known_before_the_wait_is_over() -> None:
    died: list[str] = []

    def alive() -> None:
        if died:
            raise FirmwareLostError(died[0])

    with scene(stall=0.5, alive=alive) as flight:
        flight.until(lambda: flight.bridge.time_us > 0, 5.0)
        died.append("PX4 ended (exit status 1)")
        with pytest.raises(FirmwareLostError, match="exit status 1"):
            flight.fly(5.0)


def test_it_restarts_in_the_air() -> None:
    with scene(restart=0.5) as flight:
        assert "it ended, or restarted" in lost(flight)


def test_garbage_instead_of_answers() -> None:
    with scene(garbage=0.5) as flight:
        assert "are not MAVLink" in lost(flight)


def test_some_noise_before_an_answer_is_survived() -> None:
    with scene(noise=0.5) as flight:
        flight.fly(2.0)
        assert flight.bridge.time_us > 2_900_000


def test_times_that_have_passed() -> None:
    with scene(old=0.5) as flight:
        assert "went back in time from 1.496 s to 0.500 s" in lost(flight)


def test_times_to_come() -> None:
    with scene(future=0.5) as flight:
        assert "not sent yet: 2.500 s, at 1.500 s" in lost(flight)


def test_a_second_answer_is_dropped() -> None:
    with scene(twice=0.5) as flight:
        flight.fly(1.5)
        assert flight.bridge.duplicates > 100


def test_motors_commanded_while_disarmed_stand_still() -> None:
    with scene(spin=0.2) as flight:
        flight.fly(2.0)
        assert flight.controller.controls.motors == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("fault", "said"), [("nan", "controls[1] = nan"), ("servo", "= -0.5")])
def test_commands_that_are_no_motors(fault: str, said: str) -> None:
    faults: dict[str, Any] = {fault: 0.5}
    with scene(**faults) as flight:
        client = Client(flight.peer.ports.api)
        try:
            flight.until(client.ready, 20.0)
            client.command(400, 1.0)
            text = lost(flight)
        finally:
            client.close()
        assert said in text


def test_a_build_that_does_not_wait_is_refused() -> None:
    with scene(no_lockstep=0.0) as flight, pytest.raises(FirmwareMissingError, match="lockstep"):
        flight.fly(2.0)


def test_it_never_connects() -> None:
    said = r"did not connect .* PX4_SIM_MODEL"
    with listening() as bridge, pytest.raises(FirmwareMissingError, match=said):
        bridge.wait_connected(0.2, fine)


def test_a_process_that_dies_before_it_connects() -> None:
    def dead() -> None:
        raise FirmwareLostError("PX4 ended (exit status 255)")

    with listening() as bridge, pytest.raises(FirmwareLostError, match="255"):
        bridge.wait_connected(PATIENCE_S, dead)


def test_it_connects_and_never_answers() -> None:
    with listening(start_s=0.3) as bridge, socket.create_connection((LOOPBACK, bridge.port)):
        bridge.wait_connected(PATIENCE_S, fine)
        flight = Scene(bridge, None, TICK_US)
        try:
            text = lost(flight)
        finally:
            flight.sim.close()
    assert "answered none of" in text
    # Samples are sent no faster than measured: without answers they pile up.
    assert bridge.unanswered <= 0.3 * 250 + 2


def test_a_second_one_is_turned_away() -> None:
    with scene(die=1.0) as flight:
        flight.until(lambda: flight.bridge.time_us > 0, 5.0)
        with socket.create_connection((LOOPBACK, flight.bridge.port)) as second:
            flight.fly(0.5)
            second.settimeout(PATIENCE_S)
            assert second.recv(1) == b""
        assert "1 other connections refused" in lost(flight)


def test_a_taken_port_names_the_option() -> None:
    with listening() as bridge, pytest.raises(UsageError, match=r"taken .*--instance"):
        Px4Bridge(bridge.port)


@pytest.mark.parametrize("port", [-1, 70_000])
def test_a_port_that_is_none(port: int) -> None:
    with pytest.raises(UsageError, match=r"--instance"):
        Px4Bridge(port)


def test_the_port_is_free_again_at_once() -> None:
    with listening() as bridge:
        port = bridge.port
        with socket.create_connection((LOOPBACK, port)):
            bridge.wait_connected(PATIENCE_S, fine)
    Px4Bridge(port).close()
    bridge.close()  # harmless


# --- the peer as a program, in PX4's place


def test_a_program_started_like_px4_is_flown(tmp_path: Path) -> None:
    warm_up(quad())  # compiled once, for both processes
    with listening() as bridge:
        ports = peer_ports(bridge.port)
        links = ("api", "gcs", "payload", "gimbal")
        options = [
            word for link in links for word in (f"--{link}", "{}:{}".format(*getattr(ports, link)))
        ]
        build = write_build(tmp_path / "build", *options, "--port", str(bridge.port))
        program = find_px4(build)
        start = program.start(3, 10016, tmp_path)
        child = FirmwareProcess("PX4", start, tmp_path, tmp_path / "log")
        try:
            bridge.wait_connected(PATIENCE_S, child.check)
            flight = Scene(bridge, None, TICK_US)
            flight.until(lambda: bridge.time_us > 0, 60.0)
            flight.fly(1.0)
            flight.sim.close()
            child.check()
        finally:
            child.stop()
    assert "simulator on TCP port" in (tmp_path / "log").read_text()

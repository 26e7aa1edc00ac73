"""The bridge to ArduPilot's JSON simulator interface: bytes, lockstep, faults, a flight."""

from __future__ import annotations

import json
import re
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.core.errors import UsageError
from airl_mav.vehicle.rotation import Vec
from firmware_sim.addons.ardupilot.bridge import (
    MAX_GARBAGE,
    ArdupilotBridge,
    ServoPacketError,
    parse_servos,
    state_line,
)
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.interfaces import (
    ActuatorControls,
    BatterySample,
    FirmwareLostError,
    FirmwareMissingError,
    SensorSample,
    TrueState,
)
from tests.support.ardupilot_copter import GUIDED, LAND
from tests.support.ardupilot_peer import ArdupilotPeer
from tests.support.ardupilot_stage import bridged
from tests.support.ardupilot_wire import State, read_state
from tests.support.ports import LOOPBACK, free_ports

START_US = 7_000_000_000
"""Start of simulated time [µs]; it continues over the episodes of a process."""

IDLE = [1000] * 4
NUMBERS = st.floats(-1e6, 1e6)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)


def sample(
    time_us: int = START_US, accel: Any = (0.1, -0.2, -9.81), gyro: Any = (1e-7, 0, -0.5)
) -> SensorSample:
    battery = BatterySample(16.0, 10.0, 0.0, 1.0)
    return SensorSample(time_us, np.array(accel, float), np.array(gyro, float), 20.0, battery)


def truth(position: Any = (1.5, -2.25, -3.0), velocity: Any = (0.5, 1e-9, -2e5)) -> TrueState:
    attitude = np.array([0.5, -0.5, 0.5, 0.5])
    return TrueState(
        0, np.array(position, float), np.array(velocity, float), attitude, np.zeros(3), 300.0, 1.0
    )


# --- bytes


def packet(count: int, pwm: list[int] | None = None, rate: int = 400, magic: int = 18_458) -> bytes:
    """A servo packet written by hand: little endian, no padding."""
    words = (pwm or IDLE) + [0] * 12
    return (
        magic.to_bytes(2, "little")
        + rate.to_bytes(2, "little")
        + count.to_bytes(4, "little")
        + b"".join(word.to_bytes(2, "little") for word in words)
    )


def test_servo_packets_are_read() -> None:
    read = parse_servos(packet(70_000, [1000, 1250, 1999, 2000], 1200))
    assert (read.frame_rate_hz, read.frame_count) == (1200, 70_000)
    assert read.pwm_us == (1000, 1250, 1999, 2000, *[0] * 12)
    many = struct.pack("<HHI32H", 29_569, 400, 3, *range(1000, 1032))
    assert parse_servos(many).pwm_us == tuple(range(1000, 1032))


@pytest.mark.parametrize(
    ("datagram", "why"),
    [
        (b"", "0 bytes: a servo packet has 40 or 72"),
        (packet(1)[:-1], "39 bytes"),
        (packet(1) + b"\0", "41 bytes"),
        (packet(1, magic=29_569), "magic 29569: a packet of 40 bytes has 18458"),
        (struct.pack("<HHI32H", 18_458, 400, 3, *[0] * 32), "of 72 bytes has 29569"),
    ],
)
def test_other_datagrams_are_refused(datagram: bytes, why: str) -> None:
    with pytest.raises(ServoPacketError, match=re.escape(why)):
        parse_servos(datagram)


@given(NUMBERS, VECTORS, VECTORS, VECTORS, VECTORS)
def test_state_lines_are_read_back_exactly(
    time: float, gyro: Vec, accel: Vec, position: Vec, velocity: Vec
) -> None:
    time_us = abs(int(time * 1e6)) + 1
    line = state_line(time_us, sample(0, accel, gyro), truth(position, velocity))
    text = line.decode("ascii")
    assert text[0] == text[-1] == "\n"
    assert "\n" not in text[1:-1]
    # ArduPilot's way: substring, then scanf. Another reader's way: JSON. Both see the same.
    parsed = json.loads(text)
    seconds = parsed.pop("timestamp")
    assert seconds == pytest.approx(time_us / 1e6, rel=2e-8)
    expected = State(seconds, gyro, accel, position, (0.5, -0.5, 0.5, 0.5), velocity, True)
    assert read_state(text) == expected
    assert parsed == {
        "imu": {"gyro": [*gyro], "accel_body": [*accel]},
        "position": [*position],
        "quaternion": [0.5, -0.5, 0.5, 0.5],
        "velocity": [*velocity],
        "no_time_sync": 1,
    }


def test_no_time_is_lost_between_two_lines() -> None:
    """ArduPilot cuts the difference of two timestamps to whole microseconds."""
    times_us = [1_000 + k * 1_000_000 // 1200 for k in range(60_000)]
    seconds = [json.loads(state_line(t, sample(), truth()))["timestamp"] for t in times_us[::100]]
    steps = [int((b - a) * 1e6) for a, b in pairwise(seconds)]
    assert steps == [b - a for a, b in zip(times_us[::100], times_us[100::100], strict=False)]
    close = [json.loads(state_line(t, sample(), truth()))["timestamp"] for t in times_us[-500:]]
    steps = [int((b - a) * 1e6) for a, b in pairwise(close)]
    assert steps == [b - a for a, b in zip(times_us[-500:], times_us[-499:], strict=False)]


def test_the_readers_of_this_test_know_bad_lines() -> None:
    line = state_line(1000, sample(), truth()).decode()
    assert read_state(line.replace('"gyro":[', '"gyro": [')) is None
    assert read_state(line.replace("velocity", "speed")) is None
    assert read_state(line.replace("quaternion", "rotation")) is None


# --- the exchange


class Rig:
    """A bridge, and a socket that is ArduPilot's: every packet and line by hand."""

    def __init__(self, **settings: Any) -> None:
        (self.port,), _ = free_ports(1, 0)
        self.bridge = ArdupilotBridge(self.port, **settings)
        self.bridge.use_truth(truth)
        self.socket = _socket()
        self.time_us = START_US
        self._pool = ThreadPoolExecutor(1)

    def say(self, datagram: bytes, sender: socket.socket | None = None) -> None:
        (sender or self.socket).sendto(datagram, (LOOPBACK, self.port))

    def connect(self, rate: int = 400) -> None:
        self.say(packet(0, rate=rate))
        self.bridge.wait_connected(5.0, _alive)

    def step(self) -> Future[ActuatorControls]:
        """Begin a step."""
        step = self._pool.submit(self.bridge.step, sample(self.time_us))
        self.time_us += 2500
        return step

    def line(self) -> bytes:
        return self.socket.recv(65_000)

    def silent(self) -> bool:
        """Return True if no line arrives within 0.3 s."""
        self.socket.settimeout(0.3)
        try:
            self.socket.recv(65_000)
        except TimeoutError:
            return True
        finally:
            self.socket.settimeout(5.0)
        return False

    def fly(self, frames: int) -> None:
        """Exchange some frames after the first packet."""
        for count in range(1, frames + 1):
            step = self.step()
            self.line()
            self.say(packet(count))
            step.result(5.0)

    def close(self) -> None:
        self.bridge.close()
        self._pool.shutdown()
        self.socket.close()


@contextmanager
def exchange(**settings: Any) -> Iterator[Rig]:
    rig = Rig(**settings)
    try:
        yield rig
    finally:
        rig.close()


def _socket() -> socket.socket:
    new = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    new.settimeout(5.0)
    return new


def _alive() -> None:
    pass


def test_one_line_for_one_packet_in_its_own_time() -> None:
    with exchange() as rig:
        rig.connect(400)
        assert rig.bridge.rate_hz == 400
        stamps = []
        for count in range(1, 6):
            step = rig.step()
            state = read_state(rig.line().decode())
            assert state is not None
            stamps.append(state.timestamp_s)
            assert not step.done()
            rig.say(packet(count, [1000, 1250, 1500, 2000] if count == 5 else IDLE))
            controls = step.result(5.0)
            assert rig.bridge.armed == controls.armed == (count == 5)
        assert stamps == pytest.approx([0.0025, 0.005, 0.0075, 0.01, 0.0125], abs=1e-9)
        assert controls == (rig.time_us - 2500, (0.0, 0.25, 0.5, 1.0), True)
        assert rig.silent()


def test_pulses_outside_the_range() -> None:
    with exchange() as rig:
        rig.connect(1200)
        assert rig.bridge.rate_hz == 1200
        step = rig.step()
        rig.line()
        rig.say(packet(1, [0, 1000, 1500, 2200]))
        assert step.result(5.0).motors == (0.0, 0.0, 0.5, 1.0)


def test_a_lost_line_is_sent_again_unchanged() -> None:
    with exchange() as rig:
        rig.connect()
        rig.fly(2)
        step = rig.step()
        line = rig.line()
        rig.say(packet(2))
        assert rig.line() == line
        assert not step.done()
        rig.say(packet(3))
        assert step.result(5.0).motors == (0.0, 0.0, 0.0, 0.0)


def test_what_was_asked_more_than_once_is_answered_once() -> None:
    with exchange() as rig:
        rig.connect()
        for _ in range(3):  # the plant is not stepped for three seconds
            rig.say(packet(0))
        step = rig.step()
        rig.line()
        rig.say(packet(1))
        step.result(5.0)
        assert rig.silent()


def test_a_restart_in_the_air_is_noticed() -> None:
    with exchange() as rig:
        rig.connect()
        rig.fly(3)
        step = rig.step()
        rig.line()
        rig.say(packet(0))
        with pytest.raises(FirmwareLostError, match="restarted during"):
            step.result(5.0)


def test_a_restart_from_another_port_is_noticed() -> None:
    with exchange(silence_s=60.0) as rig, _socket() as other:
        rig.connect()
        rig.fly(3)
        step = rig.step()
        rig.line()
        rig.say(packet(0), other)
        with pytest.raises(FirmwareLostError, match="restarted during"):
            step.result(20.0)


def test_others_are_not_listened_to() -> None:
    with exchange() as rig, _socket() as other:
        rig.connect()
        step = rig.step()
        rig.line()
        rig.say(packet(1, [2000] * 4), other)
        assert not rig.bridge.armed
        rig.say(packet(1))
        assert step.result(5.0).motors == (0.0, 0.0, 0.0, 0.0)
        other.settimeout(0.2)
        with pytest.raises(TimeoutError):
            other.recv(100)


def test_a_little_garbage_does_no_harm_much_does() -> None:
    with exchange() as rig:
        rig.say(b"hello")
        rig.connect()
        step = rig.step()
        rig.line()
        for _ in range(MAX_GARBAGE - 1):
            rig.say(packet(1, magic=1))
        rig.say(packet(1))
        step.result(5.0)
        assert rig.bridge.garbage == MAX_GARBAGE
        step = rig.step()
        rig.line()
        for _ in range(MAX_GARBAGE):
            rig.say(packet(2, magic=1))
        with pytest.raises(FirmwareLostError, match="are not servo packets: magic 1:"):
            step.result(5.0)


def test_silence_is_bounded_and_its_process_looked_at() -> None:
    with exchange(silence_s=0.3) as rig:
        rig.connect()
        with pytest.raises(FirmwareLostError, match=r"no servo packet for 0\.3 s"):
            rig.step().result(20.0)

    def dead() -> None:
        raise FirmwareLostError("ArduPilot died with code 1")

    with exchange() as rig:
        rig.say(packet(0))
        looks: list[Callable[[], None]] = [_alive]
        rig.bridge.wait_connected(5.0, lambda: looks[-1]())
        looks.append(dead)
        with pytest.raises(FirmwareLostError, match="died with code 1"):
            rig.step().result(20.0)


def test_nobody_comes() -> None:
    with exchange() as rig:
        rig.say(b"hello")
        with pytest.raises(FirmwareMissingError, match=f"--sim-port-out {rig.port}") as caught:
            rig.bridge.wait_connected(0.3, _alive)
        assert "only 1 other datagrams" in str(caught.value)


def test_one_that_has_flown_before_is_not_taken() -> None:
    """Its clock shows the end of that flight; a stale instance keeps repeating its packet."""
    with exchange() as rig, _socket() as veteran:
        rig.say(packet(5000), veteran)
        with pytest.raises(FirmwareMissingError, match="only one that has flown before"):
            rig.bridge.wait_connected(0.3, _alive)
        rig.say(packet(5000), veteran)
        rig.connect()
        rig.fly(2)


def test_an_impossible_rate() -> None:
    with exchange() as rig, pytest.raises(FirmwareMissingError, match=r"0 Hz \(SIM_RATE_HZ\)"):
        rig.connect(0)


def test_a_port_that_is_taken() -> None:
    with exchange() as rig, pytest.raises(UsageError, match="--instance: UDP port"):
        ArdupilotBridge(rig.port)


# --- with the stand-in


@pytest.mark.slow
def test_it_hovers_and_lands() -> None:
    with bridged(rate_hz=250, position_s=1.0) as stage:
        copter, sim = stage.peer.copter, stage.simulation
        stage.until(lambda: copter.position_ok, 20.0)
        assert (copter.set_mode(GUIDED), copter.arm()) == (Result.ACCEPTED, Result.ACCEPTED)
        stage.run(0.1)
        assert stage.bridge.armed
        assert copter.takeoff(2.0) is Result.ACCEPTED
        stage.run(12.0)
        assert -sim.truth.position[2] == pytest.approx(2.0, abs=0.3)
        assert np.linalg.norm(sim.truth.velocity) < 0.2
        copter.set_mode(LAND)
        stage.until(lambda: not stage.bridge.armed, 20.0)
        assert -sim.truth.position[2] == pytest.approx(0.055, abs=0.05)
        # Strictly one line for one packet, and time went by for all of them.
        link = stage.peer.link
        assert link.stalled_lines == 0
        assert link.frame_count == len(link.stamps)
        assert np.diff(link.stamps) == pytest.approx(0.004, abs=1e-6)


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ("stall@0.5", "no servo packet for 1 s"),
        ("die@0.5", "no servo packet for 1 s"),
        ("restart@0.5", "restarted during"),
        ("garbage@0.5", "are not servo packets"),
    ],
)
def test_faults_of_the_firmware(fault: str, why: str) -> None:
    with bridged(rate_hz=250, fault=fault, silence_s=1.0) as stage:
        with pytest.raises(FirmwareLostError, match=why):
            stage.run(3.0)
        assert stage.simulation.time_us - stage.simulation.start_us == pytest.approx(5e5, abs=2e4)


def test_a_process_that_dies_is_noticed_at_once() -> None:
    with bridged(rate_hz=250, fault="die@0.2", silence_s=600.0) as stage:
        stage.dies = FirmwareLostError("ArduPilot ended")
        with pytest.raises(FirmwareLostError, match="ArduPilot ended"):
            stage.run(3.0)


def test_a_peer_asks_again_when_nobody_answers() -> None:
    (port,), _ = free_ports(1, 0)
    bridge = ArdupilotBridge(port)
    bridge.use_truth(truth)
    asked = threading.Event()
    with ArdupilotPeer(port, rate_hz=250) as peer:
        bridge.wait_connected(10.0, _alive)
        assert not asked.wait(2.5)
        bridge.step(sample())
        assert peer.link.resent >= 1
        assert peer.link.stalled_lines == 0
    bridge.close()

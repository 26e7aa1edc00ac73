"""PX4 as a conductor needs it: an echo, a separate instance, idle threads."""

from __future__ import annotations

import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from airl_mav.core.constants import TICK_US
from airl_mav.core.errors import UsageError
from airl_mav.lockstep.vehicle import acknowledged, command_of
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.aircraft import Aircraft, RealFirmware
from firmware_sim.external import px4_lockstep as conducted_module
from firmware_sim.external import px4_lockstep as link_module
from firmware_sim.external.launcher import (
    Launcher,
    RunningProgram,
    StartCommand,
    WorkingFolders,
    program_at,
)
from firmware_sim.external.parameters import SITL_OUTPUT, px4_airframe
from firmware_sim.external.programs import API_LOCAL_PORT, SIMULATOR_PORT, check_free
from firmware_sim.external.px4_lockstep import OnboardLink, conducted_px4
from firmware_sim.external.px4_sitl import EPOCH_US, Px4Bridge
from firmware_sim.interfaces import FirmwareLostError, FirmwareMissingError
from firmware_sim.mavlink.codec import Decoder, Encoder, dialect
from firmware_sim.plant.plant import Plant
from tests.support.ports import CONDUCTED_INSTANCE as INSTANCE
from tests.support.ports import LOOPBACK, reserved_conducted
from tests.support.px4_peer import write_build

NEEDS_PROC = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="Linux has it")


@pytest.fixture(autouse=True, scope="module")
def own_instances() -> Iterator[None]:
    """Keep the ports that are bound here for this module alone."""
    with reserved_conducted():
        yield


def fine() -> None:
    """The process is well."""


class Receiver:
    """Takes in messages one after the other, as PX4's thread does, and answers PINGs."""

    def __init__(self, *, deaf: bool = False) -> None:
        self.taken: list[str] = []
        self.deaf = deaf
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((LOOPBACK, API_LOCAL_PORT + INSTANCE))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        decoder, encoder = Decoder(datagrams=True), Encoder(INSTANCE + 1)
        while not self._stop.is_set():
            if not select.select([self._socket], [], [], 0.05)[0]:
                continue
            data, address = self._socket.recvfrom(4096)
            for message in decoder.feed(data):
                self.taken.append(message.get_type())
                if message.get_type() != "PING" or self.deaf:
                    continue
                # Another client's echo, and telemetry, arrive before ours.
                for target in ((255, 190), (message.get_srcSystem(), message.get_srcComponent())):
                    ping = dialect.MAVLink_ping_message(0, message.seq, *target)
                    self._socket.sendto(encoder.pack(ping), address)
                    beat = dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)
                    self._socket.sendto(encoder.pack(beat), address)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()


def setpoint() -> bytes:
    message = dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 8, 0, *[0.0] * 11)
    return Encoder(245, 190).pack(message)


def test_when_the_echo_is_there_everything_before_was_taken_in() -> None:
    with closing(Receiver()) as px4, closing(OnboardLink(INSTANCE, fine)) as link:
        for _ in range(20):
            link.send(setpoint())
            link.await_echo()
            assert px4.taken[-2:] == ["SET_POSITION_TARGET_LOCAL_NED", "PING"]
        kinds = [frame[7] for frame in link.take()]
    # Our echo is not passed on as telemetry; another client's is.
    assert kinds.count(dialect.MAVLINK_MSG_ID_PING) == 20
    assert kinds.count(dialect.MAVLINK_MSG_ID_HEARTBEAT) >= 39


def test_who_never_answers_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "ECHO_S", 0.3)
    with (
        closing(Receiver(deaf=True)),
        closing(OnboardLink(INSTANCE, fine)) as link,
        pytest.raises(FirmwareLostError, match=r"no answer to a PING in 0\.3 s"),
    ):
        link.await_echo()


def test_who_has_died_is_not_waited_for() -> None:
    def dead() -> None:
        raise FirmwareLostError("PX4 ended (SIGSEGV)")

    with (
        closing(OnboardLink(INSTANCE, dead)) as link,
        pytest.raises(FirmwareLostError, match="SIGSEGV"),
    ):
        link.await_echo()


# --- commands


def test_commands_and_their_final_answers_are_told_apart() -> None:
    encoder = Encoder()
    long = dialect.MAVLink_command_long_message(1, 1, 400, 0, 1.0, *[0.0] * 6)
    whole = dialect.MAVLink_command_int_message(1, 1, 3, 192, 0, 0, *[0.0] * 4, 0, 0, 0.0)
    assert command_of(encoder.pack(long)) == 400
    assert command_of(encoder.pack(whole)) == 192
    assert command_of(setpoint()) is None

    def answer(command: int, result: int) -> bytes:
        return encoder.pack(dialect.MAVLink_command_ack_message(command, result))

    assert acknowledged(answer(22, dialect.MAV_RESULT_ACCEPTED)) == 22
    assert acknowledged(answer(300, dialect.MAV_RESULT_DENIED)) == 300
    assert acknowledged(answer(22, dialect.MAV_RESULT_IN_PROGRESS)) is None
    assert acknowledged(encoder.pack(long)) is None


# --- instances


def asked(build: Path, instance: int) -> Aircraft:
    return Aircraft(firmware="px4", real=RealFirmware(px4_dir=build, instance=instance))


def test_side_by_side_each_takes_an_instance_of_its_own(tmp_path: Path) -> None:
    build, vehicle = write_build(tmp_path / "px4"), load_vehicle("quad")
    flown = [conducted_px4(asked(build, INSTANCE), vehicle, None) for _ in range(2)]
    try:
        first, second = (px4.instance for px4 in flown)
        assert INSTANCE <= first < second
    finally:
        for px4 in flown:
            px4.stack.close()
    again = conducted_px4(asked(build, INSTANCE), vehicle, None)
    again.stack.close()
    assert again.instance == first


def test_instances_come_to_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conducted_module, "GREATEST_INSTANCE", INSTANCE)
    build = write_build(tmp_path / "px4")
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other:
        other.bind((LOOPBACK, API_LOCAL_PORT + INSTANCE))
        with pytest.raises(UsageError, match=f"no instance of PX4's from {INSTANCE} to {INSTANCE}"):
            conducted_px4(asked(build, INSTANCE), load_vehicle("quad"), None)
        with pytest.raises(UsageError, match=f"UDP port {API_LOCAL_PORT + INSTANCE}, .* is taken"):
            check_free(INSTANCE)
    check_free(INSTANCE)


# --- its process, from outside


@contextmanager
def program(code: str) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        try:
            assert child.stdout is not None
            child.stdout.readline()
            yield child
        finally:
            child.kill()


def name_of(child: subprocess.Popen[bytes]) -> bytes:
    return Path(f"/proc/{child.pid}/comm").read_bytes().strip()


@NEEDS_PROC
def test_a_program_at_rest_and_one_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_sim.external.launcher.REST_LIMIT_S", 0.1)
    with program("print(flush=True); input()") as resting:
        seen = RunningProgram(resting.pid, [name_of(resting)])
        for _ in range(1000):
            if seen.settle():
                break
        assert seen.settle()
        assert not seen.stopped
        resting.send_signal(signal.SIGSTOP)
        while not seen.stopped:
            pass
        seen.close()
    with program("print(flush=True)\nwhile True: pass") as working:
        assert not RunningProgram(working.pid, [name_of(working)]).settle()
        assert RunningProgram(working.pid, [b"somebody else"]).settle()
    gone = RunningProgram(working.pid, [b"python"])
    assert not gone.settle()
    assert not gone.stopped


@NEEDS_PROC
def test_a_program_is_found_by_its_connection() -> None:
    code = (
        "import socket, sys\n"
        "s = socket.create_connection(('127.0.0.1', int(sys.stdin.readline())))\n"
        "print(flush=True); input()"
    )
    with closing(socket.create_server((LOOPBACK, 0))) as server:
        port = server.getsockname()[1]
        with subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as child:
            assert child.stdin is not None
            child.stdin.write(f"{port}\n".encode())
            child.stdin.flush()
            connection, address = server.accept()
            with connection:
                assert program_at(address[0], address[1], port) == child.pid
                # Another connection from the same port, and this process's own end, match no
                # program.
                assert program_at(address[0], address[1], port + 1) is None
                assert program_at(LOOPBACK, port, address[1]) is None
            child.kill()


def test_the_simulator_port_is_looked_at_too() -> None:
    port = SIMULATOR_PORT + INSTANCE
    with (
        closing(socket.create_server((LOOPBACK, port))),
        pytest.raises(UsageError, match=f"TCP port {port}, .* is taken"),
    ):
        check_free(INSTANCE)


# --- exit and stop


def launched(folder: Path, shell: str) -> Launcher:
    return Launcher(
        px4_airframe(load_vehicle("quad"), SITL_OUTPUT),
        partial(Px4Bridge, 0),
        30.0,
        program=lambda _: StartCommand(["/bin/sh", "-c", shell], {}),
        folders=WorkingFolders("px4", folder / "px4", folder / "log"),
    )


def test_what_ends_at_once_is_refused(tmp_path: Path) -> None:
    launcher = launched(tmp_path, "echo PX4 server already running for instance 0; exit 255")
    with (
        closing(launcher),
        pytest.raises(FirmwareMissingError, match=r"ended at once \(exit status 255\): PX4 server"),
    ):
        launcher.launch()


def test_what_is_killed_while_it_starts_is_lost(tmp_path: Path) -> None:
    launcher = launched(tmp_path, "kill -9 $$")
    with closing(launcher), pytest.raises(FirmwareLostError, match="PX4 ended"):
        launcher.launch()


@NEEDS_PROC
def test_a_stopped_px4_is_called_that() -> None:
    answer = Encoder().pack(
        dialect.MAVLink_hil_actuator_controls_message(EPOCH_US, [0.0] * 16, 129, 1)
    )
    code = (
        "import os, signal, socket, sys\n"
        "s = socket.create_connection(('127.0.0.1', int(sys.argv[1])))\n"
        "s.recv(1); s.sendall(bytes.fromhex(sys.argv[2]))\n"
        "os.kill(os.getpid(), signal.SIGSTOP)"
    )
    with closing(Px4Bridge(0, answer_s=60.0)) as bridge:
        words = [sys.executable, "-c", code, str(bridge.port), answer.hex()]
        with subprocess.Popen(words) as child:
            try:
                bridge.wait_connected(60.0, fine)
                plant = Plant(load_vehicle("quad"), None, np.random.default_rng(1), start_us=4000)
                sample = plant.sense()
                # The only answer; by then it has stopped itself, or is about to.
                while bridge.time_us == 0:
                    bridge.step(sample)
                with pytest.raises(FirmwareLostError, match=f"process {child.pid}, SIGSTOP"):
                    bridge.step(sample._replace(time_us=sample.time_us + TICK_US))
                plant.close()
            finally:
                child.kill()

"""Faults in flight: every fault has a defined outcome, and every process is cleaned up."""

from __future__ import annotations

import os
import random
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import WallClock
from airl_mav.core.errors import EXIT_INVALID
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Observation
from airl_mav.rehearsal.run_folder import load
from airl_mav.scenario.model import LimitSettings, PilotSettings, WatchdogSettings
from companion.frame_source import ZmqFrameSource
from companion.mavsdk_link import MavsdkLink
from companion.pilot import Mission, MissionResult, fly_mission
from companion.watchdog import ThreadGuard
from tests.support.ports import LOOPBACK, TestPorts, choose_ports, free_ports
from tests.support.processes import (
    HOLD,
    OFFBOARD,
    SITL,
    SITL_WITHOUT_REPORT,
    Ground,
    Running,
    ground_station,
    has_ended,
    is_running,
    running,
    wait_until,
    write_arena,
)

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("flight"), pytest.mark.timeout(300)]

SPEED = 3.0
LOSS_S = (1.0, 1.2)
"""Last setpoint to failsafe: COM_OF_LOSS_T, and 1.06 to 1.13 s as measured on PX4."""

FAR_M = 60.0


@pytest.fixture
def ground() -> Iterator[Ground]:
    with ground_station() as station:
        yield station


@contextmanager
def sitl(
    folder: Path,
    ports: TestPorts,
    *options: str,
    goal_m: float = FAR_M,
    speed: float = SPEED,
    program: Sequence[str] = SITL_WITHOUT_REPORT,
) -> Iterator[Running]:
    """airl-sitl in an empty corridor."""
    words = [
        *program,
        *("--arena", str(write_arena(folder, goal_m))),
        *("--speed", str(speed), "--altitude-m", "1.5", "--out", str(folder / "run")),
        *ports.options(),
        *options,
    ]
    with running(words, folder) as process:
        yield process


@contextmanager
def firmware(
    folder: Path, ports: TestPorts, *options: str, speed: float = SPEED, goal_m: float = FAR_M
) -> Iterator[Running]:
    """airl-firmware alone, with a MAVLink log."""
    words = [
        *("-m", "airl_mav.cli.firmware_command", "--arena", str(write_arena(folder, goal_m))),
        *("--speed", str(speed), "--tlog", str(folder / "flight.tlog"), *ports.options()),
        *options,
    ]
    with running(words, folder) as process:
        process.wait_for_text("Ctrl-C ends it")
        yield process


def companion_words(ports: TestPorts, *options: str, goal_m: float = FAR_M) -> list[str]:
    """The command line of airl-companion for `firmware`."""
    return [
        *("--connect", f"udpin://{LOOPBACK}:{ports.api}", "--goal", str(goal_m), "0"),
        *("--camera", f"tcp://{LOOPBACK}:{ports.camera}", "--speed", str(SPEED)),
        *("--altitude-m", "1.5", *options),
    ]


@contextmanager
def companion(folder: Path, ports: TestPorts, *options: str, **more: Any) -> Iterator[Running]:
    """airl-companion alone."""
    words = ["-m", "airl_mav.cli.companion_command", *companion_words(ports, *options, **more)]
    with running(words, folder) as process:
        yield process


def read_tlog(path: Path) -> list[tuple[float, Any]]:
    """Return (time [s], message) of a MAVLink log."""
    log = mavutil.mavlogfile(str(path))
    found = []
    while (message := log.recv_match()) is not None:
        found.append((message._timestamp, message))
    log.close()
    return found


def setpoints(log: list[tuple[float, Any]]) -> list[tuple[float, Any]]:
    """Return the setpoints that the vehicle received."""
    return [entry for entry in log if entry[1].get_type() == "SET_POSITION_TARGET_LOCAL_NED"]


def time_of_text(log: list[tuple[float, Any]], text: str) -> float:
    """Return the time of the autopilot's first message with a text [s]."""
    return next(t for t, m in log if m.get_type() == "STATUSTEXT" and text in m.text)


def loss_to_failsafe(log: list[tuple[float, Any]]) -> float:
    """Return the simulated time from the last setpoint to the failsafe [s]."""
    failsafe = time_of_text(log, "Failsafe activated")
    return failsafe - max(t for t, _ in setpoints(log) if t < failsafe)


def given_up_s(vehicle: Running) -> float:
    """Return the simulated time that a finished airl-firmware says it gave up [s]."""
    match = re.search(r"([\d.]+) s given up", vehicle.text())
    return 0.0 if match is None else float(match[1])


def modes(log: list[tuple[float, Any]]) -> list[int]:
    """Return the vehicle's flight modes in order."""
    found: list[int] = []
    for _, message in log:
        if message.get_type() == "HEARTBEAT" and message.autopilot == dialect.MAV_AUTOPILOT_PX4:
            found.append(message.custom_mode)
    return [mode for i, mode in enumerate(found) if i == 0 or found[i - 1] != mode]


def nothing_half_written(run: Path) -> None:
    """Fail when a run folder holds a file that was being written."""
    names = [path.name for path in run.iterdir()]
    assert not [n for n in names if n.startswith(".") or n.endswith((".partial", ".part"))], names


# --- a process dies


@pytest.mark.nightly  # As a rehearsal: test_process_faults.py.
def test_killed_companion_lets_the_failsafe_land(tmp_path: Path, ground: Ground) -> None:
    ports = choose_ports(ground.port)
    with firmware(tmp_path, ports) as vehicle:
        with companion(tmp_path, ports) as pilot:
            ground.wait_flying(2.0, vehicle, pilot)
            pilot.process.kill()
        wait_until(lambda: ground.heard("Failsafe activated"), "the failsafe")
        ground.wait_down()
        vehicle.process.terminate()
        assert vehicle.wait() == 0
    log = read_tlog(tmp_path / "flight.tlog")
    assert LOSS_S[0] <= loss_to_failsafe(log) <= LOSS_S[1]
    assert time_of_text(log, "Landing detected") > time_of_text(log, "Failsafe activated")
    assert max(height for _, _, height in ground.track) > 1.0
    assert ground.height < 0.3


@pytest.mark.nightly
def test_a_flight_that_loses_its_companion_is_flown_again(tmp_path: Path, ground: Ground) -> None:
    """Flights without their firmware are flown again in test_campaign_faults.py."""
    ports = choose_ports(ground.port)
    with sitl(tmp_path, ports, "--episodes", "1", goal_m=15.0) as run:
        children = run.find_children("firmware", "companion")
        ground.wait_flying(1.5, run)
        os.kill(children["companion"], signal.SIGKILL)
        run.wait_for_text(r"flight 000, seed 1 begins again: the companion died \(SIGKILL\)")
        for pid in children.values():
            wait_until(partial(has_ended, pid), "both to end")
        assert run.wait() == 0
        run.no_child_left()
    assert "Traceback" not in run.text()
    (episode,) = load(tmp_path / "run").episodes
    assert episode.outcome == "success"
    (note,) = episode.notes
    assert note.startswith("flown again: the companion died (SIGKILL)")
    # The vehicle first completes its failsafe without the companion.
    assert "Failsafe activated" in note and "Disarmed by landing" in note
    nothing_half_written(tmp_path / "run")


def test_killed_harness_leaves_nobody_behind(tmp_path: Path, ground: Ground) -> None:
    ports = choose_ports(ground.port)
    with sitl(tmp_path, ports) as run:
        run.find_children("firmware", "companion")
        ground.wait_flying(1.0, run)
        run.process.kill()
        run.process.wait()
        run.no_child_left()


# --- Ctrl-C


FEW_PICTURES = (
    "-c",
    """
from airl_mav.cli import main
from airl_mav.report import run_report
run_report.MAX_PICTURED = 0
main.sitl()
""",
    "--no-validity",
)
"""airl-sitl whose report has no picture of a single flight."""


@pytest.mark.nightly
def test_interrupted_flight(tmp_path: Path, ground: Ground) -> None:
    ports = choose_ports(ground.port)
    with sitl(
        tmp_path, ports, "--episodes", "3", goal_m=6.0, speed=4.0, program=FEW_PICTURES
    ) as run:
        run.find_children("firmware", "companion")
        run.wait_for_text("flight 000")
        ground.wait_flying(0.5, run)
        run.interrupt()
        assert run.wait(40.0) == 130
        run.no_child_left()
    text = run.text()
    assert f"interrupted: finished flights are kept; resume with --out {tmp_path / 'run'}" in text
    assert "Traceback" not in text
    # Verdict on the finished flights.
    assert "goals reached" in text
    folder = tmp_path / "run"
    assert len(load(folder).episodes) >= 1
    assert (folder / "report.html").stat().st_size > 10_000
    nothing_half_written(folder)


@pytest.mark.nightly
def test_terminated_flight(tmp_path: Path, ground: Ground) -> None:
    """SIGTERM, from a batch system or a service manager, is Ctrl-C."""
    with sitl(tmp_path, choose_ports(ground.port), program=SITL) as run:
        run.find_children("firmware", "companion")
        ground.wait_flying(1.0, run)
        run.process.terminate()
        assert run.wait(40.0) == 130
        run.no_child_left()
    assert "interrupted: finished flights are kept" in run.text()
    assert "no episode was finished" in run.text()
    assert "Traceback" not in run.text()
    nothing_half_written(tmp_path / "run")


@pytest.mark.nightly
def test_second_interrupt_kills_a_stopped_firmware(tmp_path: Path, ground: Ground) -> None:
    with sitl(tmp_path, choose_ports(ground.port)) as run:
        children = run.find_children("firmware", "companion")
        wait_until(lambda: ground.track, "telemetry")
        os.kill(children["firmware"], signal.SIGSTOP)
        run.interrupt()
        wait_until(lambda: not is_running(children["companion"]), "the companion to end")
        assert is_running(children["firmware"])
        run.interrupt()
        assert run.wait(4.0) == 130
        run.no_child_left()


# --- a policy hangs


class HangingPolicy:
    """Flies forward, then takes its time until it is let go."""

    def __init__(self, good_decisions: int) -> None:
        self.release = threading.Event()
        self.left = good_decisions

    def act(self, observation: Observation) -> Action:
        del observation
        if self.left == 0:
            self.release.wait(60.0)
        self.left -= 1
        return Action(1.0, 0.0, 0.0)


def fly_in_thread(ports: TestPorts, policy: Any) -> tuple[threading.Thread, list[MissionResult]]:
    """Fly a mission on a thread of this process, against a real airl-firmware."""
    results: list[MissionResult] = []

    def fly() -> None:
        clock, stop, abandon = WallClock(SPEED), threading.Event(), threading.Event()
        link = MavsdkLink(f"udpin://{LOOPBACK}:{ports.api}", clock, abandon)
        frames = ZmqFrameSource(f"tcp://{LOOPBACK}:{ports.camera}", clock)
        try:
            link.connect(20.0)
            watchdog = WatchdogSettings(decision_timeout_s=1.5, leave_after_s=1.0)
            pilot = PilotSettings(altitude_m=1.5)
            mission = Mission((FAR_M, 0.0), policy, pilot, watchdog, LimitSettings())
            results.append(
                fly_mission(
                    link, frames, mission, clock, stop, abandon, lambda _: None, ThreadGuard(clock)
                )
            )
        finally:
            frames.close()
            link.close()

    thread = threading.Thread(target=fly, name="mission", daemon=True)
    thread.start()
    return thread, results


@pytest.mark.nightly  # In lockstep: test_lockstep.py.
def test_hung_policy_is_stopped_then_leaves_offboard_then_lands(
    tmp_path: Path, ground: Ground
) -> None:
    ports = choose_ports(ground.port)
    policy = HangingPolicy(good_decisions=4)
    with firmware(tmp_path, ports) as vehicle:
        thread, results = fly_in_thread(ports, policy)
        ground.wait_flying(0.7, vehicle)
        wait_until(lambda: ground.mode == HOLD, "offboard to be left")
        wait_until(lambda: ground.speed < 0.3, "the vehicle to stand")
        assert thread.is_alive()
        assert ground.armed
        policy.release.set()
        ground.wait_down()
        thread.join(60.0)
        vehicle.process.terminate()
        assert vehicle.wait() == 0
    (result,) = results
    assert result.reason == "watchdog"
    assert len(result.notes) == 2
    assert "velocity zeroed (inference" in result.notes[0]
    assert "left offboard (inference" in result.notes[1]
    log = read_tlog(tmp_path / "flight.tlog")
    sent = setpoints(log)
    forward = [t for t, m in sent if m.vx > 0.5]
    # The last good command was flown until the watchdog's bound.
    first_of_last = result.log.columns()["sent_us"][-1]
    assert first_of_last > 0
    zeroed = next(t for t, m in sent if t > forward[-1] and m.vx == m.vy == m.vz == 0.0)
    left = next(
        t
        for t, m in log
        if m.get_type() == "COMMAND_LONG"
        and m.command == dialect.MAV_CMD_DO_SET_MODE
        and t > zeroed
    )
    # Three decisions held for 0.5 s each, the fourth until it is overdue. A busy host may have
    # skipped simulated time, or been slightly delayed.
    lost = given_up_s(vehicle)
    assert 3 * 0.5 + 1.5 - lost - 0.2 <= zeroed - forward[0] <= 3 * 0.5 + 1.5 + 1.5
    assert 1.0 - lost - 0.2 <= left - zeroed <= 1.0 + 1.0
    assert not [t for t, _ in sent if t > left + 0.5]
    assert time_of_text(log, "Landing at current position") > left
    assert time_of_text(log, "Disarmed by landing") > left
    with pytest.raises(StopIteration):
        time_of_text(log, "Failsafe activated")


HOG = """
import ctypes
from airl_mav.policy.actions import Action
from airl_mav.policy.registry import POLICIES, BuiltInPolicy

class Hog:
    def __init__(self, hold_s):
        self.left = 4
    def act(self, observation):
        self.left -= 1
        if self.left < 0:
            ctypes.PyDLL(None).sleep(300)  # C code that does not let go of the interpreter
        return Action(0.7, 0.0, 0.0)

POLICIES["hog"] = BuiltInPolicy("holds the interpreter", Hog)
from airl_mav.cli.main import companion
companion()
"""


@pytest.mark.nightly
def test_policy_that_holds_the_interpreter_ends_the_process(tmp_path: Path, ground: Ground) -> None:
    ports = choose_ports(ground.port)
    with firmware(tmp_path, ports) as vehicle:
        words = ["-c", HOG, *companion_words(ports, "--policy", "hog")]
        with running(words, tmp_path) as hog:
            ground.wait_flying(0.4, vehicle, hog)
            assert hog.wait() == 1
            # The last words name the culprit.
            assert "Timeout (0:00:05)!" in hog.text()
            assert " in act" in hog.text()
        wait_until(lambda: ground.heard("Failsafe activated"), "the failsafe")
        ground.wait_down()
        vehicle.process.terminate()
        assert vehicle.wait() == 0
    assert LOSS_S[0] <= loss_to_failsafe(read_tlog(tmp_path / "flight.tlog")) <= LOSS_S[1]


RAISER = """
from airl_mav.policy.actions import Action
from airl_mav.policy.registry import POLICIES, BuiltInPolicy

class Raiser:
    def __init__(self, hold_s):
        self.left = 3
    def act(self, observation):
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("out of ideas")
        return Action(0.7, 0.0, 0.0)

POLICIES["raiser"] = BuiltInPolicy("raises", Raiser)
from airl_mav.cli.main import companion
companion()
"""


@pytest.mark.nightly  # In lockstep: test_limit_flights.py, test_pilot_hands_over.py.
def test_policy_that_raises_lands(tmp_path: Path, ground: Ground) -> None:
    ports = choose_ports(ground.port)
    with firmware(tmp_path, ports) as vehicle:
        words = ["-c", RAISER, *companion_words(ports, "--policy", "raiser")]
        with running(words, tmp_path) as raiser:
            assert raiser.wait() == 1
            assert "policy failed: RuntimeError: out of ideas; 3 decisions" in raiser.text()
        assert ground.heard("Disarmed by landing")
        assert not ground.heard("Failsafe activated")
        vehicle.process.terminate()
        assert vehicle.wait() == 0


# --- a sensor or the link falls silent


@pytest.mark.nightly  # In lockstep: test_lockstep.py.
def test_silent_camera_is_named(tmp_path: Path, ground: Ground) -> None:
    """A relay of frames stops in flight."""
    ports = choose_ports(ground.port)
    _, (relay_port,) = free_ports(0, 1)
    silent = threading.Event()

    def relay() -> None:
        with zmq.Context() as context:
            source, sink = context.socket(zmq.SUB), context.socket(zmq.PUB)
            source.subscribe(b"")
            source.connect(f"tcp://{LOOPBACK}:{ports.camera}")
            sink.bind(f"tcp://{LOOPBACK}:{relay_port}")
            while not silent.is_set():
                if source.poll(50):
                    sink.send(source.recv())
            source.close(0)
            sink.close(0)

    thread = threading.Thread(target=relay, name="relay", daemon=True)
    thread.start()
    bounds = ("--decision-timeout-s", "1", "--leave-after-s", "0.5")
    camera = ("--camera", f"tcp://{LOOPBACK}:{relay_port}")
    try:
        with (
            firmware(tmp_path, ports) as vehicle,
            companion(tmp_path, ports, *camera, *bounds) as pilot,
        ):
            ground.wait_flying(1.5, vehicle, pilot)
            silent.set()
            assert pilot.wait() == 1
            text = pilot.text()
            assert "velocity zeroed (waiting for a frame" in text
            assert "left offboard (waiting for a frame" in text
            assert "camera silent; " in text
            assert ground.heard("Disarmed by landing")
    finally:
        silent.set()
        thread.join()


@pytest.mark.nightly  # In lockstep: test_limit_flights.py.
def test_killed_firmware_is_a_lost_link(tmp_path: Path, ground: Ground) -> None:
    ports = choose_ports(ground.port)
    with firmware(tmp_path, ports) as vehicle, companion(tmp_path, ports) as pilot:
        ground.wait_flying(1.0, vehicle, pilot)
        vehicle.process.kill()
        # MAVSDK misses heartbeats for 3 s; the switch to Hold is tried in vain.
        assert pilot.wait(20.0) == 1
        assert "link lost; " in pilot.text()
        assert "Traceback" not in pilot.text()


class UdpRelay:
    """A link that can be cut one way: the vehicle is no longer heard, but hears."""

    def __init__(self, vehicle_port: int, companion_port: int) -> None:
        self.deaf = threading.Event()
        """Set it to drop everything from the vehicle."""
        self._to = {"vehicle": (LOOPBACK, vehicle_port), "companion": (LOOPBACK, companion_port)}
        self._sockets = {
            side: socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for side in self._to
        }
        for each in self._sockets.values():
            each.bind((LOOPBACK, 0))
            each.settimeout(0.1)
        self.port: int = self._sockets["vehicle"].getsockname()[1]
        """Port that the vehicle sends to."""
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._carry, args=ends, daemon=True)
            for ends in (("vehicle", "companion"), ("companion", "vehicle"))
        ]
        for thread in self._threads:
            thread.start()

    def _carry(self, source: str, target: str) -> None:
        while not self._stop.is_set():
            try:
                data = self._sockets[source].recv(4096)
            except TimeoutError:
                continue
            if source == "vehicle" and self.deaf.is_set():
                continue
            self._sockets[target].sendto(data, self._to[target])

    def close(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        for each in self._sockets.values():
            each.close()


@pytest.mark.nightly  # In lockstep: test_limit_flights.py.
def test_link_lost_one_way_does_not_fly_on(tmp_path: Path, ground: Ground) -> None:
    """MAVSDK would repeat the last setpoint for ever to a vehicle that still hears it."""
    ports = choose_ports(ground.port)
    relay = UdpRelay(ports.api_local, ports.api)
    try:
        with (
            firmware(tmp_path, ports, "--api-port", str(relay.port)) as vehicle,
            companion(tmp_path, ports) as pilot,
        ):
            ground.wait_flying(1.5, vehicle, pilot)
            relay.deaf.set()
            assert pilot.wait(30.0) == 1
            assert "link lost; " in pilot.text()
            wait_until(lambda: ground.mode != OFFBOARD, "offboard to end")
            wait_until(lambda: ground.speed < 0.5, "the vehicle to stand")
            vehicle.process.terminate()
            assert vehicle.wait() == 0
    finally:
        relay.close()
    assert HOLD in modes(read_tlog(tmp_path / "flight.tlog"))[-2:]


ONCE = (
    "-c",
    """
from airl_mav.cli import main
from airl_mav.rehearsal import rehearsal
rehearsal.MAX_ATTEMPTS = 1
main.sitl()
""",
)
"""airl-sitl that flies nothing again."""


@pytest.mark.nightly
def test_stopped_firmware_gives_up_time_instead_of_racing(tmp_path: Path, ground: Ground) -> None:
    """1 s: long for the simulation, short for MAVSDK's heartbeats and the watchdog.

    The flight is invalid, and the run says so first; it would be flown again, were it not for ONCE.
    """
    stopped_s = 1.0
    ports = choose_ports(ground.port)
    # Watchdog and limits count simulated time: a second is three of it.
    patient = ("--decision-timeout-s", "6", "--leave-after-s", "6", "--limits.silence-s", "6")
    with sitl(tmp_path, ports, "--episodes", "1", *patient, goal_m=25.0, program=ONCE) as run:
        children = run.find_children("firmware", "companion")
        ground.wait_flying(1.5, run)
        before = ground.track[-1][0]
        os.kill(children["firmware"], signal.SIGSTOP)
        time.sleep(stopped_s)
        frozen = ground.track[-1][0]
        os.kill(children["firmware"], signal.SIGCONT)
        wait_until(lambda: ground.track[-1][0] > frozen, "time to go on")
        # The clock resumes from the same time and skips nothing. (This listener may have lagged
        # when the firmware was stopped.)
        assert frozen - before < 0.5e3 * SPEED * stopped_s
        assert next(t for t, _, _ in list(ground.track) if t > frozen) - frozen < 1000
        assert run.wait() == EXIT_INVALID
        run.no_child_left()
    done = load(tmp_path / "run")
    (episode,) = done.episodes
    assert episode.outcome == "success"
    assert any("of its simulated time was given up" in fault for fault in episode.invalid)
    said = [line for line in run.text().splitlines() if line.startswith("INVALID")]
    assert said[0].startswith("INVALID: flight 000")
    slipped_s = episode.slipped_us / 1e6
    assert slipped_s > 0.9 * SPEED * stopped_s
    assert "1 flight flown but invalid (1 reached the goal)." in run.text()
    # Stamps stay in order, on the simulator's clock.
    stamps = done.latency[0]
    names = ["decoded_us", "infer_start_us", "action_ready_us"]
    names += ["sent_us", "accepted_us", "motor_us"]
    rows = np.stack([stamps[name] for name in names])
    assert rows.min() > 0, "a decision without a stamp"
    assert np.all(np.diff(rows, axis=0) >= 0)
    assert np.all(np.diff(stamps["sent_us"]) > 0)
    # Actions were held by the companion's own clock: none for the length of the stop longer.
    assert np.max(stamps["held_until_us"] - stamps["sent_us"]) < 1e6 * SPEED * stopped_s
    assert np.diff(done.trajectories[0].time_us).max() <= 20_000


@pytest.mark.nightly
def test_long_stopped_firmware_ends_in_a_defined_way(tmp_path: Path, ground: Ground) -> None:
    """MAVSDK allows 3 s between heartbeats; the watchdog may act first. Flown again."""
    ports = choose_ports(ground.port)
    with sitl(tmp_path, ports, "--episodes", "1", goal_m=25.0) as run:
        children = run.find_children("firmware", "companion")
        ground.wait_flying(1.5, run)
        os.kill(children["firmware"], signal.SIGSTOP)
        time.sleep(3.0)
        os.kill(children["firmware"], signal.SIGCONT)
        code = run.wait()
        run.no_child_left()
    (episode,) = load(tmp_path / "run").episodes
    assert "Traceback" not in run.text()
    assert code == 0
    assert episode.outcome == "success"
    lost = r"flown again: firmware and companion lost each other \((link lost|camera silent)\)"
    assert re.fullmatch(lost, episode.notes[0])


# --- garbage on the wire


class Noise:
    """Throws random, cut and damaged frames at UDP ports."""

    def __init__(self, *ports: int) -> None:
        self.sent = 0
        self._ports = ports
        self._random = random.Random(7)
        self._mav = dialect.MAVLink(None, 255, 190)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="noise", daemon=True)
        self._thread.start()

    def _datagram(self) -> bytes:
        choose = self._random
        message: Any = choose.choice(
            [
                dialect.MAVLink_command_long_message(1, 1, 400, 0, 0, 21196, 0, 0, 0, 0, 0),
                dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_VEL_MAX", 0.1, 9),
                dialect.MAVLink_set_position_target_local_ned_message(
                    0, 1, 1, 1, 0x9C7, 0, 0, 0, -9, 9, 9, 0, 0, 0, 1, 0
                ),
            ]
        )
        frame = bytearray(message.pack(self._mav))
        kind = choose.randrange(3)
        if kind == 0:
            return choose.randbytes(choose.randrange(1, 600))
        if kind == 1:
            return bytes(frame[: choose.randrange(1, len(frame))])
        # One bit, except around the sequence number: the checksum must detect the change.
        at = choose.choice([5, 6, *range(10, len(frame))])
        frame[at] ^= 1 << choose.randrange(8)
        return bytes(frame)

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not self._stop.wait(0.002):
                for port in self._ports:
                    out.sendto(self._datagram(), (LOOPBACK, port))
                    self.sent += 1

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.mark.nightly
def test_malformed_bytes_do_not_disturb_a_flight(tmp_path: Path, ground: Ground) -> None:
    ports = choose_ports(ground.port)
    with firmware(tmp_path, ports, goal_m=12.0) as vehicle:
        noise = Noise(ports.api_local, ports.gcs_local, ports.api)
        try:
            with companion(tmp_path, ports, goal_m=12.0) as pilot:
                assert pilot.wait() == 0, pilot.text()
        finally:
            noise.close()
        assert "goal reached" in pilot.text()
        assert "watchdog" not in pilot.text()
        assert ground.heard("Disarmed by landing")
        assert not ground.heard("Failsafe")
        vehicle.process.terminate()
        assert vehicle.wait() == 0
    assert noise.sent > 1000
    for link in ("onboard", "gcs"):
        match = vehicle.wait_for_text(rf"{link} +received (\d+), malformed (\d+)")
        # Every datagram is bad, but cuts inside a frame's first bytes may hold no marker at all.
        assert int(match[2]) > 0.5 * noise.sent / 3


# --- ports are taken


@contextmanager
def occupied(kind: socket.SocketKind) -> Iterator[int]:
    """Hold a port."""
    with socket.socket(socket.AF_INET, kind) as held:
        held.bind((LOOPBACK, 0))
        if kind is socket.SOCK_STREAM:
            held.listen()
        yield held.getsockname()[1]


def told_in_one_line(run: Running, port: int, option: str) -> None:
    (error,) = [line for line in run.text().splitlines() if line.startswith("error:")]
    assert str(port) in error
    assert option in error
    assert "Traceback" not in run.text()


def test_a_taken_port_ends_a_firmware(tmp_path: Path) -> None:
    words = ["-m", "airl_mav.cli.firmware_command", *choose_ports().options()]
    with (
        occupied(socket.SOCK_STREAM) as port,
        running([*words, "--camera-port", str(port)], tmp_path) as vehicle,
    ):
        assert vehicle.wait(60.0) == 2
    told_in_one_line(vehicle, port, "--camera-port")


@pytest.mark.nightly  # The firmware alone: above. Messages of a child: test_child_processes.py.
@pytest.mark.parametrize(
    ("option", "kind"),
    [("--api-port", socket.SOCK_DGRAM), ("--camera-port", socket.SOCK_STREAM)],
)
def test_taken_port(tmp_path: Path, option: str, kind: socket.SocketKind) -> None:
    with occupied(kind) as port, sitl(tmp_path, choose_ports(), option, str(port)) as run:
        run.find_children("firmware", "companion")
        assert run.wait() == 2
        run.no_child_left()
    told_in_one_line(run, port, option)
    # The same command works once the port is free: nothing is in its way.
    assert not (tmp_path / "run").exists()


# --- Ctrl-C at the companion alone


@pytest.mark.nightly
def test_companion_interrupted_before_takeoff_stays_on_the_ground(
    tmp_path: Path, ground: Ground
) -> None:
    ports = choose_ports(ground.port)
    with firmware(tmp_path, ports), companion(tmp_path, ports) as pilot:
        pilot.wait_for_text("arming")
        pilot.interrupt()
        assert pilot.wait(30.0) == 130
        assert "stopped; 0 decisions" in pilot.text()
        assert max(height for _, _, height in ground.track) < 0.5


@pytest.mark.nightly
def test_companion_interrupted_in_flight_lands(tmp_path: Path, ground: Ground) -> None:
    ports = choose_ports(ground.port)
    with firmware(tmp_path, ports) as vehicle, companion(tmp_path, ports) as pilot:
        ground.wait_flying(1.0, vehicle, pilot)
        pilot.interrupt()
        assert pilot.wait() == 130
        assert "stopped; " in pilot.text()
        assert ground.heard("Disarmed by landing")
        assert not ground.heard("Failsafe")


@pytest.mark.nightly
def test_companion_interrupted_while_nobody_is_there(tmp_path: Path) -> None:
    with companion(tmp_path, choose_ports()) as pilot:
        pilot.wait_for_text("waiting for a flight controller on udpin://")
        pilot.interrupt()
        assert pilot.wait(20.0) == 130
        assert "error: stopped" in pilot.text()


def test_nobody_there(tmp_path: Path) -> None:
    with companion(tmp_path, choose_ports(), "--connect-timeout", "1") as pilot:
        assert pilot.wait(20.0) == 1
        assert "no flight controller heard on udpin://" in pilot.text()
        assert "Traceback" not in pilot.text()

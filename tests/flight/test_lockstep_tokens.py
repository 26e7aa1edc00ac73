"""Lockstep in two processes: the flight is identical to a flight in one process.

The reference is `flight.fly`, which flies MAVSDK on raw bytes in a thread: no sockets, no words.
"""

from __future__ import annotations

import os
import random
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as dialect

from airl_mav.addons.remote_lockstep.vehicle_side import RemoteStage
from airl_mav.core.frames import Goal
from airl_mav.core.signing import StoredSigning, write_key
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.scenario.resolve import ResolvedScenario
from airl_mav.scenario.stand_alone import StandAloneVehicle
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.plant.camera import CameraServer
from firmware_sim.simulation import EpisodeSetup
from firmware_sim.warm_up import warm_up
from tests.support.forged_frames import ForgedFrames
from tests.support.lockstep_kit import demo_scenario
from tests.support.ports import LOOPBACK, TestPorts, choose_ports
from tests.support.processes import ROOT, Running, running

pytestmark = [pytest.mark.xdist_group("tokens"), pytest.mark.timeout(300)]

SEED, ARENA = 1, "static-obstacles"
LANES = ("trajectory", "setpoints", "observations", "telemetry", "commands")
TOO_SHORT_S = 3.0
"""A time limit that no flight keeps."""


# --- the reference: one process


@dataclass(frozen=True)
class Reference:
    """A flight in one process."""

    lanes: dict[str, str]
    goal: Goal
    outcome: Outcome
    scenario: ResolvedScenario
    setup: EpisodeSetup


def fly_here(**changes: Any) -> Reference:
    resolved = demo_scenario(**({"arena": ARENA, "seed": SEED, "time_limit_s": 120.0} | changes))
    seed = resolved.scenario.seed
    flown = fly(resolved, resolved.fresh_policy(seed), 0, seed)
    lanes = {name: (flown.record.sha256 or {})[name] for name in LANES}
    episode = EpisodeSetup(resolved.vehicle, resolved.arena_of(seed), seed, resolved.scenario)
    return Reference(lanes, flown.record.goal, flown.record.outcome, resolved, episode)


@pytest.fixture(scope="module")
def reference() -> Reference:
    done = fly_here()
    assert done.outcome is Outcome.SUCCESS
    return done


# --- two processes


def firmware_words(ports: TestPorts, *options: str) -> list[str]:
    words = ["-m", "airl_mav.cli.firmware_command", "--lockstep", *ports.options()]
    return [*words, "--arena", ARENA, "--seed", str(SEED), *options]


def companion_words(api: int, camera: int, reference: Reference, *options: str) -> list[str]:
    north, east = reference.goal[:2]
    return [
        *("-m", "airl_mav.cli.companion_command", "--lockstep"),
        *(
            "--policy",
            reference.scenario.scenario.policy,
            "--seed",
            str(reference.scenario.scenario.seed),
        ),
        *("--connect", f"udpin://{LOOPBACK}:{api}", "--camera", f"tcp://{LOOPBACK}:{camera}"),
        *("--goal", repr(north), repr(east)),
        *("--goal-radius-m", repr(reference.scenario.companion_pilot.goal_radius_m), *options),
    ]


def radius(reference: Reference) -> tuple[str, str]:
    return "--goal-radius-m", repr(reference.scenario.pilot.goal_radius_m)


def lanes_in(*texts: str) -> dict[str, str]:
    pattern = rf"^({'|'.join(LANES)}) +([0-9a-f]{{64}})$"
    return dict(re.findall(pattern, "\n".join(texts), re.MULTILINE))


@contextmanager
def both(folder: Path, reference: Reference, *options: str) -> Iterator[tuple[Running, Running]]:
    """Run both commands."""
    ports = choose_ports()
    with (
        running(firmware_words(ports, *radius(reference), *options), folder) as firmware,
        running(companion_words(ports.api, ports.camera, reference), folder) as companion,
    ):
        yield firmware, companion


def finish(firmware: Running, companion: Running) -> dict[str, str]:
    """Wait for a good end and return all lanes."""
    assert companion.wait() == 0, companion.text() + firmware.text()
    assert firmware.wait() == 0, firmware.text()
    return lanes_in(firmware.text(), companion.text())


def test_same_flight_as_in_one_process(reference: Reference, tmp_path: Path) -> None:
    with both(tmp_path, reference) as (firmware, companion):
        lanes = finish(firmware, companion)
    assert lanes == reference.lanes
    assert "success" in firmware.text()


@contextmanager
def load(loops: int) -> Iterator[None]:
    """Keep cores busy."""
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(loops)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


@pytest.mark.nightly  # Undisturbed: above; with words that are lost: below.
@pytest.mark.slow
@pytest.mark.parametrize(("who", "loops"), [("firmware", 0), ("companion", 2)])
def test_stopped_and_loaded_processes_fly_the_same(
    who: str, loops: int, reference: Reference, tmp_path: Path
) -> None:
    rng = random.Random()  # the point in the flight is to be another one every time
    # Slow enough for the flight to last 1.9 s at least.
    with load(loops), both(tmp_path, reference, "--speed", "15.0") as (firmware, companion):
        firmware.wait_for_text("arming")
        time.sleep(rng.uniform(0.0, 1.5))
        pid = firmware.pid if who == "firmware" else companion.pid
        os.kill(pid, signal.SIGSTOP)
        hit = "done" not in firmware.text()
        time.sleep(2.0)
        os.kill(pid, signal.SIGCONT)
        assert finish(firmware, companion) == reference.lanes
    assert hit, "it was stopped after the flight"


# --- the vehicle's side in this process, the companion in another


@contextmanager
def staged(
    reference: Reference, stored: StoredSigning | None = None
) -> Iterator[tuple[RemoteStage, TestPorts]]:
    ports = choose_ports()
    endpoint = UdpEndpoint(
        (LOOPBACK, ports.api_local),
        (LOOPBACK, ports.api),
        local_option="local",
        remote_option="remote",
    )
    camera = CameraServer(f"tcp://{LOOPBACK}:{ports.camera}")
    asked = StandAloneVehicle(
        lockstep=True,
        goal_radius_m=reference.scenario.pilot.goal_radius_m,
        time_limit_s=reference.scenario.scenario.time_limit_s,
    )
    with (
        closing(endpoint),
        closing(camera),
        closing(RemoteStage(asked, endpoint, camera, stored=stored)) as stage,
    ):
        warm_up(reference.scenario.vehicle)
        stage.load(reference.setup, None)
        yield stage, ports


def fly_staged(stage: RemoteStage) -> dict[str, str]:
    while not stage.ended:
        stage.step()
    return stage.lanes()


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("changes", "outcome"),
    [
        ({"time_limit_s": TOO_SHORT_S}, Outcome.TIMEOUT),
        ({"arena": "crowded", "policy": "greedy", "seed": 10}, Outcome.COLLISION),
    ],
    ids=["land", "abandon"],
)
def test_orders_of_the_referee_arrive_in_their_turn(
    changes: dict[str, Any], outcome: Outcome, reference: Reference, tmp_path: Path
) -> None:
    """Flights that are called off, in the middle of an action."""
    successful, reference = reference, fly_here(**changes)
    assert reference.outcome is outcome
    with (
        staged(reference) as (stage, ports),
        running(companion_words(ports.api, ports.camera, reference), tmp_path) as companion,
    ):
        lanes = fly_staged(stage)
        assert companion.wait() == 1, companion.text()
    assert "stopped" in companion.text()
    assert lanes | lanes_in(companion.text()) == reference.lanes
    # The fingerprint distinguishes flights.
    assert all(reference.lanes[name] != successful.lanes[name] for name in LANES)


class Relay:
    """Passes datagrams on between simulator and companion, but for some words."""

    def __init__(self, near_port: int, far_port: int) -> None:
        self.dropped: Counter[str] = Counter()
        self.unsigned = 0
        """Datagrams that begin with a frame without a signature."""
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind((LOOPBACK, near_port))
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.bind((LOOPBACK, 0))
        self._companion = (LOOPBACK, far_port)
        self._vehicle: tuple[str, int] | None = None
        self._rng = random.Random(7)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            ready, _, _ = select.select([self._near, self._far], [], [], 0.1)
            if self._near in ready:
                data, self._vehicle = self._near.recvfrom(65_536)
                self._pass(data, self._far, self._companion)
            if self._far in ready:
                data = self._far.recv(65_536)
                if self._vehicle is not None:
                    self._pass(data, self._near, self._vehicle)

    def _pass(self, data: bytes, by: socket.socket, to: tuple[str, int]) -> None:
        if not self._lost(data):
            by.sendto(data, to)

    def _lost(self, data: bytes) -> bool:
        self.unsigned += not data[2] & 1
        text = data[11:-2] if int.from_bytes(data[7:10], "little") == 253 else b""
        word = re.match(rb"[FD](?=\d)", text)
        if word is None or self._rng.random() > 0.1:
            return False
        self.dropped[word[0].decode()] += 1
        return True

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._near.close()
        self._far.close()


class Attacker(Relay):
    """Sends forged, replayed and unsigned frames of all kinds around every datagram."""

    EACH = 4
    """Frames before a datagram, from the real sender's address; as many after it, from another."""

    def __init__(self, near_port: int, far_port: int) -> None:
        self.forged = ForgedFrames()
        self._stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        super().__init__(near_port, far_port)

    def close(self) -> None:
        super().close()
        self._stranger.close()

    def _pass(self, data: bytes, by: socket.socket, to: tuple[str, int]) -> None:
        # Few datagrams: a full socket buffer would lose telemetry, on which the flight depends.
        by.sendto(b"".join(self.forged.take(self.EACH)), to)
        by.sendto(data, to)
        self.forged.hear(data)
        self._stranger.sendto(b"".join(self.forged.take(self.EACH)), to)


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "key"
    write_key(path, bytes(range(1, 33)))
    return path


R = TypeVar("R", bound=Relay)


def fly_through(kind: type[R], reference: Reference, tmp_path: Path, key: Path) -> R:
    """Fly both programs, signed, through a relay; fail unless the flight is the reference's."""
    with staged(reference, StoredSigning(key)) as (stage, ports):
        far = choose_ports().api
        words = companion_words(far, ports.camera, reference, "--signing-key", str(key))
        with (
            closing(kind(ports.api, far)) as relay,
            running(words, tmp_path) as companion,
        ):
            lanes = fly_staged(stage)
            assert companion.wait() == 0, companion.text()
    assert lanes | lanes_in(companion.text()) == reference.lanes
    return relay


@pytest.mark.nightly
def test_neither_lost_words_nor_a_key_change_the_flight(
    reference: Reference, tmp_path: Path, key: Path
) -> None:
    """The reference is flown in one process, where there is no wire to sign."""
    relay = fly_through(Relay, reference, tmp_path, key)
    assert min(relay.dropped["F"], relay.dropped["D"]) >= 10, relay.dropped
    assert relay.unsigned == 0


@pytest.mark.nightly  # Frame by frame: test_mavlink_signing.py.
def test_forged_replayed_and_unsigned_frames_change_no_bit_of_the_flight(
    reference: Reference, tmp_path: Path, key: Path
) -> None:
    """The reference is flown without the attacker, and without a wire."""
    attacker = fly_through(Attacker, reference, tmp_path, key)
    sent = attacker.forged.sent
    assert sent.total() >= 10_000
    assert min(sent[how] for how in ("unsigned", "forged", "replayed")) >= 1000
    assert attacker.forged.kinds == set(dialect.mavlink_map)


@pytest.mark.nightly  # Refused: test_mavlink_signing.py.
def test_a_companion_without_the_key_can_be_interrupted(
    reference: Reference, tmp_path: Path, key: Path
) -> None:
    """MAVSDK waits for rejected answers; its commands time out after two seconds."""
    ports = choose_ports()
    with (
        running(firmware_words(ports, "--signing-key", str(key)), tmp_path) as firmware,
        running(companion_words(ports.api, ports.camera, reference), tmp_path) as companion,
    ):
        firmware.wait_for_text("frames refused")
        companion.process.send_signal(signal.SIGINT)
        assert companion.wait(30.0) != 0
    assert "Traceback" not in companion.text()


@pytest.mark.nightly
def test_companion_that_dies_ends_the_flight(
    reference: Reference, tmp_path: Path, key: Path
) -> None:
    keys = "--signing-key", str(key), "--camera-key", str(key)
    ports, signed = choose_ports(), keys
    words = firmware_words(ports, "--companion-timeout", "1", "--speed", "15.0", *signed)
    with (
        running(words, tmp_path) as firmware,
        running(
            companion_words(ports.api, ports.camera, reference, *signed), tmp_path
        ) as companion,
    ):
        firmware.wait_for_text("arming")
        companion.process.kill()
        assert firmware.wait() == 1
    last = firmware.text().splitlines()[-1]
    assert re.fullmatch(r"error: the companion is gone: .* turn \d+ in 1 s", last), firmware.text()
    assert "Traceback" not in firmware.text()


def test_simulator_that_dies_ends_the_companion(reference: Reference, tmp_path: Path) -> None:
    with staged(reference) as (stage, ports):
        words = companion_words(ports.api, ports.camera, reference, "--connect-timeout", "2")
        with running(words, tmp_path) as companion:
            while stage.time_us < 2_000_000:
                stage.step()
            assert companion.wait() == 1
    assert companion.text().splitlines()[-1] == "error: the flight controller gave no turn in 2 s"


def test_simulator_that_ends_tells_the_companion(reference: Reference, tmp_path: Path) -> None:
    with staged(reference) as (stage, ports):
        words = companion_words(ports.api, ports.camera, reference)
        with running(words, tmp_path) as companion:
            while stage.time_us < 2_000_000:
                stage.step()
            stage.close()
            assert companion.wait() == 1
    assert companion.text().splitlines()[-1] == "error: the flight controller has ended the flight"


# --- another language


@pytest.mark.nightly
def test_companion_of_the_documentation_flies_its_square(tmp_path: Path) -> None:
    """Nothing but pymavlink and a socket, as the documentation prints it; twice the same."""
    script = ROOT / "examples" / "lockstep_client.py"
    program = script.read_text(encoding="utf-8")
    assert not re.search(r"^(from|import) .*(airl_mav|mavsdk|companion)", program, re.MULTILINE)
    lanes = []
    for attempt in range(2):
        ports, tlog = choose_ports(), tmp_path / f"{attempt}.tlog"
        with (
            running([str(script), str(ports.api)], tmp_path) as square,
            running(firmware_words(ports, "--tlog", str(tlog)), tmp_path) as firmware,
        ):
            assert square.wait() == 0, square.text()
            assert firmware.wait() == 0, firmware.text()
        lanes.append(lanes_in(firmware.text()))
    assert set(lanes[0]) == set(LANES) - {"observations"}
    assert lanes[0] == lanes[1]
    assert "Disarmed by landing" in firmware.text()
    corners = _local_positions(tlog)
    # 4 s at 1 m/s a side, less what speeding up takes.
    assert corners.max(axis=0)[:2] == pytest.approx([4.0, 4.0], abs=0.5)
    assert corners.min(axis=0)[:2] == pytest.approx([0.0, 0.0], abs=0.5)
    assert corners[-1][:2] == pytest.approx([0.0, 0.0], abs=0.5)
    assert corners[:, 2].min() == pytest.approx(-2.4, abs=0.3)


def _local_positions(tlog: Path) -> np.ndarray:
    log = mavutil.mavlink_connection(str(tlog))
    rows = []
    while (message := log.recv_match(type="LOCAL_POSITION_NED")) is not None:
        rows.append((message.x, message.y, message.z))
    log.close()
    return np.array(rows)

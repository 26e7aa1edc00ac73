"""Flight logs over MAVLink: list, download, and streaming of the open log."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mavsdk.plugins.log_files import LogFiles
from mavsdk.plugins.log_streaming import LogStreaming
from pyulog import ULog

from firmware_sim.addons.flight_log.flight_log import UlogFlightLog
from firmware_sim.addons.ground_station_services.logs import NO_MESSAGE
from firmware_sim.engine.record import TRUE_TICK
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.telemetry import flown_of
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import (
    BOOT_UNIX_US,
    Rig,
    mavsdk_over_memory,
    wait_for,
)

WHOLE = 0xFFFF_FFFF
TARGET = (1, 1)


class LoggedAutopilot(KinematicAutopilot):
    """Logs what it flies into a folder, as the firmware does."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.log = UlogFlightLog(folder / "flight-007.ulg", self.parameters, 0, BOOT_UNIX_US)
        self.folder = self.logs = self.log.folder

    def step(self, _sample: Any = None, /) -> Any:
        super().step()
        sample = self.sample
        if sample is None or self.log.writer.closed:
            return
        estimate = self.state().estimate
        truths = np.zeros(1, TRUE_TICK)
        truths["time_us"], truths["charge"] = sample.time_us, 1.0
        truths["motion"][0, :3], truths["motion"][0, 3:6] = estimate.position, estimate.velocity
        truths["motion"][0, 6:10] = estimate.quaternion
        self.log.after_ticks(flown_of(self.state()), truths, self.state())


@pytest.fixture
def autopilot(tmp_path: Path) -> Iterator[LoggedAutopilot]:
    (tmp_path / "flight-003.ulg").write_bytes(bytes(range(256)) * 3)
    vehicle = LoggedAutopilot(tmp_path)
    yield vehicle
    vehicle.log.close()
    vehicle.folder.close()


@pytest.fixture
def rig(autopilot: LoggedAutopilot) -> Rig:
    return Rig(autopilot)


def download(rig: Rig, number: int, offset: int = 0, count: int = WHOLE) -> bytes:
    """Return what comes of a log, whose pieces must be in order."""
    rig.client.received()
    rig.client.send(dialect.MAVLink_log_request_data_message(*TARGET, number, offset, count))
    found, idle = b"", 0
    while idle < 3:
        rig.bench.tick()
        pieces = rig.client.received("LOG_DATA")
        idle = 0 if pieces else idle + 1
        for piece in pieces:
            assert (piece.id, piece.ofs) == (number, offset + len(found))
            found += bytes(piece.data[: piece.count])
    return found


def stream(rig: Rig, seconds: float, *, acknowledge: bool = True) -> list[Any]:
    """Return the pieces of a stream that come in some time."""
    pieces = []
    for _ in range(round(seconds * 250)):
        rig.bench.tick()
        for piece in rig.client.received("LOGGING_DATA", "LOGGING_DATA_ACKED"):
            pieces.append(piece)
            if acknowledge and piece.get_type() == "LOGGING_DATA_ACKED":
                rig.client.send(dialect.MAVLink_logging_ack_message(*TARGET, piece.sequence))
    return pieces


def test_logs_are_listed_oldest_first(rig: Rig, autopilot: LoggedAutopilot) -> None:
    rig.client.send(dialect.MAVLink_log_request_list_message(*TARGET, 0, 0xFFFF))
    rig.bench.run(0.1)
    old, current = rig.client.received("LOG_ENTRY")
    assert (old.id, old.num_logs, old.last_log_num, old.size) == (0, 2, 1, 768)
    assert (current.id, current.time_utc) == (1, BOOT_UNIX_US // 1_000_000)
    assert 4_000 < current.size <= autopilot.log.writer.size_bytes
    autopilot.log.close()
    rig.client.send(dialect.MAVLink_log_request_list_message(*TARGET, 1, 1))
    rig.bench.run(0.1)
    (complete,) = rig.client.received("LOG_ENTRY")
    assert (complete.id, complete.size) == (1, autopilot.log.writer.path.stat().st_size)


def test_a_vehicle_without_logs_says_so() -> None:
    rig = Rig()
    (entry,) = rig.exchange(dialect.MAVLink_log_request_list_message(*TARGET, 0, 0xFFFF))[:1]
    assert (entry.get_type(), entry.num_logs) == ("LOG_ENTRY", 0)
    rig.client.command(dialect.MAV_CMD_LOGGING_START, 0)
    rig.bench.tick()
    (ack,) = rig.client.received("COMMAND_ACK")
    assert ack.result == dialect.MAV_RESULT_FAILED


def test_a_log_is_downloaded_byte_by_byte(rig: Rig, tmp_path: Path) -> None:
    old = (tmp_path / "flight-003.ulg").read_bytes()
    assert download(rig, 0) == old
    assert download(rig, 0, 90, 180) == old[90:270]
    assert download(rig, 0, 760, 90) == old[760:]
    assert download(rig, 9) == b""


def test_the_log_that_is_written_is_downloaded(
    rig: Rig, autopilot: LoggedAutopilot, tmp_path: Path
) -> None:
    rig.bench.run(1.0)
    size = autopilot.log.writer.size_bytes
    part = download(rig, 1, 0, size)
    (tmp_path / "part.log").write_bytes(part)
    assert len(part) == size
    read = ULog(str(tmp_path / "part.log"))
    assert not read.file_corruption
    assert len(read.get_dataset("sensor_combined").data["timestamp"]) > 250


def test_a_log_that_is_removed_meanwhile_ends_there(rig: Rig, tmp_path: Path) -> None:
    old = tmp_path / "flight-003.ulg"
    old.write_bytes(bytes(10_000))
    rig.client.send(dialect.MAVLink_log_request_data_message(*TARGET, 0, 0, WHOLE))
    rig.bench.tick()
    old.unlink()
    (tmp_path / "flight-004.ulg").symlink_to("nowhere")
    rig.bench.run(0.1)
    assert rig.client.received("LOG_DATA")[-1].count == 0
    rig.client.send(dialect.MAVLink_log_request_list_message(*TARGET, 0, 0xFFFF))
    rig.bench.run(0.1)
    assert [entry.size for entry in rig.client.received("LOG_ENTRY")][:1] == [0]


def test_a_folder_is_looked_at_only_when_it_has_changed(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = Counter[Path]()
    glob = Path.glob
    monkeypatch.setattr(Path, "glob", lambda path, *w: looked.update([path]) or glob(path, *w))
    assert len(download(rig, 0)) == 768
    rig.client.send(dialect.MAVLink_log_request_list_message(*TARGET, 0, 0xFFFF))
    rig.bench.run(0.1)
    assert looked[tmp_path] == 1
    (tmp_path / "flight-001.ulg").write_bytes(b"another")
    assert download(rig, 0) == b"another"
    assert looked[tmp_path] == 2


def test_a_download_ends_on_request(rig: Rig) -> None:
    rig.client.send(dialect.MAVLink_log_request_data_message(*TARGET, 1, 0, WHOLE))
    rig.bench.tick()
    assert rig.client.received("LOG_DATA")
    rig.client.send(dialect.MAVLink_log_request_end_message(*TARGET))
    rig.bench.run(0.1)
    assert not rig.client.received("LOG_DATA")


def test_no_client_erases_logs(rig: Rig, tmp_path: Path) -> None:
    answers = rig.exchange(dialect.MAVLink_log_erase_message(*TARGET))
    assert [a.text for a in answers if a.get_type() == "STATUSTEXT"] == [
        "Logs are not erased: they belong to the run"
    ]
    assert (tmp_path / "flight-003.ulg").exists()


def test_a_stream_is_a_log_of_its_own(rig: Rig, tmp_path: Path) -> None:
    rig.bench.run(2.0)
    rig.client.command(dialect.MAV_CMD_LOGGING_START, 0)
    pieces = stream(rig, 4.0)
    assert [piece.sequence for piece in pieces] == list(range(len(pieces)))
    kinds = [piece.get_type() for piece in pieces]
    assert kinds == sorted(kinds, reverse=True), "the head, acknowledged, comes first"
    data = b"".join(bytes(piece.data[: piece.length]) for piece in pieces)
    path = tmp_path / "streamed.log"
    path.write_bytes(data)
    read = ULog(str(path))
    assert not read.file_corruption
    assert len(read.initial_parameters) == len(rig.autopilot.parameters)
    times = read.get_dataset("sensor_combined").data["timestamp"]
    assert len(times) > 200
    assert times[0] > 2_000_000, "what was flown before belongs to the download"
    # A client that misses a piece finds the next message by this.
    begins = message_places(data)
    at = 0
    for piece in pieces:
        inside = [place - at for place in begins if at <= place < at + piece.length]
        assert piece.first_message_offset == min(inside, default=NO_MESSAGE)
        at += piece.length
    rig.client.command(dialect.MAV_CMD_LOGGING_STOP)
    rig.bench.tick()
    rig.client.received()
    assert stream(rig, 0.2) == []


def message_places(data: bytes) -> set[int]:
    """Return where the messages of a ULog begin."""
    places, at = set(), 16
    while at < len(data):
        places.add(at)
        at += 3 + int.from_bytes(data[at : at + 2], "little")
    return places


def test_a_piece_that_nobody_acknowledges_comes_again_until_it_is_given_up(rig: Rig) -> None:
    rig.client.command(dialect.MAV_CMD_LOGGING_START, 0)
    pieces = stream(rig, 1.0, acknowledge=False)
    assert {piece.sequence for piece in pieces} == {0}
    assert 15 <= len(pieces) <= 20
    stream(rig, 3.0, acknowledge=False)
    assert stream(rig, 0.5, acknowledge=False) == []


@pytest.mark.slow
def test_mavsdk_downloads_and_streams(autopilot: LoggedAutopilot, tmp_path: Path) -> None:
    with mavsdk_over_memory(autopilot=autopilot) as (companion, _):
        files = companion.plugin(LogFiles)
        wait_for(lambda: len(autopilot.state().estimate.position) == 3)
        entries = files.get_entries()
        assert [entry.id for entry in entries] == [0, 1]
        old, path = tmp_path / "flight-003.ulg", tmp_path / "downloaded"
        files.download_log_file_async(entries[0], str(path), lambda *_: None)
        wait_for(lambda: path.exists() and path.stat().st_size == old.stat().st_size)
        assert path.read_bytes() == old.read_bytes()
        streaming = companion.plugin(LogStreaming)
        chunks: list[bytes] = []
        streaming.subscribe_log_streaming_raw(
            lambda raw, *_: chunks.append(base64.b64decode(raw.data_base64))
        )
        streaming.start_log_streaming()
        wait_for(lambda: len(chunks) > 200)
    streamed = tmp_path / "streamed"
    streamed.write_bytes(b"".join(chunks))
    assert ULog(str(streamed)).get_dataset("sensor_combined")

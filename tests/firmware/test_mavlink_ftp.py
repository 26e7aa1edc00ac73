"""MAVLink FTP: real MAVSDK, pymavlink's client, and hand-made requests to refuse."""

from __future__ import annotations

import errno
import json
import lzma
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from queue import Queue
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsdk.plugins.ftp import Ftp, FtpError, FtpResult
from pymavlink import mavftp, mavutil

from airl_mav.profiles.px4_release import px4_release
from firmware_sim.addons.ground_station_services.files import DATA_BYTES, Storage
from firmware_sim.addons.ground_station_services.ftp import BURST_MESSAGES
from firmware_sim.mavlink.codec import crc32part, dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint, UdpEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import Bench, Pacer, RawClient, mavsdk_over_memory

PATIENCE_S = 20.0
HEADER = struct.Struct("<HBBBBBxI")
TERMINATE, RESET, LIST, OPEN, READ, CREATE, WRITE, REMOVE = range(1, 9)
MAKE_FOLDER, REMOVE_FOLDER, OPEN_TO_WRITE, TRUNCATE, RENAME, CRC32, BURST = range(9, 16)
ACK, NAK = 128, 129
FAIL_ERRNO, INVALID_SIZE, INVALID_SESSION, NO_SESSIONS, END, UNKNOWN, EXISTS, PROTECTED, MISSING = (
    range(2, 11)
)


class Card:
    """Vehicle with a private folder, and a client that builds FTP requests by hand."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = MemoryEndpoint()
        self.autopilot = KinematicAutopilot()
        self.server = MavlinkServer(
            [onboard_link(self.endpoint)],
            self.autopilot,
            boot_unix_us=0,
        )
        self.server.vehicle_states[Storage] = Storage(folder)
        self.client = RawClient(self.endpoint)
        self.sequence = 0

    def close(self) -> None:
        self.server.close()

    def tick(self) -> None:
        self.server.receive(self.autopilot.time_us)
        self.autopilot.step()
        self.server.send(self.autopilot.time_us)

    def send(self, opcode: int, data: bytes = b"", *, offset: int = 0, **more: int) -> None:
        size, session = more.get("size", len(data)), more.get("session", 0)
        head = HEADER.pack(self.sequence, session, opcode, size, 0, 0, offset)
        body = list((head + data).ljust(251, b"\0"))
        self.client.send(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, body))

    def answers(self) -> list[tuple[int, int, bytes]]:
        found = []
        for message in self.client.received():
            if message.get_type() == "FILE_TRANSFER_PROTOCOL":
                body = bytes(message.payload)
                sequence, _, kind, size, _, _, _ = HEADER.unpack_from(body)
                found.append((sequence, kind, body[HEADER.size :][:size]))
        return found

    def ask(self, opcode: int, data: bytes = b"", **more: int) -> tuple[int, bytes]:
        """Return the kind of the answer and its data."""
        self.send(opcode, data, **more)
        self.tick()
        ((sequence, kind, found),) = self.answers()
        assert sequence == self.sequence + 1
        self.sequence += 1
        return kind, found


@pytest.fixture
def card(tmp_path: Path) -> Iterator[Card]:
    folder = tmp_path / "card"
    folder.mkdir()
    (tmp_path / "secret.txt").write_text("secret")
    with closing(Card(folder)) as card:
        yield card


def nak(code: int) -> tuple[int, bytes]:
    return NAK, bytes([code])


def transferred(start: Any, *words: Any) -> FtpResult:
    """Return the final result of a MAVSDK transfer."""
    done: Queue[FtpResult] = Queue()
    start(*words, lambda result, _progress, _data: done.put(result))
    while (result := done.get(timeout=PATIENCE_S)) is FtpResult.NEXT:
        pass
    return result


def refusal(call: Any, *words: Any) -> str:
    with pytest.raises(FtpError) as caught:
        call(*words)
    return str(caught.value)


def names(found: Any) -> list[str]:
    return sorted(str(entry.name) for entry in found.entries)


def test_mavsdk_does_all_that_it_does_on_a_real_px4(tmp_path: Path) -> None:
    text = bytes(range(256)) * 40
    (tmp_path / "up.txt").write_bytes(text)
    with mavsdk_over_memory() as (companion, _):
        ftp = companion.plugin(Ftp)
        assert "FILE_DOES_NOT_EXIST" in refusal(ftp.list_directory, "/no/such/dir")
        ftp.create_directory("airl_t")
        assert names(ftp.list_directory("airl_t")) == []
        up = str(tmp_path / "up.txt")
        assert transferred(ftp.upload_async, up, "airl_t") is FtpResult.SUCCESS
        assert ftp.are_files_identical(up, "airl_t/up.txt")
        ftp.rename("airl_t/up.txt", "airl_t/up2.txt")
        assert names(ftp.list_directory("airl_t")) == ["up2.txt"]
        for burst in (False, True):
            got = tmp_path / f"burst {burst}"
            got.mkdir()
            result = transferred(ftp.download_async, "airl_t/up2.txt", str(got), burst)
            assert result is FtpResult.SUCCESS
            assert (got / "up2.txt").read_bytes() == text
        missing = transferred(ftp.download_async, "airl_t/none", str(tmp_path), False)
        assert missing is FtpResult.FILE_DOES_NOT_EXIST
        ftp.remove_file("airl_t/up2.txt")
        ftp.remove_directory("airl_t")
        assert names(ftp.list_directory("/")) == names(ftp.list_directory(".")) == ["etc"]


def test_pymavlinks_client_puts_and_gets(tmp_path: Path) -> None:
    text = b"0123456789" * 500
    (tmp_path / "a.bin").write_bytes(text)
    remote = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=255)
    there = remote.port.getsockname()
    endpoint = UdpEndpoint(("127.0.0.1", 0), there, local_option="local", remote_option="remote")
    pacer = Pacer(Bench(endpoint))
    with closing(remote), closing(endpoint):
        pacer.start()
        remote.wait_heartbeat(timeout=PATIENCE_S)
        client = mavftp.MAVFTP(remote, 1, 1)
        assert client.cmd_put([str(tmp_path / "a.bin"), "/a.bin"]).error_code == 0
        client.process_ftp_reply("CreateFile", timeout=PATIENCE_S)
        assert client.cmd_get(["/a.bin", str(tmp_path / "b.bin")]).error_code == 0
        client.process_ftp_reply("OpenFileRO", timeout=PATIENCE_S)
        pacer.stop()
    assert (tmp_path / "b.bin").read_bytes() == text


def test_the_component_metadata_describes_every_parameter(card: Card) -> None:
    def fetched(uri: str) -> bytes:
        name = uri.removeprefix("mftp://").encode()
        kind, size = card.ask(OPEN, name)
        assert kind == ACK
        data = b""
        while len(data) < struct.unpack("<I", size)[0]:
            data += card.ask(READ, offset=len(data), size=DATA_BYTES)[1]
        card.ask(TERMINATE)
        return data

    card.client.command(512, dialect.MAVLINK_MSG_ID_COMPONENT_METADATA)
    card.client.command(512, dialect.MAVLINK_MSG_ID_COMPONENT_INFORMATION)
    card.tick()
    heard = {m.get_type(): m for m in card.client.received()}
    metadata, older = heard["COMPONENT_METADATA"], heard["COMPONENT_INFORMATION"]
    assert metadata.uri == older.general_metadata_uri
    general = fetched(metadata.uri)
    assert crc32part(general) == metadata.file_crc == older.general_metadata_file_crc
    entries = {e["type"]: e for e in json.loads(lzma.decompress(general))["metadataTypes"]}
    entry = entries[dialect.COMP_METADATA_TYPE_PARAMETER]
    parameters = fetched(entry["uri"])
    assert crc32part(parameters) == entry["fileCrc"]
    of_events = entries[dialect.COMP_METADATA_TYPE_EVENTS]
    assert crc32part(fetched(of_events["uri"])) == of_events["fileCrc"]
    described = {p["name"]: p for p in json.loads(lzma.decompress(parameters))["parameters"]}
    assert described.keys() == {spec.name for spec in px4_release().specs}
    assert described["MPC_XY_VEL_MAX"] | {"shortDesc": ""} == {
        "name": "MPC_XY_VEL_MAX", "type": "Float", "default": 12.0, "min": 0.0, "max": 20.0,
        "units": "m/s", "group": "MPC", "shortDesc": "",
    }  # fmt: skip


OUTSIDE = (b"../secret.txt", b"/../secret.txt", b"a/../../secret.txt", b"link", b"dir/secret.txt")


@pytest.mark.parametrize("name", OUTSIDE, ids=bytes.decode)
def test_nobody_gets_out_of_the_folder(card: Card, name: bytes) -> None:
    secret = card.folder.parent / "secret.txt"
    (card.folder / "link").symlink_to(secret)
    (card.folder / "dir").symlink_to(card.folder.parent)
    (card.folder / "own").write_text("own")
    requests = (OPEN, CREATE, OPEN_TO_WRITE, REMOVE, MAKE_FOLDER, REMOVE_FOLDER, TRUNCATE, CRC32)
    for opcode in (*requests, LIST):
        assert card.ask(opcode, name) == nak(PROTECTED), opcode
    for pair in (name + b"\0new", b"own\0" + name):
        assert card.ask(RENAME, pair) == nak(PROTECTED)
    assert secret.read_text() == "secret"
    assert sorted(p.name for p in card.folder.parent.iterdir()) == ["card", "secret.txt"]


def test_an_absolute_path_begins_at_the_folder(card: Card) -> None:
    assert card.ask(OPEN, b"/etc/passwd") == nak(MISSING)
    assert card.ask(CREATE, b"/tmp.txt")[0] == ACK
    assert (card.folder / "tmp.txt").exists()


def test_the_vehicles_own_files_cannot_be_changed(card: Card) -> None:
    name = b"/etc/extras/parameters.json.xz"
    for opcode in (CREATE, OPEN_TO_WRITE, REMOVE, TRUNCATE):
        assert card.ask(opcode, name) == nak(PROTECTED)
    assert card.ask(RENAME, name + b"\0mine") == nak(PROTECTED)
    assert card.ask(REMOVE_FOLDER, b"/") == nak(PROTECTED)
    assert card.ask(OPEN, name)[0] == ACK


def test_refusals_have_px4s_codes(card: Card) -> None:
    (card.folder / "a").write_bytes(b"abc")
    (card.folder / "d").mkdir()
    (card.folder / "d" / "b").write_bytes(b"")
    assert card.ask(99) == nak(UNKNOWN)
    assert card.ask(16, b"/") == nak(UNKNOWN)
    assert card.ask(READ, size=5) == nak(INVALID_SESSION)
    assert card.ask(BURST, size=5) == nak(INVALID_SESSION)
    assert card.ask(TERMINATE) == nak(INVALID_SESSION)
    assert card.ask(MAKE_FOLDER, b"d") == nak(EXISTS)
    assert card.ask(REMOVE, b"none") == nak(MISSING)
    assert card.ask(REMOVE_FOLDER, b"d") == (NAK, bytes([FAIL_ERRNO, errno.ENOTEMPTY]))
    assert card.ask(RENAME, b"a") == (NAK, bytes([FAIL_ERRNO, errno.EINVAL]))
    assert card.ask(OPEN, b"d") == (NAK, bytes([FAIL_ERRNO, errno.EISDIR]))
    assert card.ask(LIST, b"d", size=240) == nak(INVALID_SIZE)
    assert card.ask(LIST, b"d", offset=1) == nak(END)
    assert card.ask(OPEN, b"a") == (ACK, struct.pack("<I", 3))
    assert card.ask(OPEN, b"a") == nak(NO_SESSIONS)
    assert card.ask(READ, offset=1, size=99) == (ACK, b"bc")
    assert card.ask(READ, offset=3, size=99) == nak(END)
    assert card.ask(READ, session=1, size=9) == nak(INVALID_SESSION)
    assert card.ask(RESET) == (ACK, b"")
    assert card.ask(CRC32, b"a") == (ACK, struct.pack("<I", crc32part(b"abc")))
    assert card.ask(TRUNCATE, b"a", offset=1) == (ACK, b"")
    assert (card.folder / "a").read_bytes() == b"a"


def test_the_session_number_comes_back_but_for_the_one_that_was_opened(card: Card) -> None:
    # As in PX4: MAVProxy numbers its sessions, and rejects answers with another number.
    (card.folder / "a").write_bytes(b"text")

    def session_of(opcode: int, data: bytes) -> tuple[int, int]:
        card.sequence += 1
        card.send(opcode, data, session=101)
        card.tick()
        (message,) = card.client.received("FILE_TRANSFER_PROTOCOL")
        return message.payload[3], message.payload[2]

    assert session_of(LIST, b"/") == (ACK, 101)
    assert session_of(OPEN, b"@PARAM/param.pck") == (NAK, 101)
    assert session_of(CRC32, b"a") == (ACK, 101)
    assert session_of(OPEN, b"a") == (ACK, 0)


def test_a_lost_answer_is_sent_again_and_nothing_done_twice(card: Card) -> None:
    assert card.ask(MAKE_FOLDER, b"d") == (ACK, b"")
    card.sequence -= 1
    assert card.ask(MAKE_FOLDER, b"d") == (ACK, b"")
    assert card.ask(MAKE_FOLDER, b"d") == nak(EXISTS)


def test_a_burst_is_paced_and_ends_at_the_end(card: Card) -> None:
    text = bytes(range(256)) * 20
    (card.folder / "a").write_bytes(text)
    card.ask(OPEN, b"a")
    card.send(BURST, offset=100, size=DATA_BYTES)
    found, per_tick = [], []
    for _ in range(10):
        card.tick()
        new = card.answers()
        per_tick.append(len(new))
        found += new
    assert b"".join(data for _, kind, data in found if kind == ACK) == text[100:]
    assert found[-1][1:] == nak(END)
    assert [sequence for sequence, _, _ in found] == list(range(2, 2 + len(found)))
    assert max(per_tick) <= BURST_MESSAGES


def test_nobody_fills_the_disk(card: Card, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_sim.addons.ground_station_services.files.GREATEST_BYTES", 400_000)
    card.ask(LIST, b"/")
    assert card.ask(CREATE, b"big")[0] == ACK
    assert card.ask(WRITE, b"x", offset=1_000_000) == (NAK, bytes([FAIL_ERRNO, errno.ENOSPC]))
    assert card.ask(WRITE, b"x", offset=2**32 - 1) == (NAK, bytes([FAIL_ERRNO, errno.ENOSPC]))
    assert card.ask(TRUNCATE, b"big", offset=1_000_000)[1][1] == errno.ENOSPC
    assert card.ask(WRITE, b"x", offset=1_000)[0] == ACK
    assert (card.folder / "big").stat().st_size == 1_001


@given(st.binary(min_size=0, max_size=251))
def test_no_request_raises_or_gets_out(body: bytes) -> None:
    with TemporaryDirectory() as folder:
        (Path(folder) / "card").mkdir()
        with closing(Card(Path(folder) / "card")) as card:
            for opcode in (None, *range(17)):
                raw = bytearray(body.ljust(251, b"\0"))
                if opcode is not None:
                    raw[3] = opcode
                card.client.send(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(raw)))
                card.tick()
        assert [p.name for p in Path(folder).iterdir()] == ["card"]

"""Unauthenticated clients, remote and local: limits on access, storage, floods and spoofing."""

from __future__ import annotations

import os
import struct
import zlib
from itertools import count
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.signing import StoredSigning
from firmware_sim.addons.ground_station_services.files import Storage
from firmware_sim.addons.ground_station_services.ftp import FtpClient
from firmware_sim.autopilot.autopilot_state import Arming
from firmware_sim.mavlink import clients, codec, server, traffic
from firmware_sim.mavlink.codec import Decoder, WireMessage
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.traffic import TlogWriter
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import BOOT_UNIX_US, RawClient, Rig, text_of
from tests.support.memory_hub import MemoryHub

KEY = bytes(range(7, 39))
NOW = (BOOT_UNIX_US - 1_420_070_400_000_000) // 10
HEARTBEAT = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)


class Field:
    """A vehicle with a ground link that anybody can reach, and perhaps a key."""

    def __init__(
        self,
        *,
        clock: SimClock | None = None,
        signing: StoredSigning | None = None,
        storage: Storage | None = None,
    ) -> None:
        self.hub = MemoryHub()
        self.autopilot = KinematicAutopilot()
        self.server = server.MavlinkServer(
            [gcs_link(self.hub), onboard_link(MemoryEndpoint())],
            self.autopilot,
            boot_unix_us=BOOT_UNIX_US,
            clock=clock,
            signing=signing,
        )
        if storage is not None:
            self.server.vehicle_states[Storage] = storage
        self.run(50)

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self.server.receive(self.autopilot.time_us)
            self.autopilot.step()
            self.server.send(self.autopilot.time_us)

    def clients(self) -> int:
        """Return how many clients the ground link has, beside the preset one."""
        return len(list(self.server._links[0])) - 1


def signing(client: RawClient) -> RawClient:
    """Let a client sign what it sends."""
    client.mav.signing.secret_key = KEY
    client.mav.signing.timestamp = NOW + 10_000
    client.mav.signing.link_id = 9
    client.mav.signing.sign_outgoing = True
    return client


def test_with_a_key_no_unsigned_heartbeat_makes_a_client() -> None:
    # One datagram with a false address would send that address telemetry for ten minutes.
    field = Field()
    field.server._signing.change(KEY, NOW)
    for port in range(100):
        field.hub.client(port).send(HEARTBEAT)
        field.run(1)
    assert field.clients() == 0
    assert not field.hub.lane(("127.0.0.1", 7)).outbox
    signing(field.hub.client(7)).send(HEARTBEAT)
    field.run(1)
    assert field.clients() == 1
    assert field.hub.lane(("127.0.0.1", 7)).outbox


def test_who_is_refused_or_turned_away_is_told_now_and_then() -> None:
    field = Field()
    operator = signing(field.hub.client(None))
    field.server._signing.change(KEY, NOW)
    field.run(300)
    operator.endpoint.take()
    stranger = field.hub.client(7)
    for _ in range(2_000):
        stranger.command(400, 1)
        field.run(1)
    assert field.autopilot.arming is Arming.STANDBY
    operator.mav.signing.secret_key = None
    texts = [text for _, text in text_of(operator.received("STATUSTEXT"))]
    assert 1 <= len(texts) <= 2
    assert all("frames refused: bad signature" in text for text in texts)


def test_the_operator_hears_who_has_set_a_key() -> None:
    rig = Rig()
    rig.client.send(dialect.MAVLink_setup_signing_message(1, 1, list(KEY), NOW))
    rig.bench.tick()
    rig.client.mav.signing.secret_key = None
    texts = [text for _, text in text_of(rig.client.received("STATUSTEXT"))]
    assert texts == ["Signing key set by system 245 component 190"]


def test_one_datagram_full_of_commands_takes_no_more_than_its_part_of_a_tick(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = SimClock()
    field = Field(clock=clock)
    clock.advance(10 * US_PER_S)  # each tick is late: there is no idle time
    client = field.hub.client(7)
    dispatch = server.MavlinkServer._dispatch

    def slow(this: server.MavlinkServer, sender: clients.Client, message: WireMessage) -> bool:
        clock.advance(clients.LISTEN_US // 10)
        return dispatch(this, sender, message)

    monkeypatch.setattr(server.MavlinkServer, "_dispatch", slow)
    frames = [client.pack(dialect.MAVLink_ping_message(0, n, 0, 0)) for n in range(40)]
    client.endpoint.inbox.append(b"".join(frames))
    answered: list[int] = []
    for _ in range(5):
        field.run(1)
        pings = [m.seq for m in client.received("PING") if m.target_system]
        assert len(pings) <= 11
        answered += pings
    assert answered == list(range(40))


@pytest.mark.parametrize(
    "pattern", [b"\xfe", b"\xfd\x01\x00\x00\x00", b"\xfe\x00\x00\x01\x01\x00"], ids=bytes.hex
)
def test_a_datagram_that_seems_to_begin_everywhere_is_given_up(
    pattern: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder = Decoder(datagrams=True)
    tried = count()
    decode = Decoder._decode
    monkeypatch.setattr(Decoder, "_decode", lambda *words: (next(tried), decode(*words))[1])
    assert decoder.feed(pattern * (4_096 // len(pattern))) == []
    assert next(tried) <= codec.MOST_DAMAGED + 1
    assert decoder.malformed == 1
    good = RawClient(MemoryEndpoint()).pack(HEARTBEAT)
    assert [m.get_type() for m in decoder.feed(good)] == ["HEARTBEAT"]


def test_nobody_floods_all_others_with_texts() -> None:
    field = Field()
    others = [field.hub.client(port, (100 + port, 190)) for port in range(20)]
    for client in others:
        client.send(HEARTBEAT)
    field.run(1)
    for client in others:
        client.endpoint.take()
    for _ in range(300):
        others[0].send(dialect.MAVLink_log_erase_message(1, 1))
        others[0].command(400, 7.0)
    field.run(1)
    texts = [text for _, text in text_of(others[1].received("STATUSTEXT"))]
    assert texts == [
        "Logs are not erased: they belong to the run",
        "Unsupported ARM_DISARM param: 7.000",
    ]


def test_nobody_drowns_what_everybody_should_know_in_texts() -> None:
    """Refusals of one client, each another one, for 10 s: events keep their place among them."""
    field = Field()
    client, other = field.hub.client(1, (101, 190)), field.hub.client(2, (102, 190))
    other.send(HEARTBEAT)
    for tick in range(2500):
        client.command(400, 2.0 + tick / 8.0)
        field.run(1)
    heard = other.received("STATUSTEXT", "EVENT")
    said = [m for m in heard if m.get_type() == "STATUSTEXT"]
    assert len(said) == len(heard) - len(said)
    assert server.TEXTS_BURST <= len(said) <= server.TEXTS_BURST + 10 * server.TEXTS_PER_S + 1
    acknowledged = client.received("COMMAND_ACK")
    assert acknowledged == []  # PX4 acknowledges none of these


def test_absurd_rates_leave_everybody_a_share() -> None:
    field = Field()
    modest = field.hub.client(1, (101, 190))
    greedy = [field.hub.client(port, (200, port)) for port in range(2, 32)]
    for client in (modest, *greedy):
        client.send(HEARTBEAT)
    field.run(1)
    names = list(next(iter(field.server._links[0])).link.builders)
    for client in greedy:
        client.send(dialect.MAVLink_request_data_stream_message(1, 1, 0, 0xFFFF, 1))
        for name in names:
            client.command(511, getattr(codec.dialect, f"MAVLINK_MSG_ID_{name}"), 1.0)
    field.run(20)
    lanes = [client.endpoint for client in (modest, *greedy)]
    for lane in lanes:
        lane.outbox.clear()
    kinds: list[int] = []
    greediest = 0
    for _ in range(500):
        field.run(1)
        in_tick = [lane.take() for lane in lanes]
        assert sum(map(len, in_tick)) <= server.STREAMS_PER_TICK
        kinds += [int.from_bytes(frame[7:10], "little") for frame in in_tick[0]]
        greediest += len(in_tick[1])
    assert kinds.count(dialect.MAVLINK_MSG_ID_HEARTBEAT) == 2
    assert kinds.count(dialect.MAVLINK_MSG_ID_ATTITUDE) >= 98  # 50 Hz for two seconds
    assert greediest > len(kinds)


def test_who_pretends_to_be_the_vehicle_is_heard_by_nobody() -> None:
    field = Field()
    false, other = field.hub.client(1, (1, 1)), field.hub.client(2, (255, 190))
    other.send(HEARTBEAT)
    field.run(1)
    other.endpoint.take()
    false.send(dialect.MAVLink_command_ack_message(22, 0, 0, 0, 255, 190))
    false.command(400, 1)
    field.run(1)
    assert not other.received("COMMAND_ACK", "COMMAND_LONG")
    assert field.autopilot.arming is Arming.STANDBY


def test_strangers_fill_no_disk_with_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traffic, "MAX_BYTES", 5_000)
    field = Field()
    main = TlogWriter(tmp_path / "flight-001.tlog", 0)
    field.server.log_to(main, "gcs")
    for port in range(40):
        field.hub.client(port).send(HEARTBEAT)
    field.run(500)
    field.server.log_to(None, "gcs")
    main.close()
    logs = sorted(tmp_path.glob("flight-001.*.tlog"))
    assert len(logs) == traffic.MAX_LOGS
    assert max(path.stat().st_size for path in logs) < 6_000
    assert (tmp_path / "flight-001.tlog").stat().st_size > 20_000


def ftp(client: RawClient, sequence: int, opcode: int, name: bytes) -> None:
    head = struct.pack("<HBBBBBxI", sequence, 0, opcode, len(name), 0, 0, 0)
    body = list((head + name).ljust(251, b"\0"))
    client.send(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, body))


def test_a_checksum_of_a_large_file_takes_several_ticks(tmp_path: Path) -> None:
    field = Field(storage=Storage(tmp_path))
    data = os.urandom(300_000)
    (tmp_path / "large").write_bytes(data)
    client = field.hub.client(7)
    answers = []
    for tick in range(8):
        if tick in (0, 2):  # repeated by an impatient client
            ftp(client, 5, 14, b"large")
        field.run(1)
        answers += [(tick, bytes(m.payload)) for m in client.received("FILE_TRANSFER_PROTOCOL")]
    ((tick, body),) = answers
    assert tick == 3  # five pieces, the first two in the first tick
    (crc,) = struct.unpack_from("<I", body, 12)
    assert crc == zlib.crc32(data, 0xFFFF_FFFF) ^ 0xFFFF_FFFF
    ftp(client, 6, 14, b"large")
    field.run(1)
    ftp(client, 7, 3, b"/")  # another request: the checksum is cancelled
    field.run(20)
    sequences = [bytes(m.payload)[:2] for m in client.received("FILE_TRANSFER_PROTOCOL")]
    assert sequences == [b"\x08\0"]


def test_sessions_end_with_their_clients(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x")
    field = Field(storage=Storage(tmp_path))
    for port in range(clients.MAX_CLIENTS):
        ftp(field.hub.client(port), 1, 4, b"file")
    field.run(1)
    links = field.server._links[0]
    contexts = [client.context for client in links if client.context is not None]
    sessions = [context.state(FtpClient).session for context in contexts]
    files = [session.file for session in sessions if session.file is not None]
    assert len(files) == clients.MAX_CLIENTS
    links.forget_silent(field.autopilot.time_us + clients.SILENT_US + US_PER_S)
    assert field.clients() == 0
    assert all(file.closed for file in files)

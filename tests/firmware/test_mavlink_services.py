"""Time, ping, files, heartbeats and texts."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.constants import TICK_US
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.mavlink.texts_and_events import TextEncoder
from tests.support.mavlink_clients import CLIENT_IDS, Rig

NAN = math.nan


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_timesync_answers_in_our_time(rig: Rig) -> None:
    rig.client.send(dialect.MAVLink_timesync_message(0, 123_456_789))
    now_us = rig.autopilot.time_us
    rig.bench.server.receive(now_us)
    (answer,) = rig.client.received("TIMESYNC")
    assert (answer.tc1, answer.ts1) == (now_us * 1000, 123_456_789)
    rig.client.send(dialect.MAVLink_timesync_message(5, now_us * 1000))
    rig.bench.server.receive(now_us)
    assert rig.client.received("TIMESYNC") == []


def test_timesync_requests_carry_our_time(rig: Rig) -> None:
    rig.bench.run(1.0)
    stamps = [m.ts1 for m in rig.client.received("TIMESYNC") if m.tc1 == 0]
    assert np.diff(stamps) == pytest.approx(1e8)


def test_ping(rig: Rig) -> None:
    rig.client.send(dialect.MAVLink_ping_message(42, 7, 0, 0))
    rig.client.send(dialect.MAVLink_ping_message(42, 8, 1, 1))  # an answer
    rig.client.send(dialect.MAVLink_ping_message(42, 9, 5, 5))
    rig.bench.server.receive(rig.autopilot.time_us)
    (answer,) = rig.client.received("PING")
    assert (answer.time_usec, answer.seq) == (42, 7)
    assert (answer.target_system, answer.target_component) == CLIENT_IDS
    rig.bench.run(3.0)
    assert np.diff([m.seq for m in rig.client.received("PING")]).tolist() == [1, 1]


def test_mavproxys_packed_parameters_are_no_file(rig: Rig) -> None:
    """MAVProxy requests the file when it connects, and falls back to the parameter list."""
    name, opened = b"@PARAM/param.pck", 4
    body = struct.pack("<HBBBBBxI", 65_535, 0, opened, len(name), 0, 0, 0) + name
    message = dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(body.ljust(251, b"\0")))
    (answer,) = [m for m in rig.exchange(message) if m.get_type() == "FILE_TRANSFER_PROTOCOL"]
    sequence, session, code, size, asked, _, _ = struct.unpack_from(
        "<HBBBBBxI", bytes(answer.payload)
    )
    assert (sequence, session, code, size, asked) == (0, 0, 129, 1, opened)
    assert answer.payload[12] == 10  # file not found


def test_answers_about_files_are_not_answered(rig: Rig) -> None:
    for opcode in (128, 129):
        body = struct.pack("<HBBBBBxI", 1, 0, opcode, 0, 0, 0, 0).ljust(251, b"\0")
        message = dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(body))
        assert not [m for m in rig.exchange(message) if m.get_type() == "FILE_TRANSFER_PROTOCOL"]


def test_only_ground_stations_heartbeats_count(rig: Rig) -> None:
    for kind in (dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_TYPE_GCS):
        rig.client.send(dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3))
        rig.bench.tick()
    assert rig.autopilot.gcs_heartbeats == [rig.autopilot.time_us - TICK_US]


# --- texts


@pytest.mark.parametrize("length", [0, 1, 49, 50, 51, 99, 100, 101, 250])
def test_long_texts_come_in_chunks(length: int) -> None:
    text = "".join(chr(ord("a") + i % 26) for i in range(length))
    encoder = TextEncoder()
    first = encoder.encode(OperatorText(Severity.ERROR, text))
    second = encoder.encode(OperatorText(Severity.ERROR, text))
    parser = dialect.MAVLink(None)
    received = [parser.parse_buffer(m.pack(dialect.MAVLink(None, 1, 1)))[0] for m in first]
    assert {m.severity for m in received} == {3}
    assert "".join(m.text for m in received) == text
    if length <= 50:
        assert (len(received), received[0].id) == (1, 0)
        return
    # The MAVLink rule: same id, counted chunks, a NUL in the last one and in no other.
    assert {m.id for m in received} == {1}
    assert {m.id for m in second} == {2}
    assert [m.chunk_seq for m in received] == list(range(len(received)))
    full = [len(m.text) == 50 for m in received]
    assert full == [True] * (len(received) - 1) + [False]


def test_text_ids_are_never_zero() -> None:
    encoder = TextEncoder()
    encoder._id = 65_534
    ids = [encoder.encode(OperatorText(Severity.INFO, "x" * 60))[0].id for _ in range(3)]
    assert ids == [65_535, 1, 2]


def test_texts_beyond_ascii_stay_readable() -> None:
    (message,) = TextEncoder().encode(OperatorText(Severity.INFO, "80 µs"))
    assert message.text == "80 ?s"

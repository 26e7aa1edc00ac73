"""Frames in and out, against pymavlink's own parser; damaged bytes."""

from __future__ import annotations

import struct
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.mavlink.codec import (
    Decoder,
    Encoder,
    Reader,
    layout,
    message_id,
    param_value,
    payload,
    trimmed,
)
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from tests.support.mavlink_clients import RawClient


def ping(sequence: int) -> Any:
    return dialect.MAVLink_ping_message(123_456, sequence, 0, 0)


def client() -> RawClient:
    return RawClient(MemoryEndpoint())


def sequences(messages: list[Any]) -> list[int]:
    return [m.seq for m in messages if m.get_type() == "PING"]


def test_frames_are_mavlink_2_with_our_ids_and_a_running_sequence() -> None:
    encoder = Encoder()
    parser = dialect.MAVLink(None)
    for expected in [*range(256), 0, 1]:
        frame = encoder.pack(ping(7))
        assert frame[0] == 0xFD
        (message,) = parser.parse_buffer(frame)
        assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 1)
        assert message.get_seq() == expected
        assert message.seq == 7


def test_links_count_their_own_sequence() -> None:
    one, two = Encoder(), Encoder()
    one.pack(ping(0))
    assert two.pack(ping(0))[4] == 0


def test_a_frame_that_cannot_be_packed_uses_up_no_sequence_number() -> None:
    encoder = Encoder()
    with pytest.raises(struct.error):
        encoder.pack(dialect.MAVLink_ping_message(-1, 0, 0, 0))
    assert encoder.pack(ping(0))[4] == 0


def test_both_protocol_versions_are_understood() -> None:
    sender = dialect.MAVLink(None, 245, 190)
    old = ping(1).pack(sender, force_mavlink1=True)
    new = ping(2).pack(sender)
    assert (old[0], new[0]) == (0xFE, 0xFD)
    assert sequences(Decoder(datagrams=True).feed(old + new)) == [1, 2]


def test_signed_frames_are_accepted_unchecked() -> None:
    sender = dialect.MAVLink(None, 245, 190)
    sender.signing.secret_key = b"k" * 32
    sender.signing.sign_outgoing = True
    signed = ping(1).pack(sender)
    decoder = Decoder(datagrams=True)
    assert sequences(decoder.feed(signed + client().pack(ping(2)))) == [1, 2]
    assert decoder.malformed == 0


def test_unknown_incompatibility_flags_are_refused() -> None:
    frame = bytearray(client().pack(ping(1)))
    frame[2] |= 0x02
    decoder = Decoder(datagrams=True)
    assert decoder.feed(bytes(frame)) == []
    assert decoder.malformed == 1


def test_messages_that_the_dialect_lacks_are_counted_apart() -> None:
    other = ardupilotmega.MAVLink(None, 245, 190)
    frame = ardupilotmega.MAVLink_hwstatus_message(5_000, 1).pack(other)
    decoder = Decoder(datagrams=True)
    assert sequences(decoder.feed(frame + client().pack(ping(3)))) == [3]
    assert (decoder.unknown, decoder.malformed) == (1, 0)


def test_a_false_header_does_not_swallow_the_frame_behind_it() -> None:
    decoder = Decoder(datagrams=True)
    # Claims 255 bytes of payload of an existing message.
    lie = struct.pack("<BBBBBBBHB", 0xFD, 255, 0, 0, 0, 1, 1, message_id("PING"), 0)
    assert sequences(decoder.feed(lie + client().pack(ping(5)))) == [5]
    assert decoder.malformed == 1


def test_a_cut_datagram_does_not_hold_up_the_next() -> None:
    decoder = Decoder(datagrams=True)
    frame = client().pack(ping(9))
    assert decoder.feed(frame[:-1]) == []
    assert sequences(decoder.feed(frame)) == [9]
    assert decoder.malformed == 1


def test_each_damaged_datagram_counts_once() -> None:
    decoder = Decoder(datagrams=True)
    for _ in range(5):
        decoder.feed(b"\xfd" * 100)
        decoder.feed(b"garbage")
    assert decoder.malformed == 10


@given(
    garbage=st.lists(st.binary(max_size=40), min_size=1, max_size=8),
    cuts=st.lists(st.integers(0, 400), max_size=20),
)
def test_a_byte_stream_may_be_cut_anywhere(garbage: list[bytes], cuts: list[int]) -> None:
    # Garbage without markers: a marker could claim the following frames' bytes.
    clean = [bytes(b for b in part if b not in (0xFD, 0xFE)) for part in garbage]
    sender = client()
    stream = b"".join(part + sender.pack(ping(i)) for i, part in enumerate(clean))
    decoder = Decoder(datagrams=False)
    found: list[int] = []
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    for start, end in pairwise(edges):
        found += sequences(decoder.feed(stream[start:end]))
    assert found == list(range(len(clean)))
    assert decoder.malformed == sum(bool(part) for part in clean)


@given(chunks=st.lists(st.binary(max_size=300), max_size=30), datagrams=st.booleans())
def test_arbitrary_bytes_neither_raise_nor_pile_up(chunks: list[bytes], datagrams: bool) -> None:
    decoder = Decoder(datagrams=datagrams)
    for chunk in chunks:
        decoder.feed(chunk)
        assert len(decoder._rest) <= 280
    # 560 more bytes settle any claim that a false header has left open.
    recovered: list[Any] = []
    for i in range(40):
        recovered += decoder.feed(client().pack(ping(i)))
    assert sequences(recovered)[-20:] == list(range(20, 40))


@settings(derandomize=True)
@given(flips=st.lists(st.integers(8 * 3, 8 * 26 - 1), min_size=1, max_size=3, unique=True))
def test_a_frame_with_flipped_bits_is_never_taken_for_another(flips: list[int]) -> None:
    frame = bytearray(client().pack(dialect.MAVLink_ping_message(2**63, 2**31, 245, 190)))
    assert len(frame) == 26
    for bit in flips:
        frame[bit // 8] ^= 1 << bit % 8
    # CRC-16/MCRF4XX finds every error of up to three bits in so short a frame.
    assert not [m for m in Decoder(datagrams=True).feed(bytes(frame)) if m.get_type() == "PING"]


def test_payload_of_both_versions() -> None:
    sender = dialect.MAVLink(None, 245, 190)
    message = dialect.MAVLink_ping_message(0x0102030405060708, 1, 2, 3)
    expected = struct.pack("<QIBB", 0x0102030405060708, 1, 2, 3)
    for old in (True, False):
        frame = message.pack(sender, force_mavlink1=old)
        (decoded,) = Decoder(datagrams=True).feed(frame)
        assert payload(decoded) == expected


@given(value=st.integers(-(2**31), 2**31 - 1))
def test_integer_parameters_keep_all_their_bits(value: int) -> None:
    raw = struct.pack("<i", value)
    frame = Encoder().frame(
        layout("PARAM_VALUE"), trimmed(param_value("SYS_AUTOSTART", raw, 6, 900, 12))
    )
    (message,) = dialect.MAVLink(None).parse_buffer(frame)
    # MAVLink 2 cuts trailing zeros of the payload, never here: the type is the last byte.
    assert frame[10:14] == raw
    assert (message.param_id, message.param_type) == ("SYS_AUTOSTART", 6)
    assert (message.param_count, message.param_index) == (900, 12)


# --- one kind of message, alone in a chunk


def hil_controls(time_us: int, controls: list[float], mode: int) -> Any:
    return dialect.MAVLink_hil_actuator_controls_message(time_us, controls, mode, 1)


@given(
    time_us=st.integers(0, 2**64 - 1),
    controls=st.lists(st.floats(width=32, allow_nan=False), min_size=16, max_size=16),
    mode=st.integers(0, 255),
)
@settings(max_examples=50, deadline=None)
def test_a_reader_reads_what_was_packed(time_us: int, controls: list[float], mode: int) -> None:
    chunk = Encoder().pack(hil_controls(time_us, controls, mode))
    read = Reader("HIL_ACTUATOR_CONTROLS").read(chunk)
    assert read == (time_us, 1, *controls, mode)


def test_a_reader_leaves_everything_else_to_the_decoder() -> None:
    reader, message = Reader("HIL_ACTUATOR_CONTROLS"), hil_controls(7, [0.5] * 16, 129)
    frame = Encoder().pack(message)
    assert reader.names == ("time_usec", "flags", "controls", "mode")
    assert reader.read(frame) is not None
    damaged = [frame[:i] + bytes([frame[i] ^ 1]) + frame[i + 1 :] for i in range(len(frame))]
    version_1 = message.pack(dialect.MAVLink(None), force_mavlink1=True)
    others = (Encoder().pack(ping(1)), frame + frame, b"\0" + frame, bytes(version_1))
    cut = (frame[:end] for end in range(len(frame)))
    for chunk in (*damaged, *others, *cut):
        assert reader.read(chunk) is None, chunk.hex()


def test_a_decoder_knows_whether_it_is_between_frames() -> None:
    decoder, frame = Decoder(datagrams=False), Encoder().pack(ping(1))
    assert decoder.between_frames
    decoder.feed(frame[:5])
    assert not decoder.between_frames
    decoder.feed(frame[5:])
    assert decoder.between_frames
    decoder.feed(b"garbage")
    assert not decoder.between_frames
    decoder.feed(frame)
    assert decoder.between_frames

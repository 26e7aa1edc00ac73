"""Hostile bytes on both links: counted, ignored, and the server still answers afterwards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fuzz_mavlink import fly
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.autopilot.autopilot_state import Arming
from tests.support.mavlink_clients import Bench, RawClient

# Derandomised: a 16-bit checksum lets one random frame in 65,536 pass, too many for a test to
# depend on luck.
LINKS = ("onboard", pytest.param("gcs", marks=pytest.mark.nightly))
"""Two links with one reader: the ground station's is fuzzed in nightly runs."""

# Messages that the services read: the best targets for distortion.
HANDLED = (
    "command_long", "command_int", "set_mode", "set_position_target_local_ned", "param_set",
    "param_request_read", "param_request_list", "mission_count", "mission_request_list",
    "mission_request", "mission_request_int", "mission_clear_all", "mission_write_partial_list",
    "file_transfer_protocol", "ping", "timesync", "heartbeat", "request_data_stream",
)  # fmt: skip


def still_answers(bench: Bench, link: str) -> None:
    """Assert that a command on the link is acknowledged and that streams continue."""
    client = RawClient(getattr(bench, link))
    client.received()
    client.command(512, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    bench.run(0.2)
    messages = {m.get_type() for m in client.received()}
    assert {"COMMAND_ACK", "AUTOPILOT_VERSION", "SERVO_OUTPUT_RAW"} <= messages


@pytest.mark.parametrize("link", LINKS)
@settings(max_examples=30, deadline=None, derandomize=True)
@given(chunks=st.lists(st.binary(min_size=1, max_size=400), min_size=1, max_size=20))
def test_random_bytes(link: str, chunks: list[bytes]) -> None:
    bench = Bench()
    bench.run(0.2)
    getattr(bench, link).inbox.extend(chunks)
    bench.tick()
    counters = bench.server.counters()[link]
    assert counters.rx == 0
    assert counters.malformed + counters.ignored >= 1
    assert bench.autopilot.arming is Arming.STANDBY
    assert bench.autopilot.setpoints == []
    still_answers(bench, link)


def frames() -> st.SearchStrategy[bytes]:
    """Valid frames of handled messages with random payload bytes, as a buggy client would send."""

    def build(name: str, body: bytes, sequence: int) -> bytes:
        kind = getattr(dialect, f"MAVLink_{name}_message")
        size = kind.unpacker.size
        raw = body[:size].ljust(size, b"\0")
        mav = dialect.MAVLink(None, 245, 190)
        mav.seq = sequence
        values = [0 if n == 0 else [0] * n for n in kind.array_lengths]
        arguments = [
            b"" if kind.fieldtypes[kind.fieldnames.index(field)] == "char" else values[position]
            for field, position in zip(kind.fieldnames, kind.orders, strict=True)
        ]
        message = kind(*arguments)
        packed: bytes = message._pack(mav, kind.crc_extra, raw)
        return packed

    return st.builds(build, st.sampled_from(HANDLED), st.binary(max_size=255), st.integers(0, 255))


def aimed(body: bytes, kind: Any) -> bytes:
    """Write target 1/1 into a raw payload, where the message has one."""
    raw = bytearray(body)
    offset = 0
    for field in kind.ordered_fieldnames:
        if field in ("target_system", "target_component"):
            raw[offset] = 1
        position = kind.fieldnames.index(field)
        sizes = {"char": 1, "float": 4, "double": 8}
        name = kind.fieldtypes[position]
        size = sizes.get(name) or int("".join(c for c in name if c.isdigit())) // 8
        offset += size * max(1, kind.array_lengths[kind.ordered_fieldnames.index(field)])
    return bytes(raw)


@pytest.mark.parametrize("link", LINKS)
@settings(
    max_examples=50, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
@given(sent=st.lists(frames(), min_size=1, max_size=20))
def test_valid_frames_with_senseless_contents(link: str, sent: list[bytes]) -> None:
    bench = Bench()
    bench.run(0.2)
    getattr(bench, link).inbox.extend(sent)
    bench.tick()
    counters = bench.server.counters()[link]
    assert (counters.rx, counters.malformed) == (len(sent), 0)
    still_answers(bench, link)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(name=st.sampled_from(HANDLED), body=st.binary(min_size=255, max_size=255))
def test_senseless_contents_addressed_to_us(name: str, body: bytes) -> None:
    kind = getattr(dialect, f"MAVLink_{name}_message")
    raw = aimed(body[: kind.unpacker.size], kind)
    mav = dialect.MAVLink(None, 245, 190)
    (message,) = mav.parse_buffer(_repack(kind, raw, mav))
    if hasattr(message, "target_system"):
        assert message.target_system == 1
    bench = Bench()
    bench.run(0.2)
    bench.memory.inbox.append(_repack(kind, raw, mav))
    bench.tick()
    bench.tick()
    still_answers(bench, "onboard")


def _repack(kind: Any, raw: bytes, mav: Any) -> bytes:
    unpacked = kind.unpacker.unpack(raw)
    values: list[Any] = []
    offset = 0
    for length in kind.lengths:
        part = unpacked[offset : offset + length]
        values.append(part[0] if length == 1 else list(part))
        offset += length
    message = kind(*[values[order] for order in kind.orders])
    packed: bytes = message._pack(mav, kind.crc_extra, raw)
    return packed


@pytest.mark.parametrize("link", LINKS)
@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    sent=st.lists(frames(), min_size=1, max_size=10),
    mutate=st.lists(
        st.tuples(st.integers(0, 9), st.integers(0, 279), st.integers(0, 255)), max_size=20
    ),
    cut=st.integers(1, 300),
)
def test_damaged_frames(
    link: str, sent: list[bytes], mutate: list[tuple[int, int, int]], cut: int
) -> None:
    damaged = [bytearray(frame) for frame in sent]
    for which, where, value in mutate:
        frame = damaged[which % len(damaged)]
        frame[where % len(frame)] = value
    stream = b"".join(damaged)
    bench = Bench()
    bench.run(0.2)
    inbox = getattr(bench, link).inbox
    inbox.extend(stream[i : i + cut] for i in range(0, len(stream), cut))
    bench.tick()
    counters = bench.server.counters()[link]
    assert counters.rx <= len(sent)
    still_answers(bench, link)


def test_the_same_bytes_twice_give_the_same_answers() -> None:
    def answers() -> list[bytes]:
        bench = Bench()
        client = RawClient(bench.memory)
        for i in range(50):
            client.command(512, float(i))
            client.send(dialect.MAVLink_param_request_read_message(1, 1, b"", i))
            bench.tick()
        return bench.memory.take()

    run: Callable[[], list[bytes]] = answers
    assert run() == run()


def test_hostile_frames_of_all_services_in_flight() -> None:
    """`scripts/fuzz_mavlink.py --frames 10000000` is the long one."""
    frames = 16_000
    assert fly(seed=1, frames=frames) > frames // 3  # they do reach the services


def test_absurd_steering_in_flight() -> None:
    """`scripts/fuzz_mavlink.py --steering` is the long one; this flight once ended at a home's."""
    assert fly(seed=1, frames=500, steering=True) > 250

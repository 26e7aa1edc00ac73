"""The parameter protocol, bytewise."""

from __future__ import annotations

import binascii
import math
import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.autopilot.parameter_store import Parameters as Stored
from firmware_sim.mavlink.services.params import _hash_message
from tests.support.kinematic_autopilot import DEFAULT_PARAMETERS, KinematicAutopilot, Parameters
from tests.support.mavlink_clients import CLIENT_IDS, Rig

NAN = math.nan


@pytest.fixture
def rig() -> Rig:
    return Rig()


def read(rig: Rig, name: str = "", index: int = -1) -> list[Any]:
    request = dialect.MAVLink_param_request_read_message(1, 1, name.encode(), index)
    return [m for m in rig.exchange(request) if m.get_type().startswith("PARAM")]


def set_parameter(rig: Rig, name: str, raw: bytes, kind: int) -> list[Any]:
    (as_float,) = struct.unpack("<f", raw)
    request = dialect.MAVLink_param_set_message(1, 1, name.encode(), as_float, kind)
    return [m for m in rig.exchange(request) if m.get_type().startswith("PARAM")]


def as_int(message: Any) -> int:
    (value,) = struct.unpack("<i", bytes(message.get_msgbuf())[10:14])
    return int(value)


def test_read_by_name_and_index(rig: Rig) -> None:
    names = sorted(DEFAULT_PARAMETERS)
    for index, name in enumerate(names):
        (by_name,) = read(rig, name)
        (by_index,) = read(rig, index=index)
        for message in (by_name, by_index):
            assert (message.param_id, message.param_index) == (name, index)
            assert message.param_count == len(names)
            value = DEFAULT_PARAMETERS[name]
            if isinstance(value, int):
                assert (message.param_type, as_int(message)) == (6, value)
            else:
                assert (message.param_type, message.param_value) == (9, value)


@pytest.mark.parametrize(("name", "index"), [("NOPE", -1), ("", 99), ("", 32_767), ("", -1)])
def test_read_what_does_not_exist(rig: Rig, name: str, index: int) -> None:
    (error,) = read(rig, name, index)
    assert error.get_type() == "PARAM_ERROR"
    assert (error.error, error.param_id, error.param_index) == (1, name, index)
    assert (error.target_system, error.target_component) == CLIENT_IDS


def test_set_is_told_to_all_links(rig: Rig) -> None:
    (answer,) = set_parameter(rig, "MIS_TAKEOFF_ALT", struct.pack("<f", 7.5), 9)
    assert answer.param_value == 7.5
    assert rig.autopilot.parameters.values["MIS_TAKEOFF_ALT"] == 7.5
    (heard,) = rig.station.received("PARAM_VALUE")
    assert (heard.param_id, heard.param_value) == ("MIS_TAKEOFF_ALT", 7.5)
    (answer,) = set_parameter(rig, "MIS_TAKEOFF_ALT", struct.pack("<f", 500.0), 9)
    assert answer.param_value == 500.0  # as given, also where it is out of range
    (answer,) = set_parameter(rig, "NAV_DLL_ACT", struct.pack("<i", -3), 6)
    assert as_int(answer) == -3
    assert rig.autopilot.parameters.values["NAV_DLL_ACT"] == -3


@pytest.mark.parametrize(
    ("name", "raw", "kind", "error"),
    [
        ("NOPE", struct.pack("<f", 1.0), 9, 1),
        ("SYS_AUTOSTART", struct.pack("<f", 1.0), 9, 7),
        ("MIS_TAKEOFF_ALT", struct.pack("<i", 1), 6, 7),
        ("MIS_TAKEOFF_ALT", struct.pack("<f", NAN), 9, 2),
        ("MIS_TAKEOFF_ALT", struct.pack("<f", math.inf), 9, 2),
    ],
)
def test_set_refusals(rig: Rig, name: str, raw: bytes, kind: int, error: int) -> None:
    before = dict(rig.autopilot.parameters.values)
    (answer,) = set_parameter(rig, name, raw, kind)
    assert (answer.get_type(), answer.error) == ("PARAM_ERROR", error)
    assert rig.autopilot.parameters.values == before


def test_the_full_list_is_paced_and_complete() -> None:
    rig = Rig(KinematicAutopilot(Parameters({f"P_{i:03}": float(i) for i in range(100)})))
    rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
    per_tick = []
    values: list[Any] = []
    for _ in range(60):
        rig.bench.tick()
        new = rig.client.received("PARAM_VALUE")
        per_tick.append(len(new))
        values += new
    assert max(per_tick) == 3
    assert values[0].param_id == "_HASH_CHECK"
    assert values[0].param_index == 65_535
    assert [v.param_index for v in values[1:]] == list(range(100))
    assert {v.param_count for v in values} == {100}


def test_the_hash_is_another_after_every_change() -> None:
    """With the flight controller's own store: the hash is computed once for all new clients."""
    store = Stored()
    before = _hash_message(store)
    assert _hash_message(store) == before
    store.set("MPC_XY_VEL_MAX", 7.0)
    changed = _hash_message(store)
    assert changed != before
    store.reset()
    assert _hash_message(store) == before
    assert _hash_message(Stored({"MPC_XY_VEL_MAX": 7.0})) == changed


def px4_crc32part(data: bytes, crc: int) -> int:
    """PX4's crc32part(), bit by bit."""
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB8_8320 if crc & 1 else 0)
    return crc


def test_the_hash_is_px4s_and_stops_a_list(rig: Rig) -> None:
    (message,) = read(rig, "_HASH_CHECK")
    expected = 0
    for name, value in sorted(DEFAULT_PARAMETERS.items()):
        raw = struct.pack("<i" if isinstance(value, int) else "<f", value)
        expected = px4_crc32part(name.encode() + raw, expected)
    assert message.param_type == dialect.MAV_PARAM_TYPE_UINT32
    assert as_int(message) & 0xFFFF_FFFF == expected
    rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
    rig.bench.tick()
    assert len(rig.client.received("PARAM_VALUE")) == 3
    assert set_parameter(rig, "_HASH_CHECK", b"\0\0\0\0", 5) == []
    rig.bench.run(0.1)
    assert rig.client.received("PARAM_VALUE") == []


def test_asking_again_restarts_without_the_hash(rig: Rig) -> None:
    for _ in range(2):
        rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
        rig.bench.tick()
    rig.bench.run(0.1)
    ids = [v.param_id for v in rig.client.received("PARAM_VALUE")]
    assert ids == ["_HASH_CHECK", *sorted(DEFAULT_PARAMETERS)[:2], *sorted(DEFAULT_PARAMETERS)]


def test_parameters_of_others_are_not_ours(rig: Rig) -> None:
    for message in (
        dialect.MAVLink_param_request_list_message(2, 1),
        dialect.MAVLink_param_request_read_message(1, 42, b"NAV_DLL_ACT", -1),
        dialect.MAVLink_param_set_message(2, 1, b"MIS_TAKEOFF_ALT", 1.0, 9),
    ):
        rig.client.send(message)
    rig.bench.run(0.1)
    assert not [m for m in rig.client.received() if m.get_type().startswith("PARAM")]
    assert rig.autopilot.parameters.values == DEFAULT_PARAMETERS


def test_binascii_agrees_with_the_reference_crc() -> None:
    # zlib's CRC-32 is PX4's with both inversions: pins the reference above.
    assert px4_crc32part(b"123456789", 0xFFFF_FFFF) ^ 0xFFFF_FFFF == binascii.crc32(b"123456789")

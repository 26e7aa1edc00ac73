"""Replayed start sequences: QGroundControl and MAVROS receive everything they need.

QGroundControl: InitialConnectStateMachine.cc, StandardModes.cc, ComponentInformationManager.cc.
MAVROS: sys_status.cpp, param.cpp, waypoint.cpp, sys_time.cpp, home_position.cpp, command.cpp.
"""

from __future__ import annotations

import json
import lzma
import struct
from collections.abc import Callable
from typing import Any

import pytest

from firmware_sim.mavlink.codec import crc32part, dialect
from tests.support.mavlink_clients import Rig

MISSION, FENCE, RALLY = 0, 1, 2
ANSWER_S = 0.5


def _has(field: str, value: int) -> Callable[[Any], bool]:
    return lambda message: getattr(message, field) == value


class Station:
    """Client on a lossy link that repeats unanswered requests, as QGroundControl does."""

    def __init__(self, ids: tuple[int, int], lost_every: int = 0) -> None:
        self.rig = Rig()
        self.client = self.rig.client
        self.client.mav.srcSystem, self.client.mav.srcComponent = ids
        self._lost_every, self._frames = lost_every, 0
        self._sequence = 0
        self.client.send(dialect.MAVLink_heartbeat_message(6, 8, 192, 0, 4, 3))

    def heard(self, *names: str) -> list[Any]:
        """Tick once; return what has come and was not lost on the way."""
        self.rig.bench.tick()
        lane = self.client.endpoint
        frames = lane.take()
        for frame in frames:
            self._frames += 1
            if not self._lost_every or self._frames % self._lost_every:
                lane.outbox.append(frame)
        return self.client.received(*names)

    def until(self, name: str, fits: Callable[[Any], bool] = lambda _: True) -> Any:
        """Return a message that fits; None when none comes in time."""
        for _ in range(round(ANSWER_S * 250)):
            for message in self.heard(name):
                if fits(message):
                    return message
        return None

    def ask(self, message: Any, name: str, fits: Callable[[Any], bool] = lambda _: True) -> Any:
        """Send a request up to five times; return the answer."""
        for _ in range(5):
            self.client.send(message)
            if (answer := self.until(name, fits)) is not None:
                return answer
        raise AssertionError(f"no {name}")

    def command(self, number: int, *params: float, target: tuple[int, int] = (1, 1)) -> int:
        """Return the result of a COMMAND_LONG."""
        filled = [*params, *[float("nan")] * (7 - len(params))]
        message = dialect.MAVLink_command_long_message(*target, number, 0, *filled)
        ack = self.ask(message, "COMMAND_ACK", lambda m: m.command == number)
        return int(ack.result)

    def request(self, number: int, name: str, *params: float) -> Any:
        """Request a message with REQUEST_MESSAGE and return it."""
        filled = [float(number), *params, *[0.0] * (6 - len(params))]
        message = dialect.MAVLink_command_long_message(1, 1, 512, 0, *filled)
        return self.ask(message, name)

    def file(self, name: str) -> bytes:
        """Return a file read in bursts; lost parts are read again."""

        def call(opcode: int, data: bytes = b"", offset: int = 0, size: int | None = None) -> Any:
            self._sequence += 1
            sent = self._sequence
            length = len(data) if size is None else size
            head = struct.pack("<HBBBBBxI", sent, 0, opcode, length, 0, 0, offset)
            body = list((head + data).ljust(251, b"\0"))
            message = dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, body)
            answer = self.ask(
                message,
                "FILE_TRANSFER_PROTOCOL",
                lambda m: bytes(m.payload[:2]) == struct.pack("<H", sent + 1),
            )
            return bytes(answer.payload)

        (size,) = struct.unpack_from("<I", call(4, name.encode()), 12)
        parts: dict[int, bytes] = {}
        self._sequence += 1
        head = struct.pack("<HBBBBBxI", self._sequence, 0, 15, 239, 0, 0, 0)
        body = list(head.ljust(251, b"\0"))
        self.client.send(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, body))
        for _ in range(round(ANSWER_S * 250)):
            for message in self.heard("FILE_TRANSFER_PROTOCOL"):
                payload = bytes(message.payload)
                if payload[3] == 128:
                    parts[struct.unpack_from("<I", payload, 8)[0]] = payload[12:][: payload[4]]
        self._sequence += 1_000
        for offset in range(0, size, 239):
            if offset not in parts:
                payload = call(5, b"", offset, 239)
                parts[offset] = payload[12:][: payload[4]]
        call(1)
        return b"".join(parts[offset] for offset in sorted(parts))

    def parameters(self) -> dict[int, str]:
        """Return the names by index: from the list, then lost entries one by one."""
        found: dict[int, str] = {}
        total = 0
        self.client.send(dialect.MAVLink_param_request_list_message(1, 1))
        for _ in range(round(ANSWER_S * 250)):
            for message in self.heard("PARAM_VALUE"):
                total = message.param_count
                if message.param_index < total:
                    found[message.param_index] = message.param_id
        for index in range(total):
            if index not in found:
                asked = dialect.MAVLink_param_request_read_message(1, 1, b"", index)
                found[index] = self.ask(asked, "PARAM_VALUE", _has("param_index", index)).param_id
        return found

    def plan(self, kind: int) -> int:
        """Return how many items a plan has."""
        asked = dialect.MAVLink_mission_request_list_message(1, 1, kind)
        count = self.ask(asked, "MISSION_COUNT", lambda m: m.mission_type == kind)
        self.client.send(dialect.MAVLink_mission_ack_message(1, 1, 0, kind))
        return int(count.count)


@pytest.mark.parametrize("lost_every", [0, 7])
def test_qgroundcontrol_connects(lost_every: int) -> None:
    station = Station((255, 190), lost_every)
    version = station.request(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION, "AUTOPILOT_VERSION")
    assert version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    assert station.request(dialect.MAVLINK_MSG_ID_PROTOCOL_VERSION, "PROTOCOL_VERSION")
    modes: dict[int, Any] = {}
    number = 1
    while not modes or number <= modes[1].number_modes:
        modes[number] = station.request(
            dialect.MAVLINK_MSG_ID_AVAILABLE_MODES, "AVAILABLE_MODES", number
        )
        assert modes[number].mode_index == number
        number += 1
    metadata = station.request(dialect.MAVLINK_MSG_ID_COMPONENT_METADATA, "COMPONENT_METADATA")
    general = station.file(metadata.uri.removeprefix("mftp://"))
    assert crc32part(general) == metadata.file_crc
    entry, words = json.loads(lzma.decompress(general))["metadataTypes"]
    events = json.loads(lzma.decompress(station.file(words["uri"].removeprefix("mftp://"))))
    assert events["components"]["1"]["supported_protocols"] == ["health_and_arming_check"]
    described = json.loads(lzma.decompress(station.file(entry["uri"].removeprefix("mftp://"))))
    hash_check = dialect.MAVLink_param_request_read_message(1, 1, b"_HASH_CHECK", -1)
    assert station.ask(hash_check, "PARAM_VALUE", lambda m: m.param_id == "_HASH_CHECK")
    names = station.parameters()
    assert sorted(names) == list(range(len(station.rig.autopilot.parameters)))
    assert {"SYS_AUTOSTART", "MPC_XY_VEL_MAX"} <= {p["name"] for p in described["parameters"]}
    assert [station.plan(kind) for kind in (MISSION, FENCE, RALLY)] == [0, 0, 0]
    # Its pages also query devices that do not exist: refused, not ignored.
    for number in (259, 280):  # CAMERA_INFORMATION, GIMBAL_MANAGER_INFORMATION
        assert station.command(512, number) != dialect.MAV_RESULT_ACCEPTED
    assert station.rig.bench.server.effects() == ()


def test_mavros_connects() -> None:
    # Same system as the vehicle, component MAV_COMP_ID_ONBOARD_COMPUTER.
    companion = Station((1, 191))
    assert companion.command(520, 1, target=(1, 1)) == dialect.MAV_RESULT_ACCEPTED
    # It queries all components first, and the autopilot if there is no answer.
    everybody = dialect.MAVLink_command_long_message(0, 0, 520, 0, 1, 0, 0, 0, 0, 0, 0)
    assert companion.ask(everybody, "AUTOPILOT_VERSION")
    synced = companion.ask(
        dialect.MAVLink_timesync_message(0, 123_456_789), "TIMESYNC", lambda m: m.tc1 != 0
    )
    assert synced.ts1 == 123_456_789
    assert len(companion.parameters()) == len(companion.rig.autopilot.parameters)
    assert [companion.plan(kind) for kind in (MISSION, FENCE, RALLY)] == [0, 0, 0]
    home = dialect.MAVLink_command_long_message(1, 1, 410, 0, 0, 0, 0, 0, 0, 0, 0)
    assert companion.ask(home, "HOME_POSITION")
    for name, rate_hz in (("ATTITUDE_QUATERNION", 50), ("HIGHRES_IMU", 50)):
        number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
        assert companion.command(511, number, 1e6 / rate_hz) == dialect.MAV_RESULT_ACCEPTED
    companion.client.send(dialect.MAVLink_request_data_stream_message(1, 1, 0, 10, 1))
    # Setpoints, the mode by SET_MODE, arming: as its offboard example.
    companion.rig.set_local(0xFC7, vz=-0.5)
    companion.client.send(dialect.MAVLink_set_mode_message(1, 1, 6 << 16))
    assert companion.command(400, 1, 0) == dialect.MAV_RESULT_ACCEPTED
    for _ in range(10):
        companion.rig.set_local(0xFC7, vz=-0.5)
        companion.rig.bench.run(0.05)
    beat = companion.until("HEARTBEAT") or companion.until("HEARTBEAT")
    assert (beat.custom_mode, bool(beat.base_mode & 128)) == (6 << 16, True)

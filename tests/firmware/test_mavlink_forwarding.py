"""Forwarding of messages to other systems: PX4's rules, and no loops."""

from __future__ import annotations

from collections import deque
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.autopilot.autopilot_state import Arming
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import RawClient
from tests.support.memory_hub import MemoryHub

CAMERA, GIMBAL, STATION, OTHER_VEHICLE = (1, 100), (1, 154), (255, 190), (2, 1)


class Field:
    """Camera and gimbal on the onboard side, a station and another vehicle on the ground side."""

    def __init__(self) -> None:
        self.onboard, self.ground = MemoryHub(), MemoryHub()
        self.autopilot = KinematicAutopilot()
        self.server = MavlinkServer(
            [onboard_link(self.onboard), gcs_link(self.ground)], self.autopilot, boot_unix_us=0
        )
        self.camera = self.onboard.client(1, CAMERA)
        self.gimbal = self.onboard.client(2, GIMBAL)
        self.station = self.ground.client(None, STATION)
        self.other = self.ground.client(3, OTHER_VEHICLE)
        self.all = (self.camera, self.gimbal, self.station, self.other)
        for client in self.all:
            client.send(heartbeat())
        self.tick()
        self.tick()
        for client in self.all:
            client.endpoint.take()

    def tick(self) -> None:
        self.server.receive(self.autopilot.time_us)
        self.autopilot.step()
        self.server.send(self.autopilot.time_us)

    def foreign(self) -> list[list[Any]]:
        """Return what each has got that is not the vehicle's own."""
        return [
            [(m.get_type(), m.get_srcSystem(), m.get_srcComponent()) for m in client.received()
             if (m.get_srcSystem(), m.get_srcComponent()) != (1, 1)]
            for client in self.all
        ]  # fmt: skip


@pytest.fixture
def field() -> Field:
    return Field()


def heartbeat() -> Any:
    return dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)


def test_a_broadcast_reaches_all_others_once(field: Field) -> None:
    field.station.send(heartbeat())
    field.tick()
    beat = ("HEARTBEAT", *STATION)
    assert field.foreign() == [[beat], [beat], [], [beat]]


@pytest.mark.parametrize(
    ("target", "reached"),
    [
        (CAMERA, {"camera"}),
        (OTHER_VEHICLE, {"other"}),
        ((2, 0), {"other"}),
        ((1, 0), {"camera", "gimbal"}),  # every component of this system
        ((0, 0), {"camera", "gimbal", "other"}),
        ((1, 1), set()),  # this vehicle's autopilot alone
        ((9, 1), set()),  # unknown system
        ((1, 191), set()),
    ],
)
def test_what_is_addressed_goes_to_where_its_addressee_was_heard(
    field: Field, target: tuple[int, int], reached: set[str]
) -> None:
    field.station.command(512, 1, target=target)
    field.tick()
    names = ("camera", "gimbal", "station", "other")
    got = {name for name, seen in zip(names, field.foreign(), strict=True) if seen}
    assert got == reached


def test_commands_for_others_are_not_obeyed(field: Field) -> None:
    field.station.command(400, 1, target=OTHER_VEHICLE)
    field.tick()
    assert field.autopilot.arming is not Arming.ARMED
    assert not [m for m in field.station.received() if m.get_type() == "COMMAND_ACK"]
    assert [name for name, *_ in field.foreign()[3]] == ["COMMAND_LONG"]
    field.other.send(dialect.MAVLink_command_ack_message(400, 0, 0, 0, *STATION))
    field.tick()
    assert field.foreign() == [[], [], [("COMMAND_ACK", *OTHER_VEHICLE)], []]


def test_frames_are_passed_on_byte_by_byte(field: Field) -> None:
    frame = field.station.pack(dialect.MAVLink_statustext_message(6, b"to all"))
    field.station.endpoint.inbox.append(frame)
    field.tick()
    assert frame in field.camera.endpoint.take()


def test_a_key_is_told_to_nobody_else(field: Field) -> None:
    field.station.send(dialect.MAVLink_setup_signing_message(0, 0, [0] * 32, 0))
    field.tick()
    assert field.foreign() == [[], [], [], []]


def test_who_has_said_nothing_gets_nothing_of_others() -> None:
    silent = MemoryEndpoint()
    hub = MemoryHub()
    autopilot = KinematicAutopilot()
    server = MavlinkServer([onboard_link(silent), gcs_link(hub)], autopilot, boot_unix_us=0)
    hub.client(4, STATION).send(heartbeat())
    server.receive(0)
    autopilot.step()
    server.send(autopilot.time_us)
    assert {m.get_srcSystem() for m in RawClient(silent).received()} == {1}


def test_a_bridge_between_the_links_makes_no_loop(field: Field) -> None:
    """A router that is a client of both links, and passes everything on to the other."""
    left, right = field.onboard.lane(("10.0.0.1", 1)), field.ground.lane(("10.0.0.1", 2))
    plain = RawClient(left, (77, 1))
    left.inbox.append(plain.pack(heartbeat()))
    right.inbox.append(plain.pack(heartbeat()))
    field.tick()
    for client in field.all:
        client.endpoint.take()
    passed = 0
    for n in range(100):
        if n < 50:
            field.station.send(heartbeat())
            field.gimbal.send(heartbeat())
        for here, there in ((left, right), (right, left)):
            queue = deque(here.take())
            for frame in queue:
                passed += 1
                there.inbox.append(frame)
        field.tick()
    assert not [f for lane in (left, right) for f in lane.take() if f[5] != 1]
    assert passed > 200
    for seen, client in zip(field.foreign(), field.all, strict=True):
        mine = client.mav.srcSystem, client.mav.srcComponent
        for system, component in {STATION, GIMBAL} - {mine}:
            assert seen.count(("HEARTBEAT", system, component)) == 50

"""Links, counters, and the exchange of the autopilot between episodes."""

from __future__ import annotations

import pytest
from kinematic_autopilot import KinematicAutopilot
from mavlink_clients import RawClient, Rig, text_of
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.autopilot.state import Arming, Message, Severity
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.link import onboard_link
from firmware_sim.mavlink.server import MavlinkServer

ACCEPTED = 0


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_a_new_autopilot_takes_over_the_links(rig: Rig) -> None:
    rig.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 20_000)
    rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
    rig.bench.tick()
    rig.autopilot.messages.append(Message(Severity.INFO, "from the old flight"))
    rig.set_local(3527, frame=7, vx=1.0)
    rig.bench.server.receive(rig.autopilot.time_us)  # leaves a text that was not sent
    rig.set_local(3527, vx=1.0)  # arrives too late for the old, must not reach the new
    rig.client.received()

    fresh = KinematicAutopilot()  # time starts at 0 again
    rig.bench.autopilot = fresh
    rig.bench.server.attach(fresh)
    rig.bench.run(2.0)
    messages = rig.client.received()
    names = [m.get_type() for m in messages]
    assert messages[0].get_type() == "HEARTBEAT"
    assert fresh.setpoints == []
    assert text_of(messages) == []
    assert "PARAM_VALUE" not in names
    assert names.count("ATTITUDE") == 100  # the client's rate stays
    assert names.count("HEARTBEAT") == 2
    assert names.count("GPS_GLOBAL_ORIGIN") == 1
    rig.autopilot = fresh
    assert rig.command(400, 1)[0] == ACCEPTED
    assert fresh.arming is Arming.ARMED


def test_without_an_autopilot_the_vehicle_is_off() -> None:
    endpoint = MemoryEndpoint()
    server = MavlinkServer([onboard_link(endpoint)], boot_unix_us=0)
    client = RawClient(endpoint)
    client.command(400, 1)
    assert server.receive(0) == 0
    server.send(0)
    assert client.received() == []
    assert server.counters()["onboard"].ignored == 1

    autopilot = KinematicAutopilot()
    server.attach(autopilot)
    client.command(400, 1)
    assert server.receive(0) == 1
    server.send(0)
    assert {"COMMAND_ACK", "HEARTBEAT"} <= set(client.count())
    assert autopilot.commands == ["arm force=False"]


def test_counters(rig: Rig) -> None:
    start = rig.bench.server.counters()["onboard"]
    rig.client.send(dialect.MAVLink_ping_message(1, 1, 0, 0))
    rig.client.send(dialect.MAVLink_rc_channels_message(0, *[0] * 20))
    rig.bench.onboard.inbox.append(b"noise")
    rig.bench.run(1.0)
    end = rig.bench.server.counters()["onboard"]
    assert end.rx - start.rx == 2
    assert end.ignored - start.ignored == 1
    assert end.malformed - start.malformed == 1
    assert end.tx - start.tx == sum(rig.client.count().values())
    assert end.send_errors == 0
    assert rig.bench.server.filenos() == []

"""Links, counters, and the exchange of the autopilot between episodes."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil

from firmware_sim.autopilot.autopilot_state import Arming, OperatorText, Severity
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.traffic import TlogWriter
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import RawClient, Rig, text_of

ACCEPTED = 0


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_a_new_autopilot_takes_over_the_links(rig: Rig) -> None:
    rig.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 20_000)
    rig.client.send(dialect.MAVLink_param_request_list_message(1, 1))
    rig.bench.tick()
    rig.autopilot.messages.append(OperatorText(Severity.INFO, "from the old flight"))
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
    rig.bench.memory.inbox.append(b"noise")
    rig.bench.run(1.0)
    end = rig.bench.server.counters()["onboard"]
    assert end.rx - start.rx == 2
    assert end.ignored - start.ignored == 1
    assert end.malformed - start.malformed == 1
    assert end.tx - start.tx == sum(rig.client.count().values())
    assert end.send_errors == 0
    assert rig.bench.server.filenos() == []


def test_the_snapshot_is_only_taken_when_there_is_something_to_send(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    autopilot = KinematicAutopilot()
    endpoint = MemoryEndpoint()
    server = MavlinkServer([onboard_link(endpoint)], autopilot, boot_unix_us=0)
    client = RawClient(endpoint)
    client.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 100_000)
    for number in dialect.mavlink_map:
        if number != dialect.MAVLINK_MSG_ID_ATTITUDE:
            client.command(511, number, -1)
    for _ in range(100):  # the origin is announced on the way
        autopilot.step()
        server.receive(autopilot.time_us)
        server.send(autopilot.time_us)
    client.received()
    taken = 0
    state = autopilot.state

    def counted() -> AutopilotState:
        nonlocal taken
        taken += 1
        return state()

    monkeypatch.setattr(autopilot, "state", counted)
    for _ in range(250):
        autopilot.step()
        server.receive(autopilot.time_us)
        server.send(autopilot.time_us)
    # Those two have rates that no client can change.
    counts = client.count()
    assert counts == {"ATTITUDE": 10, "HEARTBEAT": 1, "MISSION_CURRENT": 1}
    # Without tick logs, this server takes one snapshot for each of these.
    assert taken == 250 + counts.total()


# --- the two lanes of a link


class TwoLanes(MemoryEndpoint):
    """Keeps telemetry and answers apart."""

    def __init__(self) -> None:
        super().__init__()
        self.telemetry: list[tuple[bytes, ...]] = []
        self.answers: list[bytes] = []

    def send(self, data: bytes) -> None:
        super().send(data)
        self.answers.append(data)

    def send_streams(self, frames: Sequence[bytes]) -> None:
        super().send_streams(frames)
        self.telemetry.append(tuple(frames))


def ask_anything(client: RawClient, server: MavlinkServer, rng: np.random.Generator) -> None:
    """Send a request that is answered and changes nothing."""
    streams = list(next(iter(server._links[0])).link.builders)
    name = streams[rng.integers(len(streams))]
    choices = (
        lambda: client.command(512, getattr(dialect, f"MAVLINK_MSG_ID_{name}")),
        lambda: client.command(512, dialect.MAVLINK_MSG_ID_PING),
        lambda: client.command(400, 1e30),  # refused, in a text of several chunks
        lambda: client.command(31_000),
        lambda: client.send(dialect.MAVLink_ping_message(1, 2, 0, 0)),
        lambda: client.send(dialect.MAVLink_timesync_message(0, 3)),
        lambda: client.send(dialect.MAVLink_param_request_list_message(1, 1)),
        lambda: client.send(dialect.MAVLink_param_request_read_message(1, 1, b"", 3)),
        lambda: client.send(dialect.MAVLink_mission_request_list_message(1, 1)),
    )
    choices[rng.integers(len(choices))]()


def telemetry(*, separate_replies: bool, seed: int | None) -> TwoLanes:
    """Return what left in 3 s, with requests at the times that a seed gives; None = without."""
    autopilot = KinematicAutopilot()
    endpoint = TwoLanes()
    server = MavlinkServer(
        [onboard_link(endpoint, separate_replies=separate_replies)], autopilot, boot_unix_us=0
    )
    client = RawClient(endpoint)
    rng = np.random.default_rng(seed)
    for tick in range(750):
        while seed is not None and rng.random() < 0.2:
            ask_anything(client, server, rng)
        server.receive(autopilot.time_us)
        autopilot.step()
        if tick % 100 == 50:
            autopilot.messages.append(OperatorText(Severity.INFO, "x" * tick))
        server.send(autopilot.time_us)
    return endpoint


def sequence(frames: Sequence[bytes]) -> list[int]:
    return [frame[4] for frame in frames]


def running(count: int) -> list[int]:
    return [i % 256 for i in range(count)]


def test_separate_replies_leave_the_telemetry_as_it_is() -> None:
    quiet = telemetry(separate_replies=True, seed=None)
    assert quiet.answers == []
    frames = [frame for tick in quiet.telemetry for frame in tick]
    assert len(frames) > 1_000
    assert sequence(frames) == running(len(frames))
    for seed in range(3):
        asked = telemetry(separate_replies=True, seed=seed)
        assert asked.telemetry == quiet.telemetry
        assert len(asked.answers) > 200
        assert sequence(asked.answers) == running(len(asked.answers))


def test_replies_count_in_the_one_sequence_of_an_ordinary_link() -> None:
    quiet = telemetry(separate_replies=False, seed=None)
    asked = telemetry(separate_replies=False, seed=0)
    frames = asked.take()
    assert sequence(frames) == running(len(frames))
    assert len(frames) == len(asked.answers) + sum(map(len, asked.telemetry))
    assert asked.telemetry != quiet.telemetry
    # Without anybody asking, both kinds of link say the same.
    assert quiet.telemetry == telemetry(separate_replies=True, seed=None).telemetry


def test_long_texts_of_both_lanes_do_not_mix() -> None:
    endpoint = telemetry(separate_replies=True, seed=0)
    client = RawClient(endpoint)
    texts: dict[int, str] = {}
    for message in client.received("STATUSTEXT"):
        texts[message.id] = texts.get(message.id, "") + message.text
    refusal = f"Unsupported ARM_DISARM param: {np.float32(1e30):.3f}"
    said = sorted(text for key, text in texts.items() if key)
    assert set(said) == {refusal} | {"x" * tick for tick in range(150, 750, 100)}
    assert [text for text in said if text != refusal] == sorted(
        "x" * tick for tick in range(150, 750, 100)
    )


def test_a_log_has_both_lanes_in_the_order_of_sending(tmp_path: Path) -> None:
    autopilot = KinematicAutopilot()
    endpoint = MemoryEndpoint()
    server = MavlinkServer([onboard_link(endpoint)], autopilot, boot_unix_us=0)
    client = RawClient(endpoint)
    with closing(TlogWriter(tmp_path / "a.tlog", 0)) as tlog:
        server.log_to(tlog)
        for _ in range(500):
            client.send(dialect.MAVLink_ping_message(1, 2, 0, 0))
            server.receive(autopilot.time_us)
            autopilot.step()
            server.send(autopilot.time_us)
    log = mavutil.mavlink_connection(str(tmp_path / "a.tlog"))
    logged = list(iter(log.recv_msg, None))
    log.close()
    ours = [bytes(m.get_msgbuf()) for m in logged if m.get_srcSystem() == 1]
    # mavutil reads a log with its own dialect: it skips what is newer.
    known = mavutil.mavlink.mavlink_map
    assert ours == [f for f in endpoint.take() if int.from_bytes(f[7:10], "little") in known]
    assert sum(m.get_srcSystem() == 245 for m in logged) == 500

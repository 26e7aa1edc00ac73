"""Several clients on one link: own streams, own answers, and no one may crowd out another."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count, pairwise

import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_S
from firmware_sim.mavlink import clients
from firmware_sim.mavlink.clients import BURST_FRAMES, FRAMES_PER_S, Allowance
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import RawClient
from tests.support.memory_hub import MemoryHub

SET_INTERVAL, REQUEST_MESSAGE = 511, 512
ATTITUDE = dialect.MAVLINK_MSG_ID_ATTITUDE


class Field:
    """A vehicle with a ground link of many clients and an onboard link of one."""

    def __init__(self, clock: SimClock | None = None) -> None:
        self.hub = MemoryHub()
        self.onboard = MemoryEndpoint()
        self.autopilot = KinematicAutopilot()
        self.server = MavlinkServer(
            [gcs_link(self.hub), onboard_link(self.onboard)],
            self.autopilot,
            boot_unix_us=0,
            clock=clock,
        )

    def tick(self) -> None:
        self.server.receive(self.autopilot.time_us)
        self.autopilot.step()
        self.server.send(self.autopilot.time_us)

    def run(self, seconds: float, each: Callable[[], object] = lambda: None) -> None:
        for _ in range(round(seconds * US_PER_S / TICK_US)):
            each()
            self.tick()


@pytest.fixture
def field() -> Field:
    field = Field()
    field.run(0.2)
    return field


def heartbeat() -> dialect.MAVLink_message:
    return dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)


def test_an_answer_goes_to_who_asked_and_to_nobody_else(field: Field) -> None:
    preset, one, two = field.hub.client(None), field.hub.client(1), field.hub.client(2)
    for client in (one, two):
        client.send(heartbeat())
    field.run(0.1)
    for client in (preset, one, two):
        client.received()
    one.command(400, 1)
    two.send(heartbeat())  # talks last
    field.tick()
    (ack,) = one.received("COMMAND_ACK")
    assert (ack.command, ack.result) == (400, 0)
    assert not two.received("COMMAND_ACK")
    assert not preset.received("COMMAND_ACK")


def test_each_client_has_its_own_streams_and_its_own_sequence(field: Field) -> None:
    preset, one, two = field.hub.client(None), field.hub.client(1), field.hub.client(2)
    one.command(SET_INTERVAL, ATTITUDE, 1e6)
    two.send(heartbeat())
    field.run(1.0)
    for client in (preset, one, two):
        client.received()
    field.run(2.0)
    seen = {client: client.received() for client in (preset, one, two)}
    attitudes = [sum(m.get_type() == "ATTITUDE" for m in seen[c]) for c in seen]
    assert attitudes == [100, 2, 100]  # 50 Hz is the link's default
    for messages in seen.values():
        numbers = [m.get_seq() for m in messages]
        assert all((b - a) % 256 == 1 for a, b in pairwise(numbers))
    one.command(510, ATTITUDE)  # GET_MESSAGE_INTERVAL
    two.command(510, ATTITUDE)
    field.tick()
    intervals = [c.received("MESSAGE_INTERVAL")[0].interval_us for c in (one, two)]
    assert intervals == [1_000_000, 20_000]


def test_parameter_lists_run_side_by_side(field: Field) -> None:
    one, two = field.hub.client(1), field.hub.client(2)
    one.send(dialect.MAVLink_param_request_list_message(1, 1))
    field.run(0.02)
    two.send(dialect.MAVLink_param_request_list_message(1, 1))
    field.run(3.0)
    size = len(field.autopilot.parameters)
    for client in (one, two):
        indices = [m.param_index for m in client.received("PARAM_VALUE")]
        assert [i for i in indices if i != 65_535] == list(range(size))


def test_a_changed_parameter_and_texts_reach_everybody(field: Field) -> None:
    everyone = [field.hub.client(None), field.hub.client(1), RawClient(field.onboard)]
    everyone[1].send(heartbeat())
    field.run(0.1)
    for client in everyone:
        client.received()
    name = field.autopilot.parameters.by_index(3)
    assert name is not None
    kind = 6 if isinstance(name.value, int) else 9
    raw = dialect.MAVLink_param_set_message(1, 1, name.name.encode(), 0.0, kind)
    everyone[1].send(raw)
    everyone[1].command(400, 1e30)  # refused, with a text
    field.tick()
    for client in everyone:
        seen = client.count()
        assert seen["PARAM_VALUE"] == 1
        assert seen["STATUSTEXT"] > 0


def test_noise_makes_nobody_a_client(field: Field) -> None:
    field.hub.lane(("127.0.0.1", 9)).inbox.append(b"\xfd\x09garbage of no use to anybody")
    field.run(1.0)
    assert field.hub.lane(("127.0.0.1", 9)).take() == []
    assert field.server.counters()["gcs"].malformed == 1


def test_who_is_silent_for_long_is_forgotten_and_welcome_again(field: Field) -> None:
    client = field.hub.client(1)
    client.command(SET_INTERVAL, ATTITUDE, 1e6)
    field.run(1.0)
    field.server._links[0].forget_silent(field.autopilot.time_us + clients.SILENT_US)
    client.received()
    before = field.server.counters()["gcs"]
    field.run(1.0)
    assert client.received() == []
    assert field.hub.client(None).count()["ATTITUDE"] > 0  # the preset remote stays
    assert before.rx == field.server.counters()["gcs"].rx >= 1
    client.send(heartbeat())
    field.run(1.0)
    assert client.count()["ATTITUDE"] == pytest.approx(50, abs=1)  # the default again


def test_clients_are_bounded_and_those_that_live_stay(field: Field) -> None:
    old = [field.hub.client(port) for port in range(1, clients.MAX_CLIENTS + 1)]
    for client in old:
        client.send(heartbeat())
    field.tick()
    newcomers = (field.hub.client(port) for port in count(1_000))

    def crowd() -> None:
        for _ in range(4):  # each from a separate address
            next(newcomers).send(heartbeat())

    beats = count()

    def crowd_and_live() -> None:
        if next(beats) % 250 == 0:
            for client in old[1:]:  # the first falls silent
                client.send(heartbeat())
        crowd()

    field.run(6.0, crowd_and_live)
    for client in old:
        client.endpoint.take()
    field.run(1.0, crowd_and_live)
    attitude = dialect.MAVLINK_MSG_ID_ATTITUDE.to_bytes(3, "little")
    seen = [sum(f[7:10] == attitude for f in client.endpoint.take()) for client in old]
    assert seen == [0, *[50] * (clients.MAX_CLIENTS - 1)]
    assert len(list(field.server._links[0])) == clients.MAX_CLIENTS + 1
    assert field.server.counters()["gcs"].dropped > 6_000


# --- floods


def flood(
    hub: MemoryHub, per_tick: int, message: dialect.MAVLink_message | None = None
) -> Callable[[], object]:
    """Return what sends a message again and again; by default one that is answered."""
    talker = hub.client(66)
    frame = talker.pack(message or dialect.MAVLink_param_request_read_message(1, 1, b"", 0))

    def send() -> None:
        for _ in range(per_tick):
            talker.endpoint.inbox.append(frame)

    return send


def quiet_flight(seconds: float) -> list[bytes]:
    """Return all frames to a sole onboard client, which sends requests in flight."""
    return flight(Field(), seconds, lambda: None)


def flight(field: Field, seconds: float, each: Callable[[], object]) -> list[bytes]:
    asker = RawClient(field.onboard)
    ticks = count()

    def both() -> None:
        each()
        if next(ticks) % 50 == 0:
            asker.command(REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_SYS_STATUS)

    field.run(seconds, both)
    return field.onboard.take()


@pytest.mark.parametrize(("per_tick", "seconds"), [(16, 3.0), (400, 1.0)])
def test_a_flood_on_one_link_leaves_the_other_alone(per_tick: int, seconds: float) -> None:
    """4,000 and 100,000 datagrams a second."""
    field = Field()
    assert flight(field, seconds, flood(field.hub, per_tick)) == quiet_flight(seconds)
    counters = field.server.counters()["gcs"]
    assert counters.rx <= seconds * FRAMES_PER_S + BURST_FRAMES + 1
    assert counters.rx + counters.dropped + len(field.hub.arrived) == per_tick * round(
        seconds * 250
    )
    # And its own link: another client there is answered in the tick after the flood at the latest.
    field.hub.arrived.clear()
    other = field.hub.client(7)
    other.command(400, 1)
    field.tick()
    assert len(other.received("COMMAND_ACK")) == 1


def test_a_flood_of_broadcasts_is_passed_on_at_a_bounded_rate() -> None:
    field = Field()
    RawClient(field.onboard).send(heartbeat())  # registers the client as a recipient
    talker, numbers = field.hub.client(66), count()

    def everything() -> None:
        for _ in range(16):
            talker.send(dialect.MAVLink_ping_message(next(numbers), 1, 0, 0))

    frames = flight(field, 3.0, everything)
    ours = [frame for frame in frames if frame[5] == 1]
    assert len(frames) - len(ours) <= (3 + 1) * clients.FORWARDS_PER_S + 1
    assert ours == quiet_flight(3.0)


class CostlyClock(SimClock):
    """Every look at it finds that a fixed time has passed: a slow host."""

    def __init__(self, cost_us: int) -> None:
        super().__init__()
        self._cost_us = cost_us

    def time_us(self) -> int:
        self.advance(self._cost_us)
        return super().time_us()


@pytest.mark.parametrize("late", [False, True])
def test_what_arrives_takes_no_more_than_its_share_of_a_tick(late: bool) -> None:
    clock = CostlyClock(30)
    field = Field(clock)
    if late:
        clock.advance(1_000 * TICK_US)
    allowed_us = clients.LISTEN_US + (0 if late else clients.IDLE_LISTEN_US)
    everything = flood(field.hub, 400)
    worst_us = 0
    for _ in range(100):
        everything()
        began_us = clock.time_us()
        # Any number of times before the tick, as the pacing calls it when a socket is readable.
        for _ in range(3):
            field.server.receive(field.autopilot.time_us)
        worst_us = max(worst_us, clock.time_us() - began_us)
        field.autopilot.step()
        field.server.send(field.autopilot.time_us)
    # One datagram too many, and in each call two looks at either link.
    assert worst_us <= allowed_us + 30 * (1 + 3 * 4)
    assert field.server.counters()["gcs"].rx >= min(100 * allowed_us / 30 / 2, BURST_FRAMES)


@pytest.mark.parametrize("cost_us", [100, 250])
def test_on_a_slow_host_nothing_waits_while_there_is_time(
    cost_us: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty clients command at 50 Hz: 4 commands a tick, 1 ms of 4 where one takes 250 us."""
    clock = SimClock()
    field = Field(clock)
    dispatch = MavlinkServer._dispatch

    def slow(this: MavlinkServer, sender: clients.Client, message: WireMessage) -> bool:
        clock.advance(cost_us)
        return dispatch(this, sender, message)

    monkeypatch.setattr(MavlinkServer, "_dispatch", slow)
    talkers = [field.hub.client(n, (100 + n, 190)) for n in range(20)]
    late_us = 0
    for tick in range(250):
        if tick % 5 == 0:
            for talker in talkers:
                talker.command(REQUEST_MESSAGE, ATTITUDE)
        # Twice: as soon as something arrives, and when the tick begins.
        field.server.receive(field.autopilot.time_us)
        clock.sleep_until(max(clock.time_us(), field.autopilot.time_us))
        field.server.receive(field.autopilot.time_us)
        late_us = max(late_us, clock.time_us() - field.autopilot.time_us)
        field.autopilot.step()
        field.server.send(field.autopilot.time_us)
    assert [len(talker.received("COMMAND_ACK")) for talker in talkers] == [50] * 20
    assert late_us <= clients.LISTEN_US + cost_us


def test_an_allowance_is_a_rate_and_a_burst() -> None:
    allowance = Allowance(per_s=1_000, burst=10)
    taken = 0
    for now_us in range(0, US_PER_S, 100):
        while allowance.left(now_us):
            allowance.take(1, now_us)
            taken += 1
    assert taken == pytest.approx(1_010, abs=1)
    allowance.take(5_000, US_PER_S)  # a datagram of many frames
    assert not allowance.left(5 * US_PER_S)
    assert allowance.left(6 * US_PER_S + 20_000)
    allowance.renew()
    assert allowance.left(0)

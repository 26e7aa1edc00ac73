"""The words that pass turns, and the vehicle's end of a turn against a companion of the test's."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.addons.remote_lockstep.token_partner import TokenCamera, TokenPartner, Wire
from airl_mav.addons.remote_lockstep.turns import PhaseToken, TurnBack, TurnGiven
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import validated
from airl_mav.core.signing import StoredSigning, write_key
from airl_mav.lockstep.conductor import Inbound
from airl_mav.lockstep.turns import LockstepError, Turn
from airl_mav.rehearsal.episode import Order
from airl_mav.scenario.stand_alone import StandAloneVehicle, check_vehicle
from firmware_sim.firmware import FrameServer
from firmware_sim.mavlink.codec import Encoder
from firmware_sim.mavlink.endpoint import UdpEndpoint
from tests.support.ports import LOOPBACK

# --- words


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (TurnGiven(3, 1_200_000, 17), "F3 1200000 17"),
        (TurnGiven(1, 100_000), "F1 100000 -1"),
        (TurnGiven(9, 5, 0, "land"), "F9 5 0 land"),
        (TurnBack(4), "D4"),
        (TurnBack(4, 600_000), "D4 600000"),
        (TurnBack(4, 600_000, 12), "D4 600000 12"),
        (TurnBack(4, 600_000, 12, "stop"), "D4 600000 12 stop"),
        (TurnBack(4, ended=True), "D4 end"),
        (PhaseToken(4, "taking off"), "P4 taking off"),
    ],
)
def test_words_are_read_as_written(words: TurnGiven | TurnBack | PhaseToken, text: str) -> None:
    assert words.text() == text
    assert type(words).parse(text) == words


def test_longest_words_fit_a_status_text() -> None:
    day_us = 86_400_000_000
    assert len(TurnGiven(10**7, day_us, 10**7, "abandon").text()) <= 50
    assert len(TurnBack(10**7, day_us, 10**7, "frame").text()) <= 50


@pytest.mark.parametrize(
    "text",
    [
        "",
        "F",
        "F1",
        "F1 2",
        "F1 2 3 up",
        "Failsafe activated",
        "D",
        "D1 x",
        "Disarmed",
        "P1",
        "P1 \x1b[2J",
    ],
)
def test_other_texts_are_no_words(text: str) -> None:
    assert TurnGiven.parse(text) is None
    assert TurnBack.parse(text) is None
    assert PhaseToken.parse(text) is None


# --- the vehicle's end of a turn


class NoCamera:
    """Implements FrameServer."""

    transport_us = None

    awaited = True

    endpoint = ""

    def publish(self, frame: Any) -> None:
        """Discard the frame."""

    def close(self) -> None:
        """Nothing to do."""


def mav_of(key: bytes | None) -> Any:
    """Return pymavlink's end of a link, which signs, and demands signatures, where it has a key."""
    mav = dialect.MAVLink(None, 245, 191)
    mav.robust_parsing = True
    if key is not None:
        mav.signing.secret_key = key
        mav.signing.link_id = 3
        mav.signing.timestamp = int((time.time() - 1_420_070_400) * 1e5)
        mav.signing.sign_outgoing = True
    return mav


class Mate:
    """A companion that gives each turn back with the next of some texts."""

    def __init__(self, *texts: str, key: bytes | None = None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((LOOPBACK, 0))
        self.socket.settimeout(0.1)
        self.heard: list[Any] = []
        self.datagrams: list[int] = []
        self._texts = list(texts)
        self._mav = mav_of(key)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def _run(self) -> None:
        number = 0
        while not self._stop.is_set():
            try:
                data, vehicle = self.socket.recvfrom(65_536)
            except TimeoutError:
                continue
            if not self.heard:
                self._send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), vehicle)
            self.datagrams.append(len(data))
            messages = self._mav.parse_buffer(data)
            self.heard += messages
            for text in (m.text for m in messages if m.get_type() == "STATUSTEXT"):
                given = TurnGiven.parse(text)
                if given is not None and given.number > number and self._texts:
                    number = given.number
                    answer = dialect.MAVLink_statustext_message(7, self._texts.pop(0).encode())
                    self._send(answer, vehicle)

    def _send(self, message: Any, vehicle: Any) -> None:
        self.socket.sendto(message.pack(self._mav), vehicle)

    def kinds(self) -> list[str]:
        return [m.text if m.get_type() == "STATUSTEXT" else m.get_type() for m in self.heard]

    def close(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self.socket.close()


@contextmanager
def wired(
    mate: Mate, stored: StoredSigning | None = None, say: Any = lambda _: None
) -> Iterator[tuple[Wire, Any]]:
    """Give the vehicle's end, and its address."""
    remote = mate.socket.getsockname()
    with (
        closing(
            UdpEndpoint((LOOPBACK, 0), remote, local_option="local", remote_option="remote")
        ) as endpoint,
        closing(mate),
        closing(Wire(endpoint, stored, say)) as wire,
    ):
        yield wire, endpoint.local


@contextmanager
def partner(mate: Mate, **settings: Any) -> Iterator[TokenPartner]:
    server: FrameServer = NoCamera()
    with (
        wired(mate) as (wire, _),
        closing(TokenPartner(wire, TokenCamera(server, 0), **settings)) as made,
    ):
        made.send([heartbeat()])
        yield made


def heartbeat() -> bytes:
    return Encoder().pack(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3))


NOW_US = 100_000


@pytest.mark.parametrize(
    ("text", "wake_us", "sent"),
    [
        ("D1", NOW_US + 20_000, 0),
        ("D1 600000", 600_000, 0),
        ("D1 600000 7", 600_000, 7),
        ("D1 99000000 7", NOW_US + 1_000_000, 7),
    ],
)
def test_turn_back_says_when_the_next_one_comes(text: str, wake_us: int, sent: int) -> None:
    mate = Mate(text)
    mate.start()
    with partner(mate) as vehicle:
        assert vehicle.turn(NOW_US, lambda _: None) == Turn(wake_us, None, sent)


def test_turn_period_is_an_option() -> None:
    mate = Mate("D1")
    mate.start()
    with partner(mate, turn_us=5_000) as vehicle:
        assert vehicle.turn(NOW_US, lambda _: None).wake_us == NOW_US + 5_000


@pytest.mark.parametrize(
    ("text", "accepted"),
    [
        ("D1 100000", "a time after now"),
        ("D2 600000", "accepted: D1"),
        ("D1 soon", r"accepted: D<turn> \["),
    ],
)
def test_words_that_make_no_sense_are_refused(text: str, accepted: str) -> None:
    mate = Mate(text)
    mate.start()
    with partner(mate) as vehicle, pytest.raises(LockstepError, match=accepted) as refused:
        vehicle.turn(NOW_US, lambda _: None)
    assert text in str(refused.value)


def test_end_of_the_companion_is_answered() -> None:
    mate = Mate("D1 end")
    mate.start()
    with partner(mate) as vehicle:
        assert vehicle.turn(NOW_US, lambda _: None).wake_us is None
        deadline = time.monotonic() + 10.0
        while "F2 0 -1 end" not in mate.kinds():
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_nothing_but_heartbeats_before_the_companion_is_there() -> None:
    """Telemetry waits for it, and comes in order, in few datagrams, before the turn."""
    mate = Mate("D1")
    encoder = Encoder()
    pings = [encoder.pack(dialect.MAVLink_ping_message(i, i, 0, 0)) for i in range(100)]
    with partner(mate) as vehicle:
        for ping in pings:
            vehicle.send([ping])
        waiter = threading.Thread(target=vehicle.turn, args=(NOW_US, lambda _: None))
        waiter.start()
        time.sleep(0.3)  # it comes late: several heartbeats lie in its socket
        mate.start()
        waiter.join(10.0)
        assert not waiter.is_alive()
    kinds = mate.kinds()
    while kinds[0] == "HEARTBEAT" and kinds[1] == "HEARTBEAT":
        del kinds[0]
    assert kinds[0] == "HEARTBEAT"  # the one of the telemetry
    assert kinds[1:101] == ["PING"] * 100
    assert kinds[101] == "F1 100000 -1"
    pinged = [m.seq for m in mate.heard if m.get_type() == "PING"]
    assert pinged[:100] == list(range(100))
    assert max(mate.datagrams) <= 1400
    assert sum(1 for size in mate.datagrams if size > 100) <= 10


def test_answers_are_not_repeated() -> None:
    """A second COMMAND_ACK would be taken for the answer to the next command of that kind."""
    mate = Mate()
    mate.start()
    answer = Encoder().pack(dialect.MAVLink_command_ack_message(400, 0))
    with (
        partner(mate, patience_s=0.5) as vehicle,
        pytest.raises(LockstepError, match="the companion is gone"),
    ):
        vehicle.turn(NOW_US, lambda _: vehicle.send([answer]))
    kinds = mate.kinds()
    assert kinds.count("F1 100000 -1") >= 3
    assert kinds.count("COMMAND_ACK") == 1


def test_wait_for_a_companion_can_be_broken_off() -> None:
    stop = threading.Event()
    with partner(Mate(), broken_off=stop.is_set) as vehicle:
        threading.Timer(0.3, stop.set).start()
        assert vehicle.turn(NOW_US, lambda _: None).wake_us is None


def test_order_ends_a_sleep_that_asks_for_it() -> None:
    mate = Mate("D1 600000 0 stop", "D2 700000 0")
    mate.start()
    with partner(mate) as vehicle:
        turn = vehicle.turn(NOW_US, lambda _: None)
        assert turn.interrupt is not None
        assert not turn.interrupt.is_set()
        vehicle.order(Order.LAND)
        assert turn.interrupt.is_set()
        assert vehicle.turn(300_000, lambda _: None) == Turn(700_000, None, 0)
    assert "F2 300000 -1 land" in mate.kinds()


def test_phases_are_told_once() -> None:
    told: list[tuple[str, int]] = []
    mate = Mate("P1 arming")
    mate.start()

    def note(name: str, time_us: int) -> None:
        told.append((name, time_us))

    with (
        partner(mate, patience_s=0.5, phase=note) as vehicle,
        pytest.raises(LockstepError, match="the companion is gone"),
    ):
        vehicle.turn(NOW_US, lambda _: None)
    assert told == [("arming", NOW_US)]


# --- unauthenticated clients


KEY = bytes(range(5, 37))


class Stranger:
    """Another client on the onboard link, with a key or without."""

    def __init__(self, vehicle: Any, key: bytes | None = None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((LOOPBACK, 0))
        self.socket.settimeout(0.2)
        self._vehicle, self._mav = vehicle, mav_of(key)

    def say(self, text: str) -> None:
        self.send(dialect.MAVLink_statustext_message(7, text.encode()))

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self._mav), self._vehicle)

    def hears_nothing(self) -> bool:
        try:
            self.socket.recv(4096)
        except TimeoutError:
            return True
        return False

    def close(self) -> None:
        self.socket.close()


def land() -> Any:
    return dialect.MAVLink_command_long_message(1, 1, 21, 0, 0, 0, 0, 0, 0, 0, 0)


def test_who_gave_the_first_turn_back_is_the_companion() -> None:
    """Another program on its port ends no flight, commands nothing and is sent nothing."""
    told: list[str] = []
    handled: list[bytes] = []
    mate = Mate("D1 200000 0", "D2 300000 0", "D3 400000 0")
    mate.start()
    with (
        wired(mate, say=told.append) as (wire, vehicle),
        closing(TokenPartner(wire, TokenCamera(NoCamera(), 0))) as made,
        closing(Stranger(vehicle)) as other,
    ):
        made.send([heartbeat()])
        assert made.turn(NOW_US, lambda _: None).wake_us == 200_000
        for text in ("D2 end", "D2 soon", "D99 900000", "P2 navigating"):
            other.say(text)
        other.send(land())
        other.socket.sendto(b"\xfd" * 300, vehicle)
        assert made.turn(200_000, lambda frame: handled.append(frame)).wake_us == 300_000
        made.send([heartbeat()])
        assert other.hears_nothing()
        assert made.turn(300_000, lambda frame: handled.append(frame)).wake_us == 400_000
        assert wire.foreign == 6
    assert [f for f in handled if int.from_bytes(f[7:10], "little") != 0] == []
    assert any("not the companion's" in line for line in told)


@pytest.fixture
def stored(tmp_path: Path) -> StoredSigning:
    path = tmp_path / "key"
    write_key(path, KEY)
    return StoredSigning(path)


def test_turns_pass_signed(stored: StoredSigning) -> None:
    """The vehicle forwards the same bytes as without a key; every frame on the wire is signed."""
    mate = Mate("D1 200000 0", "D2 end", key=KEY)
    mate.start()
    pings = [Encoder().pack(dialect.MAVLink_ping_message(i, i, 0, 0)) for i in range(100)]
    with (
        wired(mate, stored) as (wire, _),
        closing(TokenPartner(wire, TokenCamera(NoCamera(), 0))) as made,
    ):
        made.send([heartbeat(), *pings])
        assert made.turn(NOW_US, lambda _: None).wake_us == 200_000
        assert made.turn(200_000, lambda _: None).wake_us is None
        assert wire.refused == 0
    assert all(m.get_signed() for m in mate.heard)
    assert [m.seq for m in mate.heard if m.get_type() == "PING"][:100] == list(range(100))
    assert max(mate.datagrams) <= 1400


@pytest.mark.parametrize("key", [None, bytes(32 * [9])], ids=["unsigned", "wrong key"])
def test_without_the_key_no_turn_is_given_back(key: bytes | None, stored: StoredSigning) -> None:
    told: list[str] = []
    stop = threading.Event()
    with (
        wired(Mate(), stored, told.append) as (wire, vehicle),
        closing(TokenPartner(wire, TokenCamera(NoCamera(), 0), broken_off=stop.is_set)) as made,
        closing(Stranger(vehicle, key)) as other,
    ):
        made.send([heartbeat()])
        other.say("D1 200000 0")
        other.send(land())
        other.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        threading.Timer(0.3, stop.set).start()
        assert made.turn(NOW_US, lambda _: None).wake_us is None
        assert made.turns == 0
        assert wire.refused == 3
        assert other.hears_nothing()
    assert "bad signature" in told[0]


def test_a_replayed_turn_is_refused(stored: StoredSigning) -> None:
    with (
        wired(Mate(), stored) as (wire, vehicle),
        closing(Stranger(vehicle, KEY)) as mate,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as thief,
    ):
        frame = dialect.MAVLink_statustext_message(7, b"D1 end").pack(mate._mav)
        mate.socket.sendto(frame, vehicle)
        thief.sendto(frame, vehicle)
        assert [each.message.text for each in _arrived(wire)] == ["D1 end"]
        assert wire.refused == 1


def _arrived(wire: Wire) -> list[Any]:
    time.sleep(0.05)  # both lie in the socket's buffer then
    return wire.receive()


def test_the_key_of_the_start_stays() -> None:
    """SETUP_SIGNING would have the vehicle sign within the flight, by the calendar."""
    setup = dialect.MAVLink_setup_signing_message(1, 1, list(KEY), 1)
    passed = Inbound().take(setup.pack(mav_of(None)), NOW_US)
    assert passed.deliver == ()


# --- options


@pytest.mark.parametrize(
    "options",
    [
        {"transport_ms": -1.0},
        {"turn_us": 0},
        {"turn_us": 2_000_000},
        {"companion_timeout": 0.0},
        {"goal_radius_m": 0.0},
        {"time_limit_s": 0.0},
        {"speed": 0.01},
    ],
    ids=str,
)
def test_options_out_of_range_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(FieldError) as refused:
        check_vehicle(validated(StandAloneVehicle, {"lockstep": True, **options}))
    assert refused.value.field == next(iter(options))


@pytest.mark.parametrize(("speed", "paced"), [(None, None), ("max", None), (2.0, 2.0)])
def test_pace_is_as_fast_as_it_goes_unless_asked(speed: Any, paced: float | None) -> None:
    assert StandAloneVehicle(lockstep=True, speed=speed).pace == paced

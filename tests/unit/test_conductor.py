"""Order of events between a vehicle and a companion whose parts here are scripted."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from airl_mav.core.constants import TICK_US
from airl_mav.lockstep.conductor import (
    FEED_US,
    NOTHING,
    SHOWN_US,
    SILENCE_US,
    Conductor,
    Inbound,
)
from airl_mav.lockstep.turns import FlightDigest, Handle, Turn
from airl_mav.lockstep.vehicle import VehicleEnd
from companion.watchdog import Poll
from firmware_sim.interfaces import FirmwareLostError
from firmware_sim.mavlink import codec
from firmware_sim.mavlink.codec import dialect


class Vehicle(VehicleEnd):
    """Vehicle that sends one text per tick, and acknowledges commands at once or later."""

    def __init__(self, answers_later: bool = False) -> None:
        self.answers_later = answers_later
        self.encoder = codec.Encoder(1, 1)
        self.out: list[bytes] = []
        self.read: list[tuple[bytes, bool]] = []
        self.expected: list[bool] = []
        self.settled = 0

    def say(self, text: bytes) -> None:
        self.out.append(self.encoder.pack(dialect.MAVLink_statustext_message(6, text)))

    def acknowledge(self, command: int) -> None:
        self.out.append(
            self.encoder.pack(dialect.MAVLink_command_ack_message(command, 0, 0, 0, 245, 190))
        )

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        self.read.append((frame, echo))
        carry_out()

    def take(self) -> list[bytes]:
        out, self.out = self.out, []
        return out

    def after_tick(self, *, expected: bool) -> list[bytes]:
        self.expected.append(expected)
        return self.take()

    def settle(self) -> None:
        self.settled += 1


class Companion:
    """Companion whose turns are scripted; records what it gets and when."""

    def __init__(self, *turns: Callable[[int, Handle], Turn]) -> None:
        self.script = list(turns)
        self.log: list[Any] = []

    def send(self, frames: Sequence[bytes]) -> None:
        self.log.append(len(frames))

    def turn(self, now_us: int, handle: Handle) -> Turn:
        self.log.append(("turn", now_us))
        return self.script.pop(0)(now_us, handle)


class Sdk:
    """MAVSDK's frames."""

    def __init__(self) -> None:
        self.encoder = codec.Encoder(245, 190)

    def setpoint(self, forward: float) -> bytes:
        zeros = (0.0,) * 3
        return self.encoder.pack(
            dialect.MAVLink_set_position_target_local_ned_message(
                *(0, 1, 1, 8, 1479, *zeros, forward, 0.0, 0.0, *zeros, 0.0, 0.0)
            )
        )

    def command(self, number: int, *params: float) -> bytes:
        filled = [*params, *[math.nan] * (7 - len(params))]
        return self.encoder.pack(dialect.MAVLink_command_long_message(1, 1, number, 0, *filled))


def wakes(at_us: int | None, **more: Any) -> Callable[[int, Handle], Turn]:
    return lambda now_us, handle: Turn(at_us, **more)


def ticks(conductor: Conductor, first: int, last: int) -> None:
    for tick in range(first, last + 1):
        assert conductor.wait(tick * TICK_US, (), lambda _: None) == tick * TICK_US
        assert conductor.clock.time_us() == tick * TICK_US


def test_frames_that_are_no_messages_are_dropped() -> None:
    for frame in (b"", b"noise", b"\xfd" + bytes(20)):
        assert Inbound().take(frame, 0) == NOTHING


def test_turns_come_at_their_times_with_all_telemetry_before() -> None:
    vehicle, companion = Vehicle(), Companion(wakes(30_000), wakes(31_000), wakes(None))
    conductor = Conductor(vehicle, companion)
    conductor.begin(10_000)
    vehicle.say(b"one")
    ticks(conductor, 1, 2)
    assert companion.log == []
    vehicle.say(b"two")
    ticks(conductor, 3, 7)
    assert companion.log == [2, ("turn", 10_000)]
    ticks(conductor, 8, 9)
    assert companion.log[2:] == [("turn", 30_000), ("turn", 31_000)]
    assert conductor.ended
    assert conductor.next_us == math.inf
    assert vehicle.settled == 3
    assert vehicle.expected == [False] * 9


def test_telemetry_is_forwarded_without_turns_once_a_second() -> None:
    vehicle, companion = Vehicle(), Companion()
    conductor = Conductor(vehicle, companion)
    conductor.begin(10_000_000)
    for tick in range(1, 2 * FEED_US // TICK_US + 2):
        vehicle.say(b"t")
        ticks(conductor, tick, tick)
    # The frames of a tick are as old as its start.
    assert companion.log == [FEED_US // TICK_US + 1, FEED_US // TICK_US]


def test_a_silent_vehicle_is_lost() -> None:
    vehicle = Vehicle()
    conductor = Conductor(vehicle, Companion())
    conductor.begin(10_000_000)
    vehicle.say(b"t")
    ticks(conductor, 1, 1)
    conductor.clock.sleep_until(SILENCE_US)
    assert conductor.heard
    conductor.clock.sleep_until(SILENCE_US + 1)
    assert not conductor.heard


def test_setpoints_repeat_between_turns_and_the_turn_goes_first() -> None:
    sdk, vehicle = Sdk(), Vehicle()

    def sends(now_us: int, handle: Handle) -> Turn:
        assert handle(sdk.setpoint(1.0)) is None
        assert handle(sdk.setpoint(1.0)) is None
        return Turn(60_000, setpoints_sent=1)

    def again(now_us: int, handle: Handle) -> Turn:
        times.append(len(vehicle.read))
        # The same setpoint on purpose: it counts.
        assert handle(sdk.setpoint(1.0)) is None
        return Turn(1_000_000, setpoints_sent=2)

    times: list[int] = []
    conductor = Conductor(vehicle, Companion(sends, again))
    conductor.begin(10_000)
    ticks(conductor, 1, 3)
    assert len(vehicle.read) == 1
    assert conductor.next_us == 60_000.0
    ticks(conductor, 4, 15)
    assert times == [1], "at equal times the turn comes before the repetition"
    assert len(vehicle.read) == 2
    assert conductor.next_us == 110_000.0
    conductor.arrive(160_000)
    assert len(vehicle.read) == 4
    assert conductor.next_us == 210_000.0
    assert all(echo for _, echo in vehicle.read)


def test_the_digest_has_the_flight_alone() -> None:
    sdk, vehicle = Sdk(), Vehicle()
    frames: list[bytes] = []

    class Noted(FlightDigest):
        def add(self, lane: str, time_us: int, data: bytes) -> None:
            assert lane == "commands"
            frames.append(data)

    def sends(now_us: int, handle: Handle) -> Turn:
        handle(sdk.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 20_000))
        handle(sdk.setpoint(1.0))
        return Turn(1_000_000, setpoints_sent=1)

    conductor = Conductor(vehicle, Companion(sends), Noted())
    conductor.begin(4_000)
    ticks(conductor, 1, 1)
    assert len(vehicle.read) == 2
    assert frames == [vehicle.read[1][0]]


def test_a_command_without_an_answer_yet_blocks_and_then_ends_the_flight() -> None:
    sdk, vehicle = Sdk(), Vehicle(answers_later=True)
    number = dialect.MAV_CMD_COMPONENT_ARM_DISARM
    events: list[threading.Event] = []

    def arms(now_us: int, handle: Handle) -> Turn:
        event = handle(sdk.command(number, 1.0))
        assert event is not None
        assert not event.is_set()
        events.append(event)
        return Turn(now_us + 100_000, interrupt=event)

    companion = Companion(arms, arms, wakes(None))
    conductor = Conductor(vehicle, companion)
    conductor.begin(10_000)
    ticks(conductor, 1, 4)
    vehicle.say(b"no answer")
    ticks(conductor, 5, 5)
    assert not events[0].is_set()
    assert conductor.quiet_until_us == 0.0
    assert vehicle.expected == [False] * 3 + [True] * 2
    assert vehicle.read[0][1] is False
    vehicle.acknowledge(number)
    # The answer interrupts the companion's sleep: its next turn begins at the start of a tick.
    ticks(conductor, 6, 6)
    assert events[0].is_set() is False, "the second command waits for its own answer"
    assert companion.log[-1] == ("turn", 5 * TICK_US)
    with pytest.raises(FirmwareLostError, match=f"did not answer command {number}"):
        ticks(conductor, 7, 60)


def test_how_long_the_vehicle_may_run_alone() -> None:
    vehicle = Vehicle()
    interrupt = threading.Event()
    conductor = Conductor(vehicle, Companion(wakes(900_000, interrupt=interrupt)))
    assert conductor.quiet_until_us == 0.0
    conductor.begin(10_000)
    assert conductor.quiet_until_us == 10_000.0
    ticks(conductor, 1, 3)
    assert conductor.quiet_until_us == 900_000.0
    conductor.orders_us = lambda: 500_000.0
    assert conductor.quiet_until_us == 500_000.0
    conductor.orders_us = lambda: math.inf
    conductor.is_shown = True
    assert conductor.quiet_until_us == 3 * TICK_US + SHOWN_US
    conductor.is_shown = False
    interrupt.set()
    assert conductor.quiet_until_us == 0.0
    interrupt.clear()
    conductor.suspend()
    assert conductor.quiet_until_us == 0.0
    conductor.resume()
    assert conductor.quiet_until_us == 900_000.0


@pytest.mark.parametrize(
    ("quiet_us", "until_us"),
    [(0.0, 20_000), (10_000.0, 20_000), (50_000.0, 60_000), (math.inf, math.inf)],
)
def test_a_condition_lets_the_vehicle_run_up_to_the_last_check(
    quiet_us: float, until_us: float
) -> None:
    poll = Poll(10_000, lambda frames: False, lambda frames: quiet_us)
    conductor = Conductor(Vehicle(), Companion(wakes(20_000, poll=poll)))
    conductor.begin(4_000)
    ticks(conductor, 1, 1)
    assert conductor.quiet_until_us == until_us


def test_a_condition_that_fails_costs_no_turn() -> None:
    met: list[bool] = []
    poll = Poll(10_000, lambda frames: bool(met), None)
    companion = Companion(wakes(20_000, poll=poll), wakes(None))
    conductor = Conductor(Vehicle(), companion)
    conductor.begin(4_000)
    ticks(conductor, 1, 14)
    assert companion.log == [("turn", 4_000)]
    met.append(True)
    ticks(conductor, 15, 15)
    assert companion.log == [("turn", 4_000), ("turn", 60_000)]


def test_a_suspended_companion_gets_the_overdue_turn() -> None:
    companion = Companion(wakes(20_000), wakes(None))
    conductor = Conductor(Vehicle(), companion)
    conductor.begin(4_000)
    ticks(conductor, 1, 2)
    conductor.suspend()
    ticks(conductor, 3, 9)
    assert companion.log == [("turn", 4_000)]
    conductor.resume()
    ticks(conductor, 10, 10)
    assert companion.log[1] == ("turn", 36_000), "at the start of the newest tick"


def test_a_paced_flight_takes_its_wall_time() -> None:
    conductor = Conductor(Vehicle(), Companion(), speed=10.0)
    assert conductor.is_shown
    conductor.begin(10_000_000)
    conductor.restart(1_000_000)
    assert conductor.clock.time_us() == 1_000_000
    began = time.monotonic()
    for tick in range(251, 301):
        conductor.wait(tick * TICK_US, (), lambda _: None)
    # 0.2 s at ten times the wall clock.
    assert time.monotonic() - began >= 0.018
    assert conductor.read_by(5) == 5


def test_telemetry_is_as_old_as_the_start_of_its_tick() -> None:
    vehicle = Vehicle()
    conductor = Conductor(vehicle, Companion())
    conductor.begin(10_000_000)
    vehicle.say(b"t")
    conductor.wait(400_000, (), lambda _: None)
    conductor.clock.sleep_until(396_000 + SILENCE_US)
    assert conductor.heard
    conductor.clock.sleep_until(396_000 + SILENCE_US + 1)
    assert not conductor.heard


def test_checks_that_were_passed_over_are_not_made_later() -> None:
    poll = Poll(10_000, lambda frames: True, lambda frames: math.inf)
    companion = Companion(wakes(20_000, poll=poll), wakes(None))
    conductor = Conductor(Vehicle(), companion)
    conductor.begin(4_000)
    ticks(conductor, 1, 1)
    conductor.wait(400_000, (), lambda _: None)
    assert companion.log == [("turn", 4_000), ("turn", 400_000)]


def test_a_condition_that_forwarded_telemetry_meets_stays_met() -> None:
    vehicle = Vehicle()
    poll = Poll(10_000, lambda frames: len(frames) > 0, None)
    companion = Companion(wakes(FEED_US + 50_000, poll=poll), wakes(None))
    conductor = Conductor(vehicle, companion)
    conductor.begin(4_000)
    ticks(conductor, 1, 1)
    first = FEED_US // TICK_US + 2
    for tick in range(2, first + 20):
        if tick <= first:
            vehicle.say(b"t")
        ticks(conductor, tick, tick)
    assert companion.log[-1] == ("turn", FEED_US + 50_000)

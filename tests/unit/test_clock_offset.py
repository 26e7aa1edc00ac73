"""Clock offset from message exchanges: the error is within the bound for any delay."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as dialect

from airl_mav.addons.profiling.hil import (
    GREATEST_DRIFT,
    LEAST_EXCHANGES,
    ClockError,
    Exchanges,
    TimesyncLink,
    best_reading,
    relate,
)
from airl_mav.core.clock import NS_PER_US, WallClock
from tests.support.mavlink_clients import wait_for
from tests.support.ports import LOOPBACK, free_ports

Delays = Callable[[np.random.Generator, int], NDArray[np.float64]]
Remote = Callable[[NDArray[np.float64]], NDArray[np.float64]]

DELAYS: dict[str, Delays] = {
    "none": lambda rng, n: np.zeros(n),
    "constant": lambda rng, n: np.full(n, 150.0),
    "exponential": lambda rng, n: rng.exponential(300.0, n),
    "heavy": lambda rng, n: 80.0 + 100.0 * rng.pareto(1.1, n),
    "two kinds": lambda rng, n: np.where(rng.random(n) < 0.7, 4_000.0, 90.0) + rng.random(n),
}
"""Ways of a message to be late [µs]; never less than zero."""


def asked(
    rng: np.random.Generator,
    remote: Remote,
    start_us: float,
    n: int,
    interval_us: float,
    there: Delays,
    back: Delays,
) -> Exchanges:
    """Exchange times between two clocks that cut off below a microsecond."""
    sent = start_us + interval_us * np.arange(n) + rng.random(n)
    arrived = sent + there(rng, n)
    received = arrived + back(rng, n)
    stamps = (np.floor(times).astype(np.int64) for times in (sent, remote(arrived), received))
    return Exchanges(*stamps)


def clock(offset_us: float, drift: float) -> Remote:
    """Return a clock that is ahead and gains."""
    return lambda own_us: own_us + offset_us + drift * own_us


def flown(
    seed: int, remote: Remote, there: str = "exponential", back: str = "exponential"
) -> tuple[Exchanges, Exchanges, Exchanges]:
    """Exchanges before, during and after a flight of a minute."""
    rng = np.random.default_rng(seed)
    ways = DELAYS[there], DELAYS[back]
    return (
        asked(rng, remote, 2e6, 100, 5e3, *ways),
        asked(rng, remote, 3e6, 600, 1e5, *ways),
        asked(rng, remote, 64e6, 100, 5e3, *ways),
    )


TIMES_US = np.linspace(2e6, 66e6, 500)


@pytest.mark.parametrize("back", DELAYS)
@pytest.mark.parametrize("there", DELAYS)
@given(
    seed=st.integers(0, 1_000_000),
    offset_us=st.floats(-1e9, 5e12),
    drift=st.floats(-0.99 * GREATEST_DRIFT, 0.99 * GREATEST_DRIFT),
)
@settings(max_examples=15, deadline=None)
def test_the_error_lies_within_the_bound(
    there: str, back: str, seed: int, offset_us: float, drift: float
) -> None:
    remote = clock(offset_us, drift)
    relation = relate(*flown(seed, remote, there, back))
    within = relation.uncertainty_at(TIMES_US)
    told = remote(TIMES_US)
    # Floats of 5e12 µs are a thousandth of a microsecond apart.
    assert (np.abs(relation.offset_at(TIMES_US) - (told - TIMES_US)) <= within + 0.01).all()
    assert (np.abs(relation.own_time(told) - TIMES_US) <= within * 1.002 + 0.01).all()
    assert abs(relation.drift - drift) <= relation.drift_uncertainty + 1e-9
    assert relation.agreeing == relation.checked == 600


def test_the_bound_is_half_the_least_round_trip() -> None:
    before, between, after = flown(1, clock(1e7, 2e-5), "heavy", "exponential")
    relation = relate(before, between, after)
    for row, reading in ((before, relation.before), (after, relation.after)):
        half_us = row.round_trip_us.min() / 2.0
        assert half_us <= reading.uncertainty_us <= 1.002 * half_us + 1.0
    assert relation.uncertainty_at(relation.before.at_us) == relation.before.uncertainty_us


def test_all_of_the_delay_on_one_way_uses_the_bound_up() -> None:
    """No smaller bound holds when nothing is known of the two ways."""
    remote = clock(1e7, 0.0)
    for there, back in (("constant", "none"), ("none", "constant")):
        relation = relate(*flown(2, remote, there, back))
        in_flight_us = np.linspace(3e6, 63e6, 100)
        error = np.abs(relation.offset_at(in_flight_us) - 1e7)
        assert (error > 0.95 * (relation.uncertainty_at(in_flight_us) - 1.0)).all()


def test_few_quick_answers_among_slow_ones_are_enough() -> None:
    rng = np.random.default_rng(3)

    def slow(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
        return np.where(np.arange(n) % 20 == 7, 60.0, rng.exponential(30_000.0, n) + 5_000.0)

    reading = best_reading(asked(rng, clock(5e6, 0.0), 0.0, 100, 5e3, slow, slow))
    assert reading.uncertainty_us <= 63.0
    assert abs(reading.offset_us - 5e6) <= reading.uncertainty_us


def with_stamp(exchanges: Exchanges, index: int, by_us: int) -> Exchanges:
    """Falsify one answer."""
    remote = exchanges.remote_us.copy()
    remote[index] += by_us
    return Exchanges(exchanges.sent_us, remote, exchanges.received_us)


def test_one_stamp_that_all_others_contradict_is_passed_over() -> None:
    """The one answering was suspended between reading its clock and reading the question."""
    before, between, after = flown(4, clock(1e7, 1e-5))
    best = int(np.argmin(before.round_trip_us))
    relation = relate(with_stamp(before, best, -5_000), with_stamp(between, 5, -9_000), after)
    assert abs(relation.offset_at(3e6) - (1e7 + 30.0)) <= relation.uncertainty_at(3e6)
    assert (relation.checked, relation.agreeing) == (600, 599)


def test_contradictions_are_refused() -> None:
    row, *_ = flown(5, clock(0.0, 0.0))
    told = row.remote_us + 50_000 * np.arange(len(row)) * (-1) ** np.arange(len(row))
    with pytest.raises(ClockError, match="contradict each other"):
        best_reading(Exchanges(row.sent_us, told, row.received_us))


def test_too_few_answers_are_refused() -> None:
    before, between, after = flown(6, clock(0.0, 0.0))
    few = Exchanges(*(column[: LEAST_EXCHANGES - 1] for column in vars(after).values()))
    with pytest.raises(ClockError, match="7 answers in a row, 8 are needed"):
        relate(before, between, few)
    few = Exchanges(*(column[: LEAST_EXCHANGES - 1] for column in vars(between).values()))
    with pytest.raises(ClockError, match="7 answers in between, 8 are needed"):
        relate(before, few, after)


def test_time_that_was_given_up_is_noticed() -> None:
    """A simulator that falls behind by more than 0.2 s sets its clock back."""

    def slipped(own_us: NDArray[np.float64]) -> NDArray[np.float64]:
        return own_us - 200_000.0 * (own_us > 30e6)

    with pytest.raises(ClockError, match=r"gained -3,\d+ ppm"):
        relate(*flown(7, slipped))

    # Made good again before the last exchanges: seen in between.
    def hiccup(own_us: NDArray[np.float64]) -> NDArray[np.float64]:
        return own_us - 20_000.0 * ((own_us > 30e6) & (own_us < 32e6))

    with pytest.raises(ClockError, match="did not run evenly: 20 of 600 exchanges"):
        relate(*flown(8, hiccup, "constant", "constant"))


def test_a_simulator_at_another_speed_is_refused() -> None:
    with pytest.raises(ClockError, match="as if a clock did not keep real time"):
        relate(*flown(9, clock(0.0, 1.0)))
    with pytest.raises(ClockError, match=r"gained \+2,000 ppm, more than any clock of real time"):
        relate(*flown(9, clock(0.0, 2e-3)))


@contextmanager
def autopilot(port: int, ahead_ns: int) -> Iterator[None]:
    """Answer TIMESYNC late, after having waited, and twice; other components answer nonsense."""
    ended = threading.Event()
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    other = dialect.MAVLink(None, srcSystem=1, srcComponent=100)
    received = dialect.MAVLink(None)
    received.robust_parsing = True

    def run() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
            own.bind((LOOPBACK, 0))
            own.settimeout(0.05)

            def send(message: dialect.MAVLink_message, sender: dialect.MAVLink = mav) -> None:
                own.sendto(message.pack(sender), (LOOPBACK, port))

            beat_ns = 0
            while not ended.is_set():
                if time.monotonic_ns() >= beat_ns:
                    beat_ns = time.monotonic_ns() + 200_000_000
                    send(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3))
                    # An independent request, not a response.
                    send(dialect.MAVLink_timesync_message(0, time.monotonic_ns()))
                try:
                    data = own.recv(4096)
                except OSError:
                    continue
                for message in received.parse_buffer(data) or []:
                    kind = message.get_type()
                    if kind == "COMMAND_LONG":
                        send(dialect.MAVLink_command_ack_message(message.command, 0))
                    elif kind == "TIMESYNC" and message.tc1 == 0:
                        send(dialect.MAVLink_timesync_message(77, message.ts1), other)
                        time.sleep(0.002)
                        now_ns = time.monotonic_ns() + ahead_ns
                        answer = dialect.MAVLink_timesync_message(now_ns, message.ts1)
                        send(answer)
                        send(answer)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_mavsdk_asks_and_hears() -> None:
    """Real MAVSDK against pymavlink; both read one clock, so the truth is known."""
    (port,), _ = free_ports(1, 0)
    own = WallClock()
    ahead_ns = 3_600_000_000_000
    stop = threading.Event()
    link = TimesyncLink(f"udpin://{LOOPBACK}:{port}", own)
    with autopilot(port, ahead_ns), closing(link):
        link.connect(20.0)
        link.exchange(40, 0.005, stop)
        before = link.take_exchanges()
        with link.exchanging(0.02):
            wait_for(lambda: len(link._answered) >= LEAST_EXCHANGES)
        between = link.take_exchanges()
        link.exchange(40, 0.005, stop)
        after = link.take_exchanges()
        assert len(link.take_exchanges()) == 0
        stop.set()
        link.exchange(20, 0.005, stop)
        assert len(link.take_exchanges()) == 0
    assert len(before) >= LEAST_EXCHANGES
    # Each question once; the pause before the answer lies within every round trip.
    assert len(np.unique(before.sent_us)) == len(before) <= 40
    assert before.round_trip_us.min() >= 2_000
    truth_us = (own.epoch_ns + ahead_ns) / NS_PER_US
    reading = best_reading(before)
    assert abs(reading.offset_us - truth_us) <= reading.uncertainty_us
    relation = relate(before, between, after)
    times = between.middle_us
    assert (np.abs(relation.offset_at(times) - truth_us) <= relation.uncertainty_at(times)).all()
    assert relation.agreeing == relation.checked

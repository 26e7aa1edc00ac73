"""Simulated time that the host cannot keep up with is skipped, not raced through."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.core.constants import TICK_US
from airl_mav.rehearsal.episode import without_slips
from firmware_sim.pacing import MAX_LAG_US, Unpaced, WallPacing

FAST = 100.0
"""A pause of 10 ms is a lag of a whole simulated second."""


@pytest.fixture
def talking() -> Iterator[list[int]]:
    """A socket with something to read."""
    here, there = socket.socketpair()
    with here, there:
        there.send(b"x")
        yield [here.fileno()]


def never(now_us: int) -> None:
    pytest.fail(f"told of something to read at {now_us}")


def test_a_lag_is_given_up_once() -> None:
    paced = WallPacing(FAST)
    paced.restart(0)
    time.sleep(0.01)
    tick_us = TICK_US
    assert paced.wait(tick_us, [], never) == tick_us
    assert paced.slipped_us > MAX_LAG_US
    # Lag before an episode begins does not count.
    total = paced.slipped_us
    time.sleep(0.01)
    paced.restart(tick_us)
    assert paced.slipped_us == total


def test_what_arrived_while_the_process_was_stopped_is_stamped_after_the_slip(
    talking: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process stopped inside select() wakes up with data, far behind."""
    paced = WallPacing(FAST)
    tick_us = paced.clock.time_us() + 100_000  # 1 ms of wall time ahead
    handed: list[int] = []
    monkeypatch.setattr(select, "select", _stopping(0.02, select.select))
    now_us = paced.wait(tick_us, talking, handed.append)
    assert handed == []
    assert now_us == tick_us
    assert paced.slipped_us > MAX_LAG_US


def _stopping(pause_s: float, real: Any) -> Any:
    def stopped(*args: Any) -> Any:
        time.sleep(pause_s)
        return real(*args)

    return stopped


def test_stamps_never_go_back(talking: list[int]) -> None:
    """Data read before, at and after a slip has times in order."""
    paced = WallPacing(FAST)
    stamps: list[int] = []
    slips = 0
    tick_us = 0
    for pause in [0.0, 0.001, 0.02, 0.0, 0.0015, 0.001, 0.03, 0.0]:
        time.sleep(pause)
        tick_us += TICK_US
        before_us = paced.slipped_us
        stamps.append(paced.wait(tick_us, talking, stamps.append))
        slips += paced.slipped_us > before_us
        # The clock never goes back behind a stamp: later events have later times.
        assert paced.clock.time_us() >= stamps[-1]
    assert stamps == sorted(stamps)
    assert slips >= 2


def test_what_is_read_bears_a_time_from_after_its_arrival() -> None:
    paced = WallPacing(1.0)
    began_us = paced.wait(paced.clock.time_us() + TICK_US, [], never)
    time.sleep(0.002)
    arrived_us = paced.clock.time_us()
    read_us = paced.read_by(began_us)
    assert arrived_us <= read_us <= paced.clock.time_us()
    # Reading again, from an earlier time, does not go back; the next tick's time neither.
    assert paced.read_by(began_us) >= read_us
    assert paced.wait(0, [], never) >= read_us


def test_what_is_read_bears_no_time_that_is_given_up() -> None:
    paced = WallPacing(FAST)
    began_us = paced.wait(paced.clock.time_us() + TICK_US, [], never)
    time.sleep(0.01)
    assert paced.read_by(began_us) == began_us
    assert paced.wait(began_us + TICK_US, [], never) == began_us + TICK_US
    assert Unpaced().read_by(began_us) == began_us


def test_unpaced_time_is_the_tick() -> None:
    free = Unpaced()
    free.restart(8_000)
    assert free.wait(12_000, [], never) == 12_000
    assert free.clock.time_us() == 12_000
    assert free.slipped_us == 0
    assert free.epoch_ns is None


@given(
    st.lists(st.tuples(st.integers(1, 500), st.integers(1, 400)), max_size=5),
    st.lists(st.integers(0, 4000), min_size=1, max_size=20),
)
def test_times_without_slips(gaps: list[tuple[int, int]], times: list[int]) -> None:
    """Against a step-by-step account of the two clocks."""
    # The simulator's clock reaches a tick `gap` after the last one, then stands for `lost`.
    told, slips = [], []
    simulator = 0
    for gap, lost in gaps:
        told += list(range(simulator + 1, simulator + gap + 1))
        simulator += gap
        told += [simulator] * lost
        slips.append((simulator, lost))
    told += list(range(simulator + 1, simulator + 5000))
    table = np.array([0, *told])  # by the companion's clock, which runs on
    raw = np.array(times, np.int64)
    got = without_slips(raw, np.array(slips, np.int64).reshape(-1, 2))
    np.testing.assert_array_equal(got, table[raw])
    assert np.array_equal(raw, times), "the input is left alone"

"""The companion's end of the turns, against a flight controller that follows a script."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest

from airl_mav.addons.remote_lockstep.turns import TokenFrameSource, TokenTurns
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from companion.frame_source import ReceivedFrame
from companion.watchdog import Abandoned, ConductedClock


class ScriptedLink:
    """Answers every text sent with the next ones of a script. Implements `TextLink`."""

    def __init__(self, *script: str) -> None:
        """Each entry: texts with commas between; the first entry is there from the start."""
        self.setpoints_sent = 0
        self.sent: list[str] = []
        self._script = list(script)

    def exchange_texts(self, heard: Callable[[str], None]) -> Callable[[str], None]:
        def answer() -> None:
            for text in self._script.pop(0).split(",") if self._script else ():
                heard(text)

        def send(text: str) -> None:
            self.sent.append(text)
            answer()

        answer()
        return send


class Aboard:
    """A companion with everything that its turns touch."""

    def __init__(self, patience_s: float = 5.0) -> None:
        self.stop, self.abandon = threading.Event(), threading.Event()
        self.turns = TokenTurns(self.stop, self.abandon, patience_s)
        self.clock = ConductedClock(self.turns.clock, self.turns.sleep)


def test_turns_move_the_clock() -> None:
    aboard, link = Aboard(), ScriptedLink("Hello,F1 100000 -1", "F2 300000 4", "F3 400000 -1 end")
    with aboard.turns.taken(link):
        assert aboard.clock.time_us() == 100_000
        link.setpoints_sent = 3
        aboard.clock.sleep_until(300_000)
        assert aboard.clock.time_us() == 300_000
        assert aboard.turns.frame == 4
    assert link.sent == ["D1 300000 3", "D2 end"]


def test_turn_that_comes_too_early_is_given_back_once_more() -> None:
    aboard = Aboard()
    link = ScriptedLink("F1 0 -1", "F2 1000000 -1", "F3 1500000 -1", "F4 0 -1 end")
    with aboard.turns.taken(link):
        aboard.clock.sleep_until(1_500_000)
    assert link.sent == ["D1 1500000 0", "D2 1500000 0", "D3 end"]


def test_words_that_were_lost_are_said_again() -> None:
    """All of the turn: the phase, too. Also the very last ones."""
    aboard = Aboard()
    link = ScriptedLink("F1 0 -1", "", "F1 0 -1", "", "F2 10 -1", "F2 10 -1", "F3 10 -1 end")
    with aboard.turns.taken(link):
        aboard.turns.tell("arming")
        aboard.clock.sleep_until(10)
    assert link.sent == ["P1 arming", "D1 10 0", "P1 arming", "D1 10 0", "D2 end", "D2 end"]


def test_turn_given_again_during_the_turn_means_nothing() -> None:
    aboard, link = Aboard(), ScriptedLink("F1 0 -1,F1 0 -1,F1 0 -1", "F2 10 -1", "F3 10 -1 end")
    with aboard.turns.taken(link):
        aboard.clock.sleep_until(10)
    assert link.sent == ["D1 10 0", "D2 end"]


@pytest.mark.parametrize(("order", "abandoned"), [("land", False), ("abandon", True)])
def test_order_interrupts_a_sleep(order: str, abandoned: bool) -> None:
    aboard, link = Aboard(), ScriptedLink("F1 0 -1", f"F2 40 -1 {order}", "F3 40 -1 end")
    with aboard.turns.taken(link):
        aboard.clock.sleep_until(1000, aboard.stop)
        assert aboard.clock.time_us() == 40
    assert link.sent[0] == "D1 1000 0 stop"
    assert aboard.stop.is_set()
    assert aboard.abandon.is_set() == abandoned


def test_sleep_that_nobody_could_interrupt_is_refused() -> None:
    aboard, link = Aboard(), ScriptedLink("F1 0 -1", "F2 0 -1 end")
    with aboard.turns.taken(link), pytest.raises(ValueError, match="by an order or by a frame"):
        aboard.clock.sleep_until(10, threading.Event())


def test_end_of_the_simulator_ends_the_companion() -> None:
    aboard, link = Aboard(), ScriptedLink("F1 0 -1", "F2 0 -1 end")
    with pytest.raises(Abandoned, match="has ended the flight"), aboard.turns.taken(link):
        aboard.clock.sleep_until(10)
    assert link.sent == ["D1 10 0"]


def test_silence_ends_the_companion() -> None:
    aboard, link = Aboard(patience_s=1.0), ScriptedLink("F1 0 -1")
    with pytest.raises(Abandoned, match="no turn in 1 s"), aboard.turns.taken(link):
        aboard.clock.sleep_until(10)


def test_what_breaks_in_a_flight_ends_it() -> None:
    aboard, link = Aboard(), ScriptedLink("F1 0 -1", "F2 0 -1 end")
    with pytest.raises(ZeroDivisionError), aboard.turns.taken(link):
        raise ZeroDivisionError
    assert link.sent == ["D1 end"]


# --- the camera


class LateFrames:
    """Frames as the operating system delivers them: late, old ones first. A `FrameSource`."""

    def __init__(self, clock: ConductedClock, *sequences: int) -> None:
        self._clock = clock
        self._sequences = list(sequences)
        self._newest: ReceivedFrame | None = None

    def latest(self) -> ReceivedFrame | None:
        return self._newest

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        if not self._sequences:
            return None
        pixels = np.zeros((3, 4), np.uint16)
        frame = Frame(self._sequences.pop(0), 0, pixels, Intrinsics(4, 3, 2.0, 2.0, 1.5))
        self._newest = ReceivedFrame(frame, self._clock.time_us())
        return self._newest


def test_frame_that_the_turn_names_is_waited_for() -> None:
    aboard, link = Aboard(), ScriptedLink("F1 0 2", "F2 50 2", "F3 90 5", "F4 90 -1 end")
    camera = TokenFrameSource(LateFrames(aboard.clock, 0, 1, 2, 3, 5), aboard.turns, aboard.clock)
    with aboard.turns.taken(link):
        seen = camera.latest()
        assert seen is not None
        assert (seen.frame.sequence, seen.received_us) == (2, 0)
        aboard.clock.sleep_until(50)
        assert camera.latest() is seen
        newer = camera.wait(newer_than_sequence=2, timeout_s=1.0)
        assert newer is not None
        assert (newer.frame.sequence, newer.received_us) == (5, 90)
    assert link.sent == ["D1 50 0", "D2 1000050 0 frame", "D3 end"]


def test_wait_for_a_frame_ends_in_simulated_time() -> None:
    aboard, link = Aboard(), ScriptedLink("F1 0 -1", "F2 100000 -1", "F3 100000 -1 end")
    camera = TokenFrameSource(LateFrames(aboard.clock), aboard.turns, aboard.clock)
    with aboard.turns.taken(link):
        assert camera.wait(newer_than_sequence=-1, timeout_s=0.1) is None
    assert link.sent == ["D1 100000 0 frame", "D2 end"]


def test_frame_that_never_comes_ends_the_companion() -> None:
    aboard, link = Aboard(patience_s=1.0), ScriptedLink("F1 0 7")
    camera = TokenFrameSource(LateFrames(aboard.clock, 6), aboard.turns, aboard.clock)
    with pytest.raises(Abandoned, match="frame 7"), aboard.turns.taken(link):
        camera.latest()

"""Decision loop and watchdog: order and length of every step, and reasons to end a flight.

Only `Link` and `FrameSource`, which are protocols, have stand-ins. Exact times are checked in
simulated time. Tests of two threads run on the wall clock and check lower bounds only.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock, SimClock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.latency.injection import FixedSampler, LatencySampler, ReplaySampler
from airl_mav.policy.actions import ALTITUDE_P, MAX_VERTICAL_M_S, Action
from airl_mav.policy.observation import Kinematics, Observation
from airl_mav.scenario.model import PilotSettings, WatchdogSettings
from companion.frame_source import ReceivedFrame
from companion.link_interface import STOP, BodyVelocity, LinkError, Setpoint, VehicleStatus
from companion.pilot import Pilot
from companion.watchdog import ThreadGuard, Watchdog

LENS = Intrinsics.from_fov(8, 6, math.radians(90.0))
FAR = (1000.0, 0.0)
SPEED = 4.0
"""Half a simulated second is 125 ms of wall time: bounds lie further apart than that."""


class FakeLink:
    """Vehicle that stays at a set position and stores its commands."""

    def __init__(self, clock: Clock) -> None:
        self.connected = True
        self.position = np.array([0.0, 0.0, -2.5])
        self.commands: list[tuple[int, BodyVelocity]] = []
        self.left_us: list[int] = []
        self.released_us: list[int] = []
        self.flown = VehicleStatus(armed=True, offboard=True, mode="offboard")
        self.refuse: str | None = None
        self._clock = clock

    def kinematics(self) -> Kinematics:
        return Kinematics(self.position.copy(), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def status(self) -> VehicleStatus:
        return self.flown

    def send_setpoint(self, setpoint: Setpoint) -> None:
        assert isinstance(setpoint, BodyVelocity)
        if self.refuse is not None:
            raise LinkError(self.refuse)
        self.commands.append((self._clock.time_us(), setpoint))

    def leave_offboard(self) -> None:
        self.left_us.append(self._clock.time_us())

    def release(self) -> None:
        self.released_us.append(self._clock.time_us())


class FakeFrames:
    """Camera with a new frame for each request, `age_us` old and decoded in `decode_us`."""

    def __init__(self, clock: Clock, age_us: int = 3000, decode_us: int = 500) -> None:
        self.silent = False
        self.asked_for: list[int] = []
        self._clock = clock
        self._age_us, self._decode_us = age_us, decode_us
        self._sequence = 0

    def latest(self) -> ReceivedFrame | None:
        captured_us = self._clock.time_us() - self._age_us
        frame = Frame(self._sequence, captured_us, np.zeros((6, 8), np.uint16), LENS)
        self._clock.sleep_until(self._clock.time_us() + self._decode_us)
        return ReceivedFrame(frame, self._clock.time_us())

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        self.asked_for.append(newer_than_sequence)
        if self.silent:
            time.sleep(min(timeout_s, 0.001))
            return None
        self._sequence += 1
        return self.latest()


class Script:
    """A policy that runs one function a decision and stops the flight at the end."""

    def __init__(self, *steps: Callable[[], Action]) -> None:
        self.stop = threading.Event()
        self.seen: list[Observation] = []
        self._steps = iter(steps)

    def act(self, observation: Observation) -> Action:
        self.seen.append(observation)
        step = next(self._steps, None)
        if step is None:
            self.stop.set()
            return Action(0.0, 0.0, 0.0)
        return step()


def forward(speed: float = 1.0) -> Callable[[], Action]:
    return lambda: Action(speed, 0.0, 0.0)


class Flight:
    """Everything that a pilot needs, on one clock."""

    def __init__(
        self,
        clock: Clock,
        policy: Script,
        settings: PilotSettings | None = None,
        latency: LatencySampler | None = None,
        watchdog: WatchdogSettings | None = None,
    ) -> None:
        self.clock = clock
        self.policy = policy
        self.link = FakeLink(clock)
        self.frames = FakeFrames(clock)
        self.watchdog = Watchdog(self.link, clock, watchdog or WatchdogSettings())
        self.guard = ThreadGuard(clock)
        self.pilot = Pilot(
            *(self.link, self.frames, policy, self.watchdog, clock, settings or PilotSettings()),
            latency=latency,
        )

    def watch(self) -> None:
        self.watchdog.begin()
        self.guard.start(self.watchdog)

    def fly(self, goal: tuple[float, float] = FAR) -> str:
        return self.pilot.fly(goal, self.policy.stop)

    def column(self, name: str) -> np.ndarray:
        return self.pilot.log.columns()[name]


@pytest.fixture
def watched() -> Iterator[list[Flight]]:
    """Flights whose watchdog is stopped at the end of the test."""
    flights: list[Flight] = []
    yield flights
    for flight in flights:
        flight.guard.stop()


# --- exact, in simulated time


@given(
    hold_ms=st.integers(0, 1000),
    computing_ms=st.lists(st.integers(0, 900), min_size=1, max_size=5),
    sampled_ms=st.none() | st.integers(0, 900),
)
def test_every_stamp_is_where_it_belongs(
    hold_ms: int, computing_ms: list[int], sampled_ms: int | None
) -> None:
    """t1, t2 and t3 add up to the microsecond; an injected latency is a least one."""
    clock = SimClock(1_000_000)

    def think(ms: int) -> Callable[[], Action]:
        def step() -> Action:
            clock.advance(1000 * ms)
            return Action(1.0, 0.0, 0.0)

        return step

    latency = None if sampled_ms is None else FixedSampler(1000 * sampled_ms)
    settings = PilotSettings(hold_s=hold_ms / 1000)
    flight = Flight(clock, Script(*(think(ms) for ms in computing_ms)), settings, latency)
    assert flight.fly() == "stopped"
    assert len(flight.pilot.log) == len(computing_ms)
    t1 = flight.column("decoded_us") - flight.column("capture_us")
    t2 = flight.column("action_ready_us") - flight.column("infer_start_us")
    t3 = flight.column("held_until_us") - flight.column("sent_us")
    assert t1.tolist() == [3500] * len(computing_ms)
    assert t2.tolist() == [1000 * max(ms, sampled_ms or 0) for ms in computing_ms]
    assert t3.tolist() == [round(1e6 * settings.hold_s)] * len(computing_ms)
    np.testing.assert_array_equal(flight.column("infer_start_us"), flight.column("decoded_us"))
    np.testing.assert_array_equal(flight.column("sent_us"), flight.column("action_ready_us"))
    # The next frame is taken when the hold is over, not before.
    captured, held = flight.column("capture_us"), flight.column("held_until_us")
    np.testing.assert_array_equal(captured[1:] + 3000, held[:-1])
    # The log contains the sent setpoints, with their send times.
    assert [t for t, _ in flight.link.commands] == flight.column("sent_us").tolist()
    np.testing.assert_allclose(flight.column("setpoint"), [s for _, s in flight.link.commands])


def test_latencies_are_drawn_one_a_decision() -> None:
    clock = SimClock()
    samples = [100_000, 200_000, 300_000, 400_000]
    latency = ReplaySampler(samples, np.random.default_rng(4))
    expected = ReplaySampler(samples, np.random.default_rng(4))
    flight = Flight(clock, Script(*[forward()] * 12), latency=latency)
    flight.fly()
    t2 = flight.column("action_ready_us") - flight.column("infer_start_us")
    assert t2.tolist() == [expected.sample_us() for _ in range(12)]
    assert len(set(t2.tolist())) > 1


@pytest.mark.parametrize(
    ("height_m", "down_m_s"),
    [
        (2.5, 0.0),
        (2.3, -0.1),  # too low: up is negative
        (2.9, 0.2),  # too high: down
        (0.0, -MAX_VERTICAL_M_S),
        (30.0, MAX_VERTICAL_M_S),
    ],
)
def test_altitude_is_held(height_m: float, down_m_s: float) -> None:
    flight = Flight(SimClock(), Script(forward(2.0)))
    flight.link.position[2] = -height_m
    flight.fly()
    (_, sent) = flight.link.commands[0]
    assert sent.down_m_s == pytest.approx(down_m_s)
    assert abs(sent.down_m_s) <= ALTITUDE_P * abs(height_m - 2.5) + 1e-12
    assert (sent.forward_m_s, sent.right_m_s) == (2.0, 0.0)


def test_altitude_uses_the_newest_telemetry_not_that_of_the_observation() -> None:
    flight = Flight(SimClock(), Script())

    def sink() -> Action:
        flight.link.position[2] = -1.5
        return Action(0.0, 0.0, 0.0)

    flight.policy._steps = iter([sink])
    flight.fly()
    assert flight.link.commands[0][1].down_m_s == pytest.approx(-0.5)


def test_actions_are_limited_and_never_nan() -> None:
    nan = math.nan
    wild = [Action(30.0, 40.0, 0.1), Action(nan, 1.0, nan), Action(-math.inf, 0.0, math.inf)]
    flight = Flight(SimClock(), Script(*(lambda a=a: a for a in wild)))
    flight.fly()
    sent = [s for _, s in flight.link.commands]
    np.testing.assert_allclose(
        sent, [(3.0, 4.0, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)], atol=1e-12
    )


def test_policy_sees_the_goal_from_where_it_is() -> None:
    flight = Flight(SimClock(), Script(forward()))
    flight.link.position[:2] = 3.0, -4.0
    flight.fly((10.0, 0.0))
    np.testing.assert_allclose(flight.policy.seen[0].goal, [7.0, 4.0], atol=1e-12)


def test_a_frame_is_decided_on_once() -> None:
    flight = Flight(SimClock(), Script(*[forward()] * 4))
    flight.fly()
    assert flight.frames.asked_for == [-1, 1, 2, 3, 4]


@pytest.mark.parametrize(("away_m", "reached"), [(1.99, True), (2.01, False)])
def test_goal_is_reached_inside_its_radius(away_m: float, reached: bool) -> None:
    flight = Flight(SimClock(), Script(forward()))
    flight.link.position[:2] = 6.0, 8.0 - away_m
    flight.link.position[2] = -30.0  # seen from above
    assert (flight.fly((6.0, 8.0)) == "goal reached") is reached
    assert (flight.link.commands == []) is reached


def test_stop_before_the_first_decision_sends_nothing() -> None:
    flight = Flight(SimClock(), Script(forward()))
    flight.policy.stop.set()
    assert flight.fly() == "stopped"
    assert flight.link.commands == []


def test_stop_during_inference_sends_nothing_more() -> None:
    flight = Flight(SimClock(), Script(forward()))
    assert flight.fly() == "stopped"
    # The second decision set `stop` while it was thought about.
    assert len(flight.policy.seen) == 2
    assert len(flight.link.commands) == len(flight.pilot.log) == 1


def test_stop_ends_a_hold() -> None:
    clock = WallClock(SPEED)
    flight = Flight(clock, Script(forward(), forward()), PilotSettings(hold_s=600.0))
    thread = threading.Thread(target=flight.fly)
    thread.start()
    wait_for(lambda: flight.link.commands)
    flight.policy.stop.set()
    thread.join(30.0)
    assert not thread.is_alive()
    assert len(flight.link.commands) == 1
    # The hold that was cut short is logged as long as it was.
    held = flight.column("held_until_us") - flight.column("sent_us")
    assert 0 < held[0] < 600_000_000


def test_lost_link_ends_the_flight() -> None:
    flight = Flight(SimClock(), Script())

    def unplug() -> Action:
        flight.link.connected = False
        return Action(1.0, 0.0, 0.0)

    flight.policy._steps = iter([forward(), unplug, forward()])
    assert flight.fly() == "link lost"
    assert len(flight.link.commands) == 2


def test_refused_setpoint_is_an_error() -> None:
    flight = Flight(SimClock(), Script(forward()))
    flight.link.refuse = "setpoint refused: no system"
    with pytest.raises(LinkError, match="no system"):
        flight.fly()
    assert len(flight.pilot.log) == 0


def test_nothing_is_sent_once_offboard_is_left() -> None:
    flight = Flight(SimClock(), Script())

    def leave() -> Action:
        flight.watchdog.left_offboard = True
        return Action(1.0, 0.0, 0.0)

    flight.policy._steps = iter([forward(), leave])
    assert flight.fly() == "watchdog"
    assert len(flight.link.commands) == 1


# --- with the watchdog's thread, on the wall clock: lower bounds


def test_persist_keeps_the_last_command(watched: list[Flight]) -> None:
    """PX4's and MAVSDK's semantics: nothing happens between two commands."""
    clock = WallClock(SPEED)
    settings, slow = PilotSettings(hold_s=0.2), FixedSampler(800_000)
    patient = WatchdogSettings(decision_timeout_s=60.0)
    flight = Flight(clock, Script(*[forward()] * 3), settings, slow, patient)
    watched.append(flight)
    flight.watch()
    flight.fly()
    assert len(flight.link.commands) == 3
    assert STOP not in [s for _, s in flight.link.commands]
    assert flight.watchdog.notes == []


def test_hover_after_zeroes_between_commands(watched: list[Flight]) -> None:
    """AirSim's semantics: an action ends, whether or not the next one is ready."""
    clock = WallClock(SPEED)
    settings, slow = PilotSettings(hold_s=0.2), FixedSampler(2_500_000)
    hover = WatchdogSettings(decision_timeout_s=60.0, hover_after_s=0.1)
    flight = Flight(clock, Script(*[forward()] * 2), settings, slow, hover)
    watched.append(flight)
    flight.watch()
    flight.fly()
    kinds = [s == STOP for _, s in flight.link.commands]
    assert kinds == [False, True] * 2, "a stop after every action, and one only"
    times = np.array([t for t, _ in flight.link.commands]).reshape(2, 2)
    assert np.all(times[:, 1] - times[:, 0] >= 300_000)
    assert flight.watchdog.notes == [], "as asked for: nothing to report"


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_overdue_decision_is_stopped_and_offboard_left(watched: list[Flight]) -> None:
    clock = WallClock(SPEED)
    release = threading.Event()

    def hang() -> Action:
        release.wait(30.0)
        return Action(5.0, 0.0, 0.0)

    bounds = WatchdogSettings(decision_timeout_s=1.0, leave_after_s=2.0)
    flight = Flight(clock, Script(forward(), hang), watchdog=bounds)
    watched.append(flight)
    flight.watch()
    results: list[str] = []
    thread = threading.Thread(target=lambda: results.append(flight.fly()))
    thread.start()
    wait_for(lambda: flight.link.left_us)
    release.set()
    thread.join(30.0)
    assert results == ["watchdog"]
    (sent_us, moving), (zeroed_us, still) = flight.link.commands
    assert moving.forward_m_s == 1.0
    assert still == STOP
    assert zeroed_us - sent_us >= 1_000_000
    assert flight.link.left_us[0] - sent_us >= 3_000_000
    assert len(flight.link.left_us) == 1
    stopped, left = flight.watchdog.notes
    assert "velocity zeroed (inference; last action" in stopped
    assert "left offboard (inference; last action" in left


def test_decision_that_comes_late_but_in_time_flies_on(watched: list[Flight]) -> None:
    clock = WallClock(SPEED)
    flight: Flight

    def late() -> Action:
        wait_for(lambda: flight.watchdog.notes)
        return Action(2.0, 0.0, 0.0)

    bounds = WatchdogSettings(decision_timeout_s=0.8, leave_after_s=60.0)
    flight = Flight(clock, Script(forward(), late, late), watchdog=bounds)
    watched.append(flight)
    flight.watch()
    assert flight.fly() == "stopped"
    sent = [s for _, s in flight.link.commands]
    assert sent[0].forward_m_s == 1.0
    assert sent[1] == STOP
    assert [s.forward_m_s for s in sent if s != STOP] == [1.0, 2.0, 2.0]
    assert not flight.link.left_us


def test_silent_camera_is_named(watched: list[Flight]) -> None:
    clock = WallClock(SPEED)
    bounds = WatchdogSettings(decision_timeout_s=1.0, leave_after_s=2.0)
    flight = Flight(clock, Script(), watchdog=bounds)
    flight.frames.silent = True
    watched.append(flight)
    flight.watch()
    assert flight.fly() == "watchdog"
    assert [s for _, s in flight.link.commands] == [STOP]
    assert all("(waiting for a frame; " in note for note in flight.watchdog.notes)


def test_refused_stop_is_noted_and_offboard_still_left(watched: list[Flight]) -> None:
    clock = WallClock(SPEED)
    bounds = WatchdogSettings(decision_timeout_s=0.5, leave_after_s=2.0)
    flight = Flight(clock, Script(), watchdog=bounds)
    flight.frames.silent = True
    flight.link.refuse = "setpoint refused: busy"
    watched.append(flight)
    flight.watch()
    assert flight.fly() == "watchdog"
    assert len(flight.link.left_us) == 1
    notes = flight.watchdog.notes
    assert "velocity zeroed" in notes[0]
    assert "setpoint refused: busy" in notes[1]
    assert "left offboard" in notes[2]


def test_watchdog_stops_watching(watched: list[Flight]) -> None:
    clock = WallClock(100.0)
    flight = Flight(clock, Script())
    watched.append(flight)
    flight.watch()
    flight.guard.stop()
    clock.sleep_until(clock.time_us() + 10 * US_PER_S)
    assert flight.link.commands == []
    assert flight.watchdog.notes == []


def test_guard_that_never_started_can_be_stopped() -> None:
    Flight(SimClock(), Script()).guard.stop()


@pytest.mark.parametrize(
    ("stamped_us", "age_s"), [(3_000, 0.0035), (-5_000_000, 0.0), (3_600_000_000, 0.0)]
)
def test_a_frame_stamped_by_another_clock_is_as_old_as_it_has_been_here(
    stamped_us: int, age_s: float
) -> None:
    clock = SimClock()
    policy = Script(forward())
    flight = Flight(clock, policy, PilotSettings(hold_s=0.0))
    flight.frames = FakeFrames(clock, age_us=stamped_us)
    flight.pilot.frames = flight.frames
    flight.fly()
    told = policy.seen[0].in_flight
    assert told is not None
    assert told.age_s == pytest.approx(age_s, abs=1e-9)

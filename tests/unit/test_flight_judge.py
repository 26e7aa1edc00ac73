from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.flight.judge import Effect, Outcome, Referee, Task, TruthSample

TASK = Task(goal=(30.0, 40.0), goal_radius_m=2.0, time_limit_s=60.0)
FAR = (0.0, 0.0, -2.0)


def sample(
    time_us: int,
    position: tuple[float, float, float] = FAR,
    collision: str | None = None,
    battery: float = 0.9,
) -> TruthSample:
    return TruthSample(time_us, position, collision, battery)


def flying(start_us: int = 1_000_000) -> Referee:
    referee = Referee(TASK)
    referee.start_navigation(start_us)
    return referee


def at_distance(distance: float, bearing: float, down: float) -> tuple[float, float, float]:
    north = TASK.goal[0] + distance * math.cos(bearing)
    return north, TASK.goal[1] + distance * math.sin(bearing), down


@given(st.floats(0.0, 1.999), st.floats(-math.pi, math.pi), st.floats(-50.0, 0.0))
def test_inside_the_circle_is_success_at_any_height(
    distance: float, bearing: float, down: float
) -> None:
    verdict = flying().observe(sample(2_000_000, at_distance(distance, bearing, down)))
    assert verdict is not None
    assert verdict.outcome is Outcome.SUCCESS
    assert verdict.time_us == 2_000_000


@given(
    st.floats(0.0, 10.0),
    st.floats(-math.pi, math.pi),
    st.floats(-10.0, 10.0),
)
def test_a_goal_with_a_height_is_a_ball(distance: float, bearing: float, above: float) -> None:
    high = Referee(Task((*TASK.goal[:2], -7.0), TASK.goal_radius_m, TASK.time_limit_s))
    high.start_navigation(0)
    verdict = high.observe(sample(1_000, at_distance(distance, bearing, -7.0 - above)))
    squared = distance**2 + above**2
    if abs(squared - 4.0) > 1e-6:
        assert (verdict is not None) is (squared < 4.0)


def test_the_distance_to_a_goal_with_a_height_is_told() -> None:
    high = Referee(Task((0.0, 0.0, -9.0), 1.0, 1.0))
    high.start_navigation(0)
    verdict = high.observe(sample(1_000_000, (0.0, 0.0, -2.0)))
    assert verdict is not None
    assert verdict.reason == "7.00 m from the goal after 1 s"


@given(st.floats(2.001, 30.0), st.floats(-math.pi, math.pi))
def test_outside_the_circle_is_nothing(distance: float, bearing: float) -> None:
    assert flying().observe(sample(2_000_000, at_distance(distance, bearing, -2.0))) is None


def test_the_circle_itself_is_outside() -> None:
    assert flying().observe(sample(2_000_000, (32.0, 40.0, -2.0))) is None


@pytest.mark.parametrize(
    ("found", "outcome", "reason"),
    [
        (sample(2_000_000, collision="box 3"), Outcome.COLLISION, "hit box 3"),
        (sample(2_000_000, battery=0.0), Outcome.BATTERY, "battery empty"),
        (sample(61_000_000), Outcome.TIMEOUT, "50.00 m from the goal after 60 s"),
        # Everything at once, in the order of the paper's code.
        (sample(99_000_000, (30, 40, 0), "wall", 0.0), Outcome.SUCCESS, "0.00 m from the goal"),
        (sample(99_000_000, FAR, "wall", 0.0), Outcome.COLLISION, "hit wall"),
        (sample(99_000_000, FAR, None, 0.0), Outcome.BATTERY, "battery empty"),
    ],
)
def test_outcomes_and_their_order(found: TruthSample, outcome: Outcome, reason: str) -> None:
    verdict = flying().observe(found)
    assert verdict is not None
    assert (verdict.outcome, verdict.reason) == (outcome, reason)


def test_the_time_limit_counts_from_navigation_to_the_microsecond() -> None:
    referee = flying(7_000_000)
    assert referee.observe(sample(66_999_999)) is None
    verdict = referee.observe(sample(67_000_000))
    assert verdict is not None
    assert verdict.outcome is Outcome.TIMEOUT


def test_the_goal_on_the_last_moment_counts() -> None:
    verdict = flying(0).observe(sample(60_000_000, (30.0, 40.0, -2.0)))
    assert verdict is not None
    assert verdict.outcome is Outcome.SUCCESS


def test_before_navigation_only_a_crash_or_an_empty_battery_ends_it() -> None:
    referee = Referee(TASK)
    assert referee.observe(sample(0, (30.0, 40.0, 0.0))) is None
    assert referee.observe(sample(500_000_000)) is None
    verdict = referee.observe(sample(500_004_000, collision="ground"))
    assert verdict is not None
    assert verdict.reason == "hit ground during the take-off"
    battery = Referee(TASK).observe(sample(0, battery=-0.1))
    assert battery is not None
    assert battery.outcome is Outcome.BATTERY


def test_navigation_announced_ahead_begins_then() -> None:
    referee = flying(3_000_000)
    assert referee.observe(sample(2_999_999, (30.0, 40.0, -2.0))) is None
    assert referee.observe(sample(3_000_000, (30.0, 40.0, -2.0))) is not None


def test_the_first_verdict_stands() -> None:
    referee = flying()
    first = referee.observe(sample(2_000_000, collision="box 1"))
    assert referee.observe(sample(3_000_000, (30.0, 40.0, -2.0))) == first
    assert referee.abort(4_000_000, "Ctrl-C") == first
    assert referee.verdict == first


def test_an_abort_ends_it() -> None:
    referee = flying()
    verdict = referee.abort(2_500_000, "companion lost")
    assert (verdict.outcome, verdict.reason) == (Outcome.ABORTED, "companion lost")
    assert referee.observe(sample(3_000_000, (30.0, 40.0, -2.0))) == verdict


def test_navigation_begins_once() -> None:
    with pytest.raises(ValueError, match="already began"):
        flying().start_navigation(5)


@pytest.mark.parametrize("task", [Task((1, 1), 0.0, 60.0), Task((1, 1), 2.0, -1.0)])
def test_a_task_nobody_can_do_is_refused(task: Task) -> None:
    with pytest.raises(ValueError, match="must be > 0"):
        Referee(task)


def test_an_effect_is_one_line_with_its_times() -> None:
    effect = Effect("udp", "10.0.0.7", 255, 190, "PARAM_SET MPC_XY_P", 1, 3_540_000, False, 1, 2.5)
    assert effect.line(2_000_000) == (
        "udp 10.0.0.7, system 255 component 190, PARAM_SET MPC_XY_P from 1 to 2.5"
        " (once, first 1.5 s after the reset)"
    )
    twice = Effect("serial", "", 1, 2, "SET_MODE", 2, 3_540_000, False)
    assert twice.line(0) == (
        "serial, system 1 component 2, SET_MODE (2 times, first 3.5 s after the reset)"
    )

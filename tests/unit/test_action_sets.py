"""Action sets against the paper's table and closed forms."""

from __future__ import annotations

import math
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from airl_mav.policy.actions import Action, ActionSpec, commands, discrete_actions
from airl_mav.policy.actions import command as any_command

DISCRETE = ["arc-25", "paper-25"]


def spec(name: str, max_speed_m_s: float = 5.0) -> ActionSpec:
    return ActionSpec.model_validate({"set": name, "max_speed_m_s": max_speed_m_s})


def command(asked: ActionSpec, action: np.ndarray) -> Action:
    """Return the velocity that one action commands."""
    found = any_command(asked, action)
    assert isinstance(found, Action)
    return found


def table(name: str, max_speed_m_s: float = 5.0) -> np.ndarray:
    return commands(spec(name, max_speed_m_s), np.arange(25))


def test_the_papers_25_actions() -> None:
    """Appendix B of Air Learning, by hand: ten speeds ahead, five back, ten turns on the spot."""
    wanted = [
        *((v, 0.0) for v in (45 / 9, 41 / 9, 37 / 9, 33 / 9, 29 / 9)),
        *((v, 0.0) for v in (25 / 9, 21 / 9, 17 / 9, 13 / 9, 9 / 9)),
        *((-5.0, 0.0), (-4.0, 0.0), (-3.0, 0.0), (-2.0, 0.0), (-1.0, 0.0)),
        *((0.0, 108.0), (0.0, 54.0), (0.0, 27.0), (0.0, 13.5), (0.0, 6.75)),
        *((0.0, -216.0), (0.0, -108.0), (0.0, -54.0), (0.0, -27.0), (0.0, -13.5)),
    ]
    found = table("paper-25")
    np.testing.assert_allclose(found[:, 0], [v for v, _ in wanted], atol=1e-12)
    np.testing.assert_allclose(np.degrees(found[:, 2]), [turn for _, turn in wanted], atol=1e-12)
    assert not found[:, 1].any()


def test_the_arcs() -> None:
    found = table("arc-25")
    assert sorted({round(v, 9) for v in found[:, 0]}) == [0.0, 1.0, 2.0, 3.5, 5.0]
    turns = sorted({round(math.degrees(w), 9) for w in found[:, 2]})
    assert turns == [-72.0, -27.0, 0.0, 27.0, 72.0]
    assert len(np.unique(found, axis=0)) == 25, "every speed with every turn"
    assert not found[:, 1].any()
    # Slowest first, left first: trained networks depend on this order.
    np.testing.assert_allclose(found[0], [0.0, 0.0, math.radians(-72.0)])
    np.testing.assert_allclose(found[12], [2.0, 0.0, 0.0])
    np.testing.assert_allclose(found[24], [5.0, 0.0, math.radians(72.0)])


@pytest.mark.parametrize("name", DISCRETE)
@given(speed=st.floats(0.1, 30.0))
def test_speeds_scale_and_turns_do_not(name: str, speed: float) -> None:
    found, five = table(name, speed), table(name)
    np.testing.assert_allclose(found[:, :2], five[:, :2] * speed / 5.0, atol=1e-9)
    np.testing.assert_array_equal(found[:, 2], five[:, 2])
    assert np.hypot(found[:, 0], found[:, 1]).max() == pytest.approx(speed)


@pytest.mark.parametrize("name", DISCRETE)
def test_who_changes_the_commands_changes_no_later_ones(name: str) -> None:
    first = table(name)
    kept = first.copy()
    first[:] = 1e9
    np.testing.assert_array_equal(table(name), kept)


# --- continuous


@given(st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=8))
def test_with_fixed_yaw_it_flies_the_same_way_and_never_turns(
    actions: list[tuple[float, float]],
) -> None:
    fixed = commands(spec("velocity-fixed-yaw"), np.array(actions))
    np.testing.assert_array_equal(fixed[:, :2], fly(*actions)[:, :2])
    assert not fixed[:, 2].any()
    assert discrete_actions(spec("velocity-fixed-yaw")) is None


@given(st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2)))
def test_with_a_yaw_rate_it_flies_the_same_way_and_turns_and_climbs_as_asked(
    action: tuple[float, float, float, float],
) -> None:
    turning = commands(spec("velocity3d-yaw-rate"), np.array([action]))
    np.testing.assert_array_equal(turning[:, :2], fly(action[:2])[:, :2])
    turn, down = np.clip(action[2:], -1.0, 1.0)
    assert turning[0, 2] == pytest.approx(math.radians(120.0) * turn)
    assert turning[0, 3] == pytest.approx(1.5 * down)


def fly(*actions: tuple[float, float], speed: float = 5.0) -> np.ndarray:
    return commands(spec("velocity", speed), np.array(actions))


@pytest.mark.parametrize(
    ("action", "wanted"),
    [
        ((0.0, 0.0), (0.0, 0.0, 0.0)),
        ((1.0, 0.0), (5.0, 0.0, 0.0)),
        ((0.5, 0.0), (2.5, 0.0, 0.0)),
        # Sideways: 1.2 / s * 90 deg = 108 deg/s, cut off at 90.
        ((0.0, 1.0), (0.0, 5.0, math.pi / 2)),
        ((0.0, -1.0), (0.0, -5.0, -math.pi / 2)),
        # Backwards: the course is behind, the nose turns to it.
        ((-1.0, 0.0), (-5.0, 0.0, math.pi / 2)),
        # The corner: no faster than 5 m/s, 45 deg to the right.
        ((1.0, 1.0), (5 / math.sqrt(2), 5 / math.sqrt(2), 1.2 * math.pi / 4)),
        ((0.6, 0.8), (3.0, 4.0, 1.2 * math.atan2(0.8, 0.6))),
        # Half of a fifth of the fastest speed: half the turn.
        ((0.0, 0.1), (0.0, 0.5, math.pi / 4)),
        # Beyond the square: cut off axis by axis first.
        ((7.0, -3.0), (5 / math.sqrt(2), -5 / math.sqrt(2), -1.2 * math.pi / 4)),
    ],
)
def test_velocities_by_hand(action: tuple[float, float], wanted: tuple[float, ...]) -> None:
    np.testing.assert_allclose(fly(action)[0], wanted, atol=1e-9)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 30.0))
def test_velocities_stay_within_bounds(forward: float, right: float, speed: float) -> None:
    v_forward, v_right, turn = fly((forward, right), speed=speed)[0]
    assert math.hypot(v_forward, v_right) <= speed * (1 + 1e-9)
    assert abs(turn) <= math.pi / 2 + 1e-9
    # The direction equals the direction of the action clipped to the square.
    cut = max(-1.0, min(1.0, forward)), max(-1.0, min(1.0, right))
    assert v_forward * cut[1] - v_right * cut[0] == pytest.approx(0.0, abs=1e-6 * speed)
    assert turn * v_right >= 0.0, "the nose turns to the course"


@given(st.floats(1e-6, 1.0), st.floats(-1.0, 1.0))
def test_left_and_right_mirror_each_other(forward: float, right: float) -> None:
    one, other = fly((forward, right), (forward, -right))
    np.testing.assert_allclose(one * [1, -1, -1], other, atol=1e-9)


@pytest.mark.parametrize("bad", [(math.nan, 0.0), (0.0, math.nan), (math.inf, -math.inf)])
def test_what_is_no_number_never_leaves_as_a_command(bad: tuple[float, float]) -> None:
    action = command(spec("velocity"), np.array(bad)).within(5.0)
    assert all(map(math.isfinite, (action.forward_m_s, action.right_m_s, action.yaw_rate_rad_s)))
    assert math.hypot(action.forward_m_s, action.right_m_s) <= 5.0 + 1e-9


# --- one and many


@pytest.mark.parametrize("name", [*DISCRETE, "velocity"])
def test_one_action_is_a_row_of_many(name: str) -> None:
    rng = np.random.default_rng(2)
    actions: Any = rng.uniform(-1, 1, (6, 2)) if name == "velocity" else rng.integers(0, 25, 6)
    rows = commands(spec(name), actions)
    assert rows.shape == (6, 3)
    assert rows.dtype == np.float64
    for action, row in zip(actions, rows, strict=True):
        assert command(spec(name), action) == Action(*row)


@pytest.mark.parametrize("name", DISCRETE)
@pytest.mark.parametrize("action", [25, -26])
def test_an_action_that_is_none_is_an_error(name: str, action: int) -> None:
    with pytest.raises(IndexError):
        command(spec(name), np.array(action))


def test_counts_and_ranges() -> None:
    assert [discrete_actions(spec(name)) for name in (*DISCRETE, "velocity")] == [25, 25, None]
    for speed in (0.0, -1.0, 30.1, math.nan):
        with pytest.raises(ValidationError):
            spec("arc-25", speed)
    with pytest.raises(ValidationError):
        spec("arc-26")


# --- three dimensions


@given(
    st.lists(
        st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=8
    ),
    st.floats(0.5, 20.0),
)
def test_a_third_number_is_the_downward_speed_and_changes_nothing_else(
    actions: list[tuple[float, float, float]], speed: float
) -> None:
    level = np.array(actions)[:, :2]
    for name in ("velocity", "velocity-fixed-yaw"):
        deep = commands(spec(name.replace("velocity", "velocity3d"), speed), np.array(actions))
        np.testing.assert_array_equal(deep[:, :3], commands(spec(name, speed), level))
        wanted = [0.3 * speed * min(1.0, max(-1.0, down)) for _, _, down in actions]
        np.testing.assert_allclose(deep[:, 3], wanted)


def test_the_75_arcs_are_the_25_three_times() -> None:
    found = commands(spec("arc3d-75"), np.arange(75))
    assert discrete_actions(spec("arc3d-75")) == 75
    for third, down in enumerate((-1.5, 0.0, 1.5)):
        rows = found[25 * third : 25 * third + 25]
        np.testing.assert_array_equal(rows[:, :3], table("arc-25"))
        np.testing.assert_allclose(rows[:, 3], down)


def test_an_action_says_how_fast_it_sinks_only_where_its_set_does() -> None:
    assert command(spec("velocity"), np.array([1.0, 0.0])).down_m_s is None
    climbing = command(spec("velocity3d-fixed-yaw", 4.0), np.array([0.5, 0.0, -1.0]))
    assert astuple(climbing) == pytest.approx((2.0, 0.0, 0.0, -1.2))
    sinking = command(spec("arc3d-75"), np.array(74))
    assert astuple(sinking) == pytest.approx((5.0, 0.0, math.radians(72.0), 1.5))


@pytest.mark.parametrize(
    ("down", "wanted"), [(-9.0, -1.5), (9.0, 1.5), (0.4, 0.4), (math.nan, 0.0), (None, None)]
)
def test_a_vertical_speed_is_limited(down: float | None, wanted: float | None) -> None:
    assert Action(1.0, 0.0, 0.0, down).within(5.0).down_m_s == wanted

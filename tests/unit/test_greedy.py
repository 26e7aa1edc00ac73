"""Observation, actions and the greedy policy against scipy, closed forms and rendered scenes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import render
from airl_mav.core.errors import UsageError
from airl_mav.policy.actions import Action
from airl_mav.policy.greedy import GreedyPolicy, GreedySettings, clearance, near_points
from airl_mav.policy.observation import Kinematics, Observation, encode
from airl_mav.policy.registry import POLICIES, find_policy, load_policy

LENS = Intrinsics.from_fov(64, 48, math.radians(90.0))
HALF_FOV = math.radians(45.0)
RANGE_M = 20.0
ALTITUDE_M = 2.0
S = GreedySettings()

Box = tuple[float, float, float, float]
"""North and east of the centre, half extents north and east; as tall as the walls."""


def arena(*boxes: Box) -> Arena:
    n = len(boxes)
    b = np.array(boxes, np.float64).reshape(n, 4)
    return Arena(
        "test",
        0,
        Bounds(-60.0, 60.0, -60.0, 60.0, 6.0),
        (0, 0, 0),
        Obstacles(
            np.full(n, Shape.BOX, np.int8),
            np.column_stack([b[:, :2], np.full(n, -3.0)]),
            np.column_stack([b[:, 2:], np.full(n, 3.0)]),
            np.zeros(n),
        ),
        (),
        np.array([30.0, 0.0]),
    )


def scalar_first(turn: Rotation) -> NDArray[np.float64]:
    x, y, z, w = turn.as_quat()
    return np.array([w, x, y, z])


def look(
    scene: Arena,
    goal: tuple[float, float],
    *,
    at: tuple[float, float] = (0.0, 0.0),
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
    lens: Intrinsics = LENS,
) -> Observation:
    """Render what a camera at the centre of mass sees and encode it."""
    q = scalar_first(Rotation.from_euler("ZYX", [yaw, pitch, roll]))
    position = np.array([*at, -ALTITUDE_M])
    depth = render(scene, scene.obstacles.center, lens, RANGE_M, position, q)
    # Millimetres, as a frame carries them.
    frame = Frame(0, 0, np.rint(depth * 1000.0).astype(np.uint16), lens)
    return encode(frame, Kinematics(position, np.zeros(3), q), goal)


def blank(goal: tuple[float, float], depth_m: float = 0.0) -> Observation:
    depth = np.full((48, 64), depth_m * 1000.0, np.uint16)
    state = Kinematics(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    return Observation(depth, LENS, np.array(goal), np.zeros(3), 0.0, 0.0, 0.0, states=(state,))


ANGLE = st.floats(-math.pi, math.pi)
TILT = st.floats(-1.3, 1.3)
METRES = st.floats(-100.0, 100.0)


# --- observation


@given(ANGLE, TILT, ANGLE, st.tuples(*[METRES] * 3), st.tuples(*[METRES] * 3), METRES, METRES)
def test_encode_agrees_with_scipy(
    yaw: float,
    pitch: float,
    roll: float,
    position: tuple[float, float, float],
    velocity: tuple[float, float, float],
    north: float,
    east: float,
) -> None:
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    state = Kinematics(np.array(position), np.array(velocity), scalar_first(turn))
    pixels = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    seen = encode(Frame(3, 4, pixels, LENS), state, (north, east))
    level = Rotation.from_euler("z", yaw).inv()
    to_goal = level.apply([north - position[0], east - position[1], 0.0])
    np.testing.assert_allclose(seen.goal, to_goal[:2], atol=1e-9)
    np.testing.assert_allclose(seen.velocity, level.apply(velocity), atol=1e-9)
    z, y, x = turn.as_euler("ZYX")
    assert seen.pitch == pytest.approx(y, abs=1e-7)
    assert math.cos(seen.roll - x) == pytest.approx(1.0, abs=1e-12)
    assert math.cos(yaw - z) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(seen.depth_m, pixels / 1000.0, rtol=1e-6)
    assert seen.intrinsics == LENS
    assert seen.goal_distance == pytest.approx(float(np.linalg.norm(to_goal)), abs=1e-9)


@pytest.mark.parametrize(
    ("goal", "bearing"),
    [((1, 0), 0.0), ((0, 1), 90.0), ((0, -1), -90.0), ((1, 1), 45.0), ((-1, 1), 135.0)],
)
def test_bearing_is_positive_to_the_right(goal: tuple[float, float], bearing: float) -> None:
    assert math.degrees(blank(goal).goal_bearing) == pytest.approx(bearing)


# --- points


@settings(max_examples=30)
@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(0.2, 3.0), st.integers(0, 2**31))
def test_near_points_agree_with_scipy(pitch: float, roll: float, band: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 20.0, (12, 16)).astype(np.float32)
    depth[rng.random((12, 16)) < 0.3] = 0.0
    depth = np.rint(depth * 1000.0).astype(np.uint16)
    lens = Intrinsics.from_fov(16, 12, 1.4)
    seen = Observation(depth, lens, np.zeros(2), np.zeros(3), roll, pitch, 0.0)
    v, u = np.mgrid[0:12, 0:16]
    z = depth / 1000.0
    body = np.stack([z, (u - 7.5) / lens.focal * z, (v - 5.5) / lens.focal * z], axis=-1)
    level = Rotation.from_euler("ZYX", [0.0, pitch, roll]).apply(body[depth > 0])
    expected = level[np.abs(level[:, 2]) < band][:, :2]
    np.testing.assert_allclose(near_points(seen, band), expected, atol=1e-9)


@pytest.mark.parametrize("pitch", [-0.4, -0.2, 0.0, 0.2])
@pytest.mark.parametrize("roll", [-0.4, 0.0, 0.4])
def test_the_floor_is_no_obstacle_however_the_vehicle_tilts(pitch: float, roll: float) -> None:
    seen = look(arena(), (30.0, 0.0), pitch=pitch, roll=roll)
    assert (seen.depth_m > 0).any()  # The floor is in view.
    assert len(near_points(seen, S.band_m)) == 0


@pytest.mark.parametrize(("yaw", "pitch", "roll"), [(0, 0, 0), (0.3, -0.3, 0.2), (-0.4, 0.2, -0.3)])
def test_a_box_in_front_is_found_where_it_stands(yaw: float, pitch: float, roll: float) -> None:
    seen = look(arena((8.0, 0.0, 1.0, 1.5)), (30.0, 0.0), yaw=yaw, pitch=pitch, roll=roll)
    points = near_points(seen, S.band_m)
    assert len(points) > 20
    # Back into the world: on the near face at 7 m, from -1.5 m to 1.5 m.
    world = Rotation.from_euler("z", yaw).apply(np.column_stack([points, np.zeros(len(points))]))
    np.testing.assert_allclose(world[:, 0], 7.0, atol=0.01)
    pixel = 7.5 / LENS.focal / math.cos(0.4)
    assert -1.5 - 0.01 <= world[:, 1].min() <= -1.5 + 2 * pixel
    assert 1.5 - 2 * pixel <= world[:, 1].max() <= 1.5 + 0.01


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.3, -0.2)])
@pytest.mark.parametrize(("north", "east"), [(8.0, 0.0), (-8.0, 0.0), (0.0, 8.0), (-5.0, -5.0)])
def test_all_round_a_box_is_found_where_it_stands(
    north: float, east: float, pitch: float, roll: float
) -> None:
    lens = Intrinsics.from_fov(128, 40, 2.0 * math.pi, "cylindrical")
    box = arena((north, east, 1.0, 1.5))
    points = near_points(look(box, (30.0, 0.0), pitch=pitch, roll=roll, lens=lens), S.band_m)
    at = np.array([north, east])
    near = np.all(np.abs(points - at) <= np.array([1.0, 1.5]) + 0.01, axis=1)
    assert near.all()
    assert len(points) > 8


def test_all_round_a_goal_behind_is_flown_to_at_once() -> None:
    lens = Intrinsics.from_fov(128, 40, 2.0 * math.pi, "cylindrical")
    action = GreedyPolicy().act(look(arena(), (-12.0, 1.0), lens=lens))
    assert abs(course_of(action)) > math.radians(90.0)
    assert math.hypot(action.forward_m_s, action.right_m_s) > 1.0
    assert action.yaw_rate_rad_s > 0.0  # Turns toward the goal at the same time.


def test_what_is_above_or_below_flight_height_is_left_out() -> None:
    low = arena((8.0, 0.0, 1.0, 1.5))
    low.obstacles.half_size[0, 2] = 0.5
    low.obstacles.center[0, 2] = -0.5  # 1 m high; the vehicle flies at 2 m.
    assert len(near_points(look(low, (30.0, 0.0)), 0.6)) == 0
    assert len(near_points(look(low, (30.0, 0.0)), 1.5)) > 0


# --- clearance


@given(st.floats(0.1, 30.0), ANGLE, st.floats(-1.5, 1.5), st.floats(0.1, 2.0))
def test_clearance_of_one_point(r: float, bearing: float, heading: float, half: float) -> None:
    point = np.array([[r * math.cos(bearing), r * math.sin(bearing)]])
    along, across = r * math.cos(bearing - heading), r * math.sin(bearing - heading)
    if abs(abs(across) - half) < 1e-9 or abs(along) < 1e-9:
        return
    expected = along if along > 0 and abs(across) < half else math.inf
    assert clearance(point, heading, half) == pytest.approx(expected)


def test_clearance_takes_the_nearest_and_of_nothing_is_endless() -> None:
    points = np.array([[9.0, 0.1], [4.0, -0.5], [2.0, 0.9], [-1.0, 0.0]])
    assert clearance(points, 0.0, 0.7) == 4.0
    assert clearance(points, 0.0, 1.0) == 2.0
    assert clearance(np.empty((0, 2)), 0.3, 0.7) == math.inf


@pytest.mark.parametrize("heading", [-0.5, 0.0, 0.5])
def test_clearance_of_a_wall_across(heading: float) -> None:
    wall = np.column_stack([np.full(4001, 6.0), np.linspace(-20.0, 20.0, 4001)])
    # The strip's leading corner meets it first.
    expected = 6.0 / math.cos(heading) - 0.7 * math.tan(abs(heading))
    assert clearance(wall, heading, 0.7) == pytest.approx(expected, abs=0.02)


# --- greedy


@pytest.mark.parametrize("bearing_deg", [50.0, 90.0, 170.0, -50.0, -90.0, -170.0])
def test_turns_on_the_spot_to_a_goal_out_of_view(bearing_deg: float) -> None:
    bearing = math.radians(bearing_deg)
    action = GreedyPolicy().act(blank((10 * math.cos(bearing), 10 * math.sin(bearing))))
    assert (action.forward_m_s, action.right_m_s) == (0.0, 0.0)
    assert math.copysign(1.0, action.yaw_rate_rad_s) == math.copysign(1.0, bearing_deg)
    assert abs(action.yaw_rate_rad_s) > math.radians(30.0)


def test_turning_brings_the_goal_into_view_and_ahead() -> None:
    policy, yaw = GreedyPolicy(), 0.0
    for _ in range(20):
        action = policy.act(look(arena(), (-8.0, 6.0), yaw=yaw))
        yaw += action.yaw_rate_rad_s * S.period_s
    assert math.degrees(yaw) == pytest.approx(math.degrees(math.atan2(6.0, -8.0)), abs=3.0)


@pytest.mark.parametrize("bearing_deg", [0.0, 20.0, -20.0])
def test_flies_at_a_free_goal(bearing_deg: float) -> None:
    bearing = math.radians(bearing_deg)
    goal = (30 * math.cos(bearing), 30 * math.sin(bearing))
    action = GreedyPolicy().act(look(arena(), goal))
    assert math.hypot(action.forward_m_s, action.right_m_s) == pytest.approx(S.max_speed_m_s)
    # The mean course over the period, while the nose turns, is the goal's bearing.
    course = math.atan2(action.right_m_s, action.forward_m_s)
    mean = course + 0.5 * action.yaw_rate_rad_s * S.period_s
    assert math.degrees(mean) == pytest.approx(bearing_deg, abs=1.5)
    if bearing_deg:
        assert action.yaw_rate_rad_s * bearing_deg > 0


def course_of(action: Action) -> float:
    """Return the mean direction of flight over the period in which the action is held."""
    turned = 0.5 * action.yaw_rate_rad_s * S.period_s
    return math.atan2(action.right_m_s, action.forward_m_s) + turned


@pytest.mark.parametrize("east", [-0.8, -0.3, 0.3, 0.8])
@pytest.mark.parametrize("north", [5.0, 7.0])
def test_steers_around_a_box_straight_ahead(east: float, north: float) -> None:
    half = 1.0
    action = GreedyPolicy().act(look(arena((north, east, 0.5, half)), (20.0, 0.0)))
    assert action.forward_m_s > 0.5
    course = course_of(action)
    # The course passes the corners of the near face by the half width (less a pixel at its edge).
    pixel = north / LENS.focal
    corners = np.array([[north - 0.5, east - half], [north - 0.5, east + half]])
    across = corners @ [-math.sin(course), math.cos(course)]
    assert np.abs(across).min() > S.half_width_m - 1.5 * pixel
    assert across[0] * across[1] > 0  # Both on one side: it does not fly through the face.
    assert course * east < 0  # Round the nearer side.


def test_flies_around_the_box_to_the_goal_without_touching_it() -> None:
    scene, policy = arena((8.0, 0.3, 1.0, 1.0)), GreedyPolicy()
    position, yaw, dt = np.zeros(2), 0.0, 0.05
    nearest = math.inf
    for _ in range(80):
        action = policy.act(look(scene, (16.0, 0.0), at=(position[0], position[1]), yaw=yaw))
        for _ in range(round(S.period_s / dt)):
            c, s = math.cos(yaw), math.sin(yaw)
            step = np.array([[c, -s], [s, c]]) @ [action.forward_m_s, action.right_m_s]
            position = position + step * dt
            yaw += action.yaw_rate_rad_s * dt
            gap = np.abs(position - [8.0, 0.3]) - 1.0
            nearest = min(nearest, float(np.hypot(*np.maximum(gap, 0.0))))
        if np.hypot(*(position - [16.0, 0.0])) < 1.0:
            break
    assert np.hypot(*(position - [16.0, 0.0])) < 1.0
    assert nearest > 0.275  # Half the width of the quad.


@pytest.mark.parametrize("depth_m", [2.0, 3.0, 5.0, 8.0])
def test_slows_before_a_wall_so_that_it_can_stop(depth_m: float) -> None:
    action = GreedyPolicy().act(look(arena((depth_m + 1.0, 0.0, 1.0, 40.0)), (30.0, 0.0)))
    speed = math.hypot(action.forward_m_s, action.right_m_s)
    stopping = speed * S.period_s + speed**2 / (2 * S.brake_m_s2)
    # On a slant the free way is longer than the depth, at most by 1 / cos of half the view.
    along = depth_m / math.cos(course_of(action))
    assert 0.0 < stopping <= along - S.stop_distance_m + 0.05


def test_speed_grows_with_the_free_way() -> None:
    speeds = []
    for depth_m in (1.0, 1.6, 2.5, 4.0, 7.0):
        action = GreedyPolicy().act(look(arena((depth_m + 1.0, 0.0, 1.0, 40.0)), (30.0, 0.0)))
        speeds.append(math.hypot(action.forward_m_s, action.right_m_s))
    assert speeds == sorted(speeds)
    assert speeds[-1] > 2 * speeds[1]


@pytest.mark.parametrize("depth_m", [0.4, 0.8, 1.2])
def test_stops_and_turns_where_everything_is_nearer_than_the_stop_distance(depth_m: float) -> None:
    policy = GreedyPolicy()
    action = policy.act(look(arena((depth_m + 1.0, 0.0, 1.0, 40.0)), (30.0, 0.0)))
    assert (action.forward_m_s, action.right_m_s) == (0.0, 0.0)
    assert action.yaw_rate_rad_s != 0.0
    again = policy.act(look(arena((depth_m + 1.0, 0.0, 1.0, 40.0)), (30.0, 0.0)))
    assert again == action  # No dithering.


def test_turns_on_to_the_side_on_which_the_goal_was() -> None:
    for side in (1.0, -1.0):
        policy = GreedyPolicy(GreedySettings(stop_distance_m=2.0))
        policy.act(blank((0.0, 10.0 * side)))
        action = policy.act(blank((10.0, 0.0), depth_m=1.0))
        assert action.yaw_rate_rad_s * side > 0


def test_slows_for_a_near_goal() -> None:
    far = GreedyPolicy().act(blank((20.0, 0.0)))
    near = GreedyPolicy().act(blank((1.5, 0.0)))
    assert near.forward_m_s == pytest.approx(1.5)  # Covers it in two periods.
    assert far.forward_m_s == pytest.approx(S.max_speed_m_s)


def test_what_stands_behind_the_goal_does_not_matter() -> None:
    # A wall of 3 m half width 8 m ahead; the goal is 5 m ahead, before it.
    action = GreedyPolicy().act(look(arena((9.0, 0.0, 1.0, 3.0)), (5.0, 0.0)))
    assert math.degrees(course_of(action)) == pytest.approx(0.0, abs=1.5)


DEPTHS = hnp.arrays(
    np.float32,
    (6, 8),
    elements=st.one_of(st.just(0.0), st.floats(0.0, 65.0, width=32)),
)


@settings(max_examples=200)
@given(DEPTHS, METRES, METRES, TILT, TILT)
def test_never_exceeds_its_limits(
    depth: NDArray[np.float32], forward: float, right: float, roll: float, pitch: float
) -> None:
    lens = Intrinsics.from_fov(8, 6, math.radians(90.0))
    mm = np.rint(depth * 1000.0).astype(np.uint16)
    goal = np.array([forward, right])
    seen = Observation(mm, lens, goal, np.zeros(3), roll, pitch, 0.0)
    action = GreedyPolicy().act(seen)
    assert math.hypot(action.forward_m_s, action.right_m_s) <= S.max_speed_m_s + 1e-9
    assert abs(action.yaw_rate_rad_s) <= S.max_yaw_rate_rad_s + 1e-9
    assert all(
        math.isfinite(n) for n in (action.forward_m_s, action.right_m_s, action.yaw_rate_rad_s)
    )


@pytest.mark.parametrize("goal", [(0.0, 0.0), (0.5, 0.0), (20.0, 5.0), (-20.0, 0.0)])
def test_an_image_without_returns_is_flown(goal: tuple[float, float]) -> None:
    action = GreedyPolicy().act(blank(goal))
    assert math.hypot(action.forward_m_s, action.right_m_s) <= S.max_speed_m_s


# --- actions and registry

NUMBER = st.floats(-1e6, 1e6)


@given(NUMBER, NUMBER, NUMBER, st.floats(0.0, 20.0))
def test_limited_keeps_the_direction_and_the_turn(
    forward: float, right: float, turn: float, limit: float
) -> None:
    action = Action(forward, right, turn).within(limit)
    speed = math.hypot(forward, right)
    assert math.hypot(action.forward_m_s, action.right_m_s) == pytest.approx(
        min(speed, limit), rel=1e-9, abs=1e-12
    )
    assert action.yaw_rate_rad_s == turn
    if speed <= limit:
        assert (action.forward_m_s, action.right_m_s) == pytest.approx((forward, right))
    cross = action.forward_m_s * right - action.right_m_s * forward
    assert cross == pytest.approx(0.0, abs=1e-6 * max(1.0, speed))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_limited_zeroes_what_is_not_finite(bad: float) -> None:
    assert Action(bad, 1.0, 0.2).within(4.0) == Action(0.0, 1.0, 0.2)
    assert Action(1.0, bad, 0.2).within(4.0) == Action(1.0, 0.0, 0.2)
    assert Action(1.0, 2.0, bad).within(4.0) == Action(1.0, 2.0, 0.0)
    assert Action(bad, bad, bad).within(4.0) == Action(0.0, 0.0, 0.0)


def test_policies_are_found_by_name() -> None:
    assert "greedy" in POLICIES
    for name in POLICIES:
        assert find_policy(name).description
        action = load_policy(name, 0.5).act(blank((10.0, 0.0)))
        assert isinstance(action, Action)
        assert action.forward_m_s > 0.0


def test_a_longer_hold_makes_greedy_slower_before_an_obstacle() -> None:
    scene = look(arena((6.0, 0.0, 1.0, 40.0)), (30.0, 0.0))
    quick, slow = (load_policy("greedy", hold_s).act(scene) for hold_s in (0.1, 1.0))
    assert isinstance(slow, Action)
    assert isinstance(quick, Action)
    assert slow.forward_m_s < quick.forward_m_s


@pytest.mark.parametrize("find", [find_policy, lambda name: load_policy(name, 0.5)])
def test_an_unknown_policy_lists_those_that_exist(find: Callable[[str], object]) -> None:
    with pytest.raises(UsageError) as error:
        find("gredy")
    assert "'gredy'" in str(error.value)
    assert ", ".join(POLICIES) in str(error.value)
    assert "\n" not in str(error.value)

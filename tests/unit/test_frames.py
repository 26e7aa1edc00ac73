"""Frames against scipy's Rotation, closed forms and the axioms of a group."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from airl_mav.core import frames
from airl_mav.core.constants import EARTH_RADIUS_M
from airl_mav.core.frames import HOME, Geodetic
from airl_mav.vehicle import rotation as kernels

angles = st.floats(-math.pi, math.pi)
numbers = st.floats(-100.0, 100.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
quaternions = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 4)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: np.array(q) / math.hypot(*q))
)

# World axes of ENU written in NED, and body axes of FLU written in FRD: the frames' definition.
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])

INVERTED = np.array([1.0, -1.0, -1.0, -1.0])
"""A unit quaternion times these signs is the inverse rotation."""


def to_scipy(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(frames.quat_wxyz_to_xyzw(q))


def same_rotation(a: np.ndarray, b: np.ndarray) -> bool:
    """Say whether two unit quaternions are one rotation: q and -q are the same."""
    return abs(abs(float(a @ b)) - 1.0) < 1e-12


# --- the group


@given(quaternions, quaternions, quaternions)
def test_product_is_associative_and_keeps_length(
    a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> None:
    left = frames.quat_multiply(frames.quat_multiply(a, b), c)
    right = frames.quat_multiply(a, frames.quat_multiply(b, c))
    np.testing.assert_allclose(left, right, atol=1e-12)
    assert np.linalg.norm(left) == pytest.approx(1.0, abs=1e-12)


@given(quaternions)
def test_identity_and_inverse(q: np.ndarray) -> None:
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(frames.quat_multiply(q, identity), q)
    np.testing.assert_array_equal(frames.quat_multiply(identity, q), q)
    conjugate = q * INVERTED
    np.testing.assert_allclose(frames.quat_multiply(q, conjugate), identity, atol=1e-12)
    np.testing.assert_allclose(frames.quat_multiply(conjugate, q), identity, atol=1e-12)


@given(quaternions, st.floats(0.01, 100.0))
def test_normalize_keeps_the_rotation_and_the_sign_convention(q: np.ndarray, scale: float) -> None:
    unit = frames.quat_normalize(scale * q)
    assert np.linalg.norm(unit) == pytest.approx(1.0, abs=1e-12)
    assert unit[0] >= 0.0
    assert same_rotation(unit, q)


def test_a_zero_quaternion_is_refused() -> None:
    with pytest.raises(ValueError, match="zero"):
        frames.quat_normalize(np.zeros(4))


# --- scipy


@given(quaternions)
def test_matrix(q: np.ndarray) -> None:
    np.testing.assert_allclose(frames.quat_to_matrix(q), to_scipy(q).as_matrix(), atol=1e-12)


@given(quaternions, quaternions)
def test_product(a: np.ndarray, b: np.ndarray) -> None:
    ours = frames.quat_multiply(a, b)
    theirs = np.roll((to_scipy(a) * to_scipy(b)).as_quat(), 1)
    assert same_rotation(ours, theirs)


@given(angles, st.floats(-1.57, 1.57), angles)
def test_euler_angles_are_the_aerospace_sequence(roll: float, pitch: float, yaw: float) -> None:
    q = frames.quat_from_euler(roll, pitch, yaw)
    reference = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    assert same_rotation(q, np.roll(reference.as_quat(), 1))
    euler = frames.quat_to_euler(q)
    # Near the pole two angles melt into one: compare the rotation, not the angles.
    assert same_rotation(q, frames.quat_from_euler(*euler))
    if abs(pitch) < 1.5:
        theirs = reference.as_euler("ZYX")
        for ours, expected in zip((euler.yaw, euler.pitch, euler.roll), theirs, strict=True):
            assert abs(frames.wrap_pi(ours - expected)) < 1e-9
        assert abs(frames.wrap_pi(frames.quat_yaw(q) - theirs[0])) < 1e-9


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_euler_at_the_poles_is_finite_and_the_same_rotation(pitch: float) -> None:
    q = frames.quat_from_euler(0.3, pitch, 0.8)
    euler = frames.quat_to_euler(q)
    assert euler.pitch == pytest.approx(pitch, abs=1e-7)
    assert all(math.isfinite(angle) for angle in euler)


# --- conventions


@given(vectors)
def test_axis_swaps(v: np.ndarray) -> None:
    np.testing.assert_array_equal(frames.ned_to_enu(v), ENU_FROM_NED @ v)
    np.testing.assert_array_equal(frames.frd_to_flu(v), FLU_FROM_FRD @ v)
    np.testing.assert_array_equal(frames.ned_to_enu(frames.ned_to_enu(v)), v)
    np.testing.assert_array_equal(frames.frd_to_flu(frames.frd_to_flu(v)), v)


def test_axis_swaps_take_stacks() -> None:
    stack = np.arange(24.0).reshape(2, 4, 3)
    np.testing.assert_array_equal(frames.ned_to_enu(stack), stack @ ENU_FROM_NED.T)
    np.testing.assert_array_equal(frames.frd_to_flu(stack), stack @ FLU_FROM_FRD.T)


@given(quaternions, vectors)
def test_attitude_turns_a_vector_to_the_same_place_in_both_conventions(
    q: np.ndarray, v_frd: np.ndarray
) -> None:
    q_enu = frames.quat_ned_frd_to_enu_flu(q)
    in_ned = to_scipy(q).apply(v_frd)
    in_enu = to_scipy(q_enu).apply(FLU_FROM_FRD @ v_frd)
    np.testing.assert_allclose(ENU_FROM_NED @ in_ned, in_enu, atol=1e-9)
    assert same_rotation(frames.quat_ned_frd_to_enu_flu(q_enu), q)


def test_facing_north_is_a_quarter_turn_in_enu() -> None:
    q = frames.quat_ned_frd_to_enu_flu(np.array([1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(to_scipy(q).as_euler("ZYX"), [math.pi / 2, 0, 0], atol=1e-12)


@given(vectors, angles)
def test_heading_frame_is_a_turn_about_the_vertical(v: np.ndarray, yaw: float) -> None:
    turn = Rotation.from_euler("Z", yaw)
    np.testing.assert_allclose(frames.heading_to_ned(v, yaw), turn.apply(v), atol=1e-9)
    np.testing.assert_allclose(frames.ned_to_heading(v, yaw), turn.inv().apply(v), atol=1e-9)


def test_heading_east_sees_north_on_the_left() -> None:
    north = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(frames.ned_to_heading(north, math.pi / 2), [0, -1, 0], atol=1e-15)


@given(st.floats(-1e4, 1e4))
def test_wrap(angle: float) -> None:
    wrapped = frames.wrap_pi(angle)
    assert -math.pi <= wrapped <= math.pi
    turns = (angle - wrapped) / (2 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-9)


def test_wrap_at_the_seam() -> None:
    assert frames.wrap_pi(math.pi) == -math.pi
    assert frames.wrap_pi(-math.pi) == -math.pi
    assert frames.wrap_pi(0.0) == 0.0


# --- the globe

places = st.tuples(st.floats(-80.0, 80.0), st.floats(-179.0, 179.0), st.floats(-100.0, 5000.0)).map(
    lambda p: Geodetic(*p)
)
offsets = st.tuples(
    st.floats(-20_000.0, 20_000.0), st.floats(-20_000.0, 20_000.0), st.floats(-500.0, 500.0)
).map(np.array)


def haversine_m(a: Geodetic, b: Geodetic) -> float:
    lat1, lat2 = math.radians(a.latitude_deg), math.radians(b.latitude_deg)
    dlon = math.radians(b.longitude_deg - a.longitude_deg)
    h = math.sin((lat2 - lat1) / 2) ** 2
    h += math.cos(lat1) * math.cos(lat2) * math.sin(dlon / 2) ** 2
    return 2 * EARTH_RADIUS_M * math.asin(math.sqrt(h))


@given(places, offsets)
def test_local_to_globe_and_back(origin: Geodetic, ned: np.ndarray) -> None:
    there = frames.local_to_geodetic(ned, origin)
    np.testing.assert_allclose(frames.geodetic_to_local(there, origin), ned, atol=1e-5)
    # The projection keeps distances from the origin, and heights.
    assert haversine_m(origin, there) == pytest.approx(math.hypot(ned[0], ned[1]), abs=1e-4)
    assert there.altitude_m == origin.altitude_m - ned[2]


@given(st.floats(0.0, 2 * math.pi), st.floats(1.0, 20_000.0))
def test_bearing_from_the_origin_is_kept(bearing: float, distance: float) -> None:
    ned = np.array([distance * math.cos(bearing), distance * math.sin(bearing), 0.0])
    there = frames.local_to_geodetic(ned, HOME)
    lat1, lat2 = math.radians(HOME.latitude_deg), math.radians(there.latitude_deg)
    dlon = math.radians(there.longitude_deg - HOME.longitude_deg)
    # Initial bearing of the great circle.
    great = math.atan2(
        math.sin(dlon) * math.cos(lat2),
        math.cos(lat1) * math.sin(lat2) - math.sin(lat1) * math.cos(lat2) * math.cos(dlon),
    )
    assert abs(frames.wrap_pi(great - bearing)) < 1e-6


def test_a_degree_of_latitude_and_the_origin_itself() -> None:
    degree = math.radians(1.0) * EARTH_RADIUS_M
    there = frames.local_to_geodetic(np.array([degree, 0.0, 0.0]), Geodetic(10.0, 20.0, 0.0))
    assert there.latitude_deg == pytest.approx(11.0, abs=1e-10)
    assert there.longitude_deg == pytest.approx(20.0, abs=1e-10)
    assert frames.local_to_geodetic(np.zeros(3), HOME) == HOME
    np.testing.assert_array_equal(frames.geodetic_to_local(HOME, HOME), np.zeros(3))


def test_millimetres_survive_the_way_over_the_globe() -> None:
    for ned in np.diag([1e-3, 1e-3, 1e-3]):
        back = frames.geodetic_to_local(frames.local_to_geodetic(ned, HOME), HOME)
        np.testing.assert_allclose(back, ned, atol=1e-7)


# --- the kernels speak the same conventions


@given(quaternions, quaternions, vectors)
def test_kernels_agree(a: np.ndarray, b: np.ndarray, v: np.ndarray) -> None:
    ta, tb, tv = tuple(a), tuple(b), tuple(v)
    np.testing.assert_allclose(kernels.rotate(ta, tv), frames.quat_to_matrix(a) @ v, atol=1e-10)
    np.testing.assert_allclose(kernels.multiply(ta, tb), frames.quat_multiply(a, b), atol=1e-12)
    np.testing.assert_array_equal(kernels.conjugate(ta), a * INVERTED)
    np.testing.assert_allclose(kernels.normalize(tuple(3.0 * a)), a, atol=1e-12)
    assert kernels.yaw_of(ta) == pytest.approx(frames.quat_yaw(a), abs=1e-12)
    r = 0.03 * v
    exponential = np.roll(Rotation.from_rotvec(r).as_quat(), 1)
    assert same_rotation(np.array(kernels.exponential(tuple(r))), exponential)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 9.9e-9, 1.01e-8, 1e-6])
def test_small_rotation_vectors(size: float) -> None:
    q = kernels.exponential((0.0, size, 0.0))
    np.testing.assert_allclose(q, [1.0, 0.0, size / 2, 0.0], rtol=1e-12, atol=1e-13)


@given(st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), vectors)
def test_a_camera_looks_where_it_is_mounted_to(pitch_up: float, yaw: float, v: np.ndarray) -> None:
    # To the right of the nose is a negative turn about the axis up.
    q = frames.quat_flu_from_optical(pitch_up, yaw)
    expected = to_scipy(frames.quat_flu_from_optical(pitch_up)).apply(v)
    expected = Rotation.from_euler("Z", -yaw).apply(expected)
    np.testing.assert_allclose(to_scipy(q).apply(v), expected, atol=1e-9)


@given(st.floats(-1.5, 1.5), vectors)
def test_a_camera_looks_ahead_and_up_as_it_is_mounted(pitch_up: float, v: np.ndarray) -> None:
    q = frames.quat_flu_from_optical(pitch_up)
    # Optical is right, down, forward. The nose goes up by a negative turn about the left axis.
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    expected = Rotation.from_euler("Y", -pitch_up).apply(level @ v)
    np.testing.assert_allclose(to_scipy(q).apply(v), expected, atol=1e-9)
    ahead = to_scipy(q).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(ahead, [math.cos(pitch_up), 0.0, math.sin(pitch_up)], atol=1e-12)


@given(vectors)
def test_an_attitude_from_a_direction_points_there_and_is_level(v: np.ndarray) -> None:
    length = np.linalg.norm(v)
    if length < 1e-6:
        return
    turned = to_scipy(frames.quat_from_direction(v))
    np.testing.assert_allclose(turned.apply([1.0, 0.0, 0.0]), v / length, atol=1e-9)
    assert turned.apply([0.0, 1.0, 0.0])[2] == pytest.approx(0.0, abs=1e-9)

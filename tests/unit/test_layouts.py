"""Observation layouts against independent references: values by hand, scipy, block reductions."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs import observations
from airl_mav.policy.images import NUMPY, Bytes, shrink_depth
from airl_mav.policy.layouts import (
    STRIP_ROWS,
    Encoded,
    ablated,
    boxes,
    encode_layout,
    layout_of,
    newest_frame,
)
from airl_mav.policy.observation import InFlight, Kinematics, Observation, observe
from airl_mav.policy.observation_spec import ObservationSpec, camera_mismatch
from airl_mav.policy.planner import LEARNED, OUTCOME_FEATURES, WORST_S, PlannerPolicy
from airl_mav.profiles.projections import CHANNELS, KINDS, CameraKind

FAR_MM = 65_535


def spec(layout: str = "body", height: int = 24, width: int = 32, **more: Any) -> ObservationSpec:
    known = {"layout": layout, "height_px": height, "width_px": width}
    return ObservationSpec.model_validate(
        known | {"horizontal_fov_deg": 90.0, "range_m": 20.0} | more
    )


def round_lens(width: int, height: int, fov_deg: float = 360.0) -> Intrinsics:
    return Intrinsics.from_fov(width, height, math.radians(fov_deg), "cylindrical")


def lens(width: int, height: int, fov_deg: float = 90.0) -> Intrinsics:
    return Intrinsics.from_fov(width, height, math.radians(fov_deg))


def seen(depth_mm: Any, **more: Any) -> Observation:
    """Return n vehicles at rest, nose north, the goal 10 m ahead."""
    depth = np.asarray(depth_mm, np.uint16)
    n, height, width = depth.shape
    still: dict[str, Any] = {
        "goal": np.tile([10.0, 0.0], (n, 1)),
        "velocity": np.zeros((n, 3)),
        "roll": np.zeros(n),
        "pitch": np.zeros(n),
        "yaw": np.zeros(n),
    }
    return Observation(image=depth, intrinsics=lens(width, height), **(still | more))


def grey(layout: ObservationSpec, depth_m: float | None) -> int:
    """Return the grey value of a wall at a depth; None: no return."""
    rows = layout.camera_rows
    value = 0 if depth_m is None else int(depth_to_z16(np.array(depth_m)))
    image = encode_layout(layout, seen(np.full((1, rows, layout.width_px), value)))["depth"]
    camera = image[0, 0, layout.height_px - rows :]
    assert camera.min() == camera.max()
    return int(camera[0, 0])


# --- grey values


@pytest.mark.parametrize(
    ("depth_m", "wanted"),
    [
        # By hand, airlearning-rl's getScreenDepthVis: 255 // max(1, d), inverted, to the tenth
        # power of its share: d = 5 -> 51 -> 204 -> 255 (0.8)^10 = 27.38.
        (0.001, 0),
        (0.5, 0),
        (1.0, 0),
        (2.0, 0),
        (5.0, 27),
        (10.0, 90),
        (20.0, 157),
        (50.0, 209),
    ],
)
def test_grey_values_of_the_paper(depth_m: float, wanted: int) -> None:
    assert grey(spec("paper", 34, range_m=60.0), depth_m) == wanted


@pytest.mark.parametrize("depth_m", [None, 60.001, 64.0, 65.535])
def test_the_paper_sees_white_where_nothing_is(depth_m: float | None) -> None:
    assert grey(spec("paper", 34, range_m=60.0), depth_m) == 255


@pytest.mark.parametrize(
    ("depth_m", "wanted"),
    [
        (0.001, 0),
        (0.039, 0),  # 255 * 0.039 / 20 = 0.497
        (0.040, 1),  # 0.51
        (5.0, 64),  # 63.75
        (10.0, 128),  # 127.5, rounded to even.
        (15.0, 191),  # 191.25
        (19.99, 255),  # 254.87
        (20.0, 255),
        (20.001, 255),
        (65.535, 255),
        (None, 255),
    ],
)
def test_grey_values_in_proportion_to_the_range(depth_m: float | None, wanted: int) -> None:
    assert grey(spec(), depth_m) == wanted


@given(range_m=st.floats(0.6, 65.0), depth_mm=st.integers(1, FAR_MM))
def test_nearer_is_never_brighter(range_m: float, depth_mm: int) -> None:
    layout = spec(range_m=range_m)
    here = grey(layout, depth_mm / 1000.0)
    assert here >= grey(layout, max(1, depth_mm - 500) / 1000.0)
    if depth_mm / 1000.0 <= range_m:
        assert here == pytest.approx(255.0 * depth_mm / 1000.0 / range_m, abs=0.5 + 1e-9)
    else:
        assert here == 255


# --- pooling


@given(
    depth=arrays.arrays(
        np.uint16,
        st.tuples(
            st.integers(1, 3), st.sampled_from([4, 8, 12]), st.sampled_from([8, 16, 24])
        ).filter(lambda shape: shape[2] == 2 * shape[1]),
        elements=st.sampled_from([0, 1, 2, 500, 19_999, 20_000, 20_001, 65_534, FAR_MM]),
    )
)
def test_the_nearest_return_of_each_block_wins(depth: np.ndarray) -> None:
    """Against a reduction over reshaped blocks in floating point, no return being infinite."""
    layout = spec(height=4, width=8)
    n, height, width = depth.shape
    metres = np.where(depth == 0, np.inf, depth / 1000.0)
    blocks = metres.reshape(n, 4, height // 4, 8, width // 8).min(axis=(2, 4))
    wanted = np.rint(255.0 * np.minimum(blocks, 20.0) / 20.0)
    np.testing.assert_array_equal(encode_layout(layout, seen(depth))["depth"][:, 0], wanted)


def test_one_near_pixel_fills_its_block_and_no_other() -> None:
    depth = np.zeros((1, 48, 64), np.uint16)
    depth[0, 13, 47] = 5000
    image = encode_layout(spec(), seen(depth))["depth"][0, 0]
    assert image[6, 23] == 64
    image[6, 23] = 255
    assert (image == 255).all()


def test_the_camera_of_the_networks_own_size_is_taken_as_it_is() -> None:
    depth = np.arange(1, 24 * 32 + 1, dtype=np.uint16).reshape(1, 24, 32) * 25
    wanted = np.rint(np.minimum(depth / 1000.0 / 20.0, 1.0) * 255.0)
    np.testing.assert_array_equal(encode_layout(spec(), seen(depth))["depth"][0], wanted)


def test_what_was_seen_is_left_alone() -> None:
    depth = np.random.default_rng(1).integers(0, 65_536, (2, 48, 64), np.uint16)
    before = depth.copy()
    depth.setflags(write=False)
    for layout in (spec(), spec("paper", 34)):
        encode_layout(layout, seen(depth))
    np.testing.assert_array_equal(depth, before)


# --- vectors


poses = st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(
    lambda q: math.hypot(*q) > 0.1
)
metres = st.floats(-100.0, 100.0)


@given(
    quaternion=poses,
    position=st.tuples(metres, metres, metres),
    velocity=st.tuples(metres, metres, metres),
    goal=st.tuples(metres, metres),
)
def test_vectors_against_scipy(
    quaternion: list[float],
    position: tuple[float, ...],
    velocity: tuple[float, ...],
    goal: tuple[float, ...],
) -> None:
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    turned = Rotation.from_quat(q, scalar_first=True)
    nose = turned.apply([1.0, 0.0, 0.0])
    if math.hypot(nose[0], nose[1]) < 1e-3:
        return  # Straight up or down: there is no heading.
    level = Rotation.from_euler("z", math.atan2(nose[1], nose[0]))
    state = Kinematics(np.array([position]), np.array([velocity]), q[None])
    image = np.zeros((1, 24, 32), np.uint16)
    looked = observe(image, lens(32, 24), state, np.array([goal]))
    away = np.array([goal[0] - position[0], goal[1] - position[1], 0.0])
    distance = float(np.hypot(away[0], away[1]))

    body = encode_layout(spec(), looked)
    assert body["velocity"][0] == pytest.approx(level.inv().apply(velocity) / 5.0, abs=1e-4)
    if distance > 1e-3:
        ahead = level.inv().apply(away) / distance
        assert body["goal"][0, :2] == pytest.approx(ahead[:2], abs=1e-4)
    assert body["goal"][0, 2] == pytest.approx(distance / 20.0, abs=1e-5)

    # World frame: values are passed through unchanged at any attitude.
    paper = encode_layout(spec("paper", 34), looked)
    assert paper["velocity"][0] == pytest.approx(velocity, abs=1e-3)
    assert paper["goal"][0] == pytest.approx([away[0], away[1], distance], abs=1e-3)


def test_at_the_goal_there_is_no_direction_but_a_distance_of_zero() -> None:
    here = encode_layout(spec(), seen(np.zeros((1, 24, 32)), goal=np.zeros((1, 2))))["goal"]
    np.testing.assert_array_equal(here, [[0.0, 0.0, 0.0]])


@pytest.mark.parametrize("layout", ["body", "scan"])
def test_a_height_is_a_fourth_number_and_the_others_stay(layout: str) -> None:
    shown: dict[str, Any] = {"goal_down": np.array([-2.5, 1.0])}
    shown["goal"] = np.array([[3.0, 4.0], [0.0, 2.0]])
    still = Kinematics(np.zeros((2, 3)), np.zeros((2, 3)), np.tile((1.0, 0.0, 0.0, 0.0), (2, 1)))
    shown["states"] = (still,)
    image = np.full((2, 24, 32), 4000)
    told = encode_layout(spec(layout, goal_height=True), seen(image, **shown))
    plain = encode_layout(spec(layout), seen(image, **shown))
    np.testing.assert_array_equal(told["goal"][:, :3], plain["goal"])
    np.testing.assert_allclose(told["goal"], [[0.6, 0.8, 0.25, -0.5], [0, 1, 0.1, 0.2]], atol=1e-7)
    assert {k: v.shape for k, v in plain.items()}["goal"] == (2, 3)


@pytest.mark.parametrize("below", [None, np.array([math.nan])])
def test_a_goal_without_a_height_cannot_be_told(below: np.ndarray | None) -> None:
    with pytest.raises(UsageError, match="this goal has no height"):
        encode_layout(spec(goal_height=True), seen(np.zeros((1, 24, 32)), goal_down=below))


def test_a_card_says_it_only_where_it_is_so() -> None:
    assert "goal_height" not in spec().model_dump()
    assert spec(goal_height=True).model_dump()["goal_height"] is True
    assert spec(goal_height=True) == ObservationSpec.model_validate(
        spec(goal_height=True).model_dump()
    )


def test_the_goal_to_the_right_has_a_positive_sine() -> None:
    right = encode_layout(spec(), seen(np.zeros((1, 24, 32)), goal=np.array([[0.0, 5.0]])))["goal"]
    np.testing.assert_allclose(right, [[0.0, 1.0, 0.25]])


# --- the strip of the paper


@pytest.mark.parametrize(
    ("bearing_deg", "bar"),
    [
        # (bearing + 180) / 360 * 256, the bar a column wider to each side, whole at the edges.
        (0.0, (127, 129)),
        (90.0, (191, 193)),
        (-90.0, (63, 65)),
        (179.99, (253, 255)),
        (180.0, (253, 255)),
        (-179.99, (0, 2)),
        (-178.0, (0, 2)),  # Column 1.4.
        (-177.0, (1, 3)),  # 2.1
    ],
)
def test_the_strip_draws_the_bearing(bearing_deg: float, bar: tuple[int, int]) -> None:
    layout = spec("paper", 154, 256)
    angle = math.radians(bearing_deg)
    goal = 7.0 * np.array([[math.cos(angle), math.sin(angle)]])
    image = encode_layout(layout, seen(np.zeros((1, 144, 256)), goal=goal))["depth"][0, 0]
    assert image.shape == (154, 256)
    wanted = np.full((STRIP_ROWS, 256), 255)
    wanted[:, bar[0] : bar[1] + 1] = 0
    wanted[-1] = 0
    np.testing.assert_array_equal(image[:STRIP_ROWS], wanted)
    assert (image[STRIP_ROWS:] == 255).all()


# --- many vehicles, shapes, ablation


def random_state(n: int) -> tuple[np.ndarray, Kinematics, np.ndarray]:
    rng = np.random.default_rng(n)
    quaternions = rng.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    depth = rng.integers(0, 65_536, (n, 48, 64), np.uint16)
    depth[rng.random(depth.shape) < 0.3] = 0
    state = Kinematics(rng.normal(0, 20, (n, 3)), rng.normal(0, 3, (n, 3)), quaternions)
    return depth, state, rng.normal(0, 20, (n, 2))


@pytest.mark.parametrize("layout", [spec(), spec("paper", 34)], ids=["body", "paper"])
def test_n_vehicles_are_encoded_as_each_by_itself(layout: ObservationSpec) -> None:
    depth, state, goal = random_state(9)
    camera = lens(64, 48)
    together = encode_layout(layout, observe(depth, camera, state, goal))
    for i in range(9):
        one = slice(i, i + 1)
        alone = Kinematics(state.position[one], state.velocity[one], state.quaternion[one])
        single = encode_layout(layout, observe(depth[one], camera, alone, goal[one]))
        for key, values in single.items():
            np.testing.assert_array_equal(values[0], together[key][i])


@pytest.mark.parametrize("layout", [spec(), spec("paper", 34)], ids=["body", "paper"])
@pytest.mark.parametrize("n", [0, 1, 4])
def test_the_arrays_are_those_of_the_boxes(layout: ObservationSpec, n: int) -> None:
    depth, state, goal = random_state(n)
    encoded: Encoded = encode_layout(layout, observe(depth, lens(64, 48), state, goal))
    assert list(encoded) == list(boxes(layout))
    for key, box in boxes(layout).items():
        assert encoded[key].shape == (n, *box.shape)
        assert encoded[key].dtype == box.dtype


def test_images_of_the_decisions_before_are_stacked_the_newest_first() -> None:
    depth, state, goal = random_state(4)
    before = tuple(np.roll(depth, k, axis=0) for k in (1, 2))
    for kept in range(3):
        looked = observe(
            depth, lens(64, 48), state, goal, earlier=[(image, state) for image in before[:kept]]
        )
        # Of one vehicle, as the companion has it.
        alone = looked.rows(2).rows(None)
        for seen_, rows in ((looked, slice(None)), (alone, [2])):
            stack = encode_layout(spec(frames=3), seen_)["depth"]
            for k, image in enumerate((depth, *before)[: kept + 1]):
                single = encode_layout(spec(), observe(image, lens(64, 48), state, goal))["depth"]
                np.testing.assert_array_equal(stack[:, k], single[rows, 0])
            assert (stack[:, kept + 1 :] == 255).all()


def test_images_are_not_stacked_below_a_strip() -> None:
    with pytest.raises(ValidationError, match="frames = 2: accepted: 1 with layout 'paper'"):
        spec("paper", 34, frames=2)


@pytest.mark.parametrize("key", ["depth", "velocity", "goal"])
def test_an_ablated_input_is_zero_and_the_others_are_as_they_were(key: str) -> None:
    depth, state, goal = random_state(3)
    encoded = encode_layout(spec(), observe(depth, lens(64, 48), state, goal))
    blind = ablated(encoded, key)
    assert not blind[key].any()
    assert encoded[key].any()
    for other in encoded.keys() - {key}:
        np.testing.assert_array_equal(blind[other], encoded[other])
    assert {k: (v.shape, v.dtype) for k, v in blind.items()} == {
        k: (v.shape, v.dtype) for k, v in encoded.items()
    }


# --- cameras

ROUND: dict[str, Any] = {"projection": "cylindrical", "horizontal_fov_deg": 360.0}


def test_only_a_cylinder_sees_all_round() -> None:
    assert spec(**ROUND).projection == "cylindrical"
    assert spec().projection == "pinhole"
    with pytest.raises(FieldError, match=r"horizontal_fov_deg 360.*< 170 deg with .*pinhole"):
        spec(horizontal_fov_deg=360.0)
    with pytest.raises(FieldError, match=r"horizontal_fov_deg 360.*190 deg with .*fisheye"):
        spec(projection="fisheye", horizontal_fov_deg=360.0)
    with pytest.raises(ValidationError, match="pinhole"):
        spec(projection="orthographic")


@pytest.mark.parametrize(
    ("layout", "camera"),
    [
        (spec(), lens(32, 24)),
        (spec(), lens(64, 48)),
        (spec(), lens(320, 240)),
        (spec("paper", 34), lens(32, 24)),
        (spec("paper", 154, 256), lens(256, 144)),
        (spec(horizontal_fov_deg=86.95), lens(64, 48, 87.0)),
        (spec("body", 20, 64, **ROUND), round_lens(128, 40)),
        (spec(**(ROUND | {"horizontal_fov_deg": 270.0})), round_lens(64, 48, 270.0)),
    ],
)
def test_cameras_that_serve(layout: ObservationSpec, camera: Intrinsics) -> None:
    assert camera_mismatch(layout, camera) is None


@pytest.mark.parametrize(
    ("layout", "camera", "words"),
    [
        (spec(), lens(48, 36), ["48x36", "32x24 px or a whole multiple"]),
        (spec(), lens(64, 24), ["64x24"]),
        (spec(), lens(32, 48), ["32x48"]),
        (spec(), lens(16, 12), ["16x12"]),
        (spec("paper", 34), lens(32, 34), ["32x34", "32x24"]),
        (spec(), lens(64, 48, 89.8), ["89.8 deg", "accepted: 90.0 deg"]),
        (spec(), lens(64, 48, 69.0), ["69.0 deg"]),
        (spec(), round_lens(64, 48, 90.0), ["cylindrical camera; accepted: pinhole"]),
        (spec(**ROUND), lens(64, 48), ["pinhole camera; accepted: cylindrical"]),
        (spec(**ROUND), round_lens(64, 48, 270.0), ["270.0 deg", "accepted: 360.0 deg"]),
    ],
)
def test_cameras_that_do_not(layout: ObservationSpec, camera: Intrinsics, words: list[str]) -> None:
    reason = camera_mismatch(layout, camera)
    assert reason is not None
    for word in words:
        assert word in reason


@pytest.mark.parametrize("height", [4, 10])
def test_the_strip_leaves_room_for_the_camera(height: int) -> None:
    with pytest.raises(ValidationError, match=f"height_px = {height}"):
        spec("paper", height)
    assert spec("paper", 11).camera_rows == 1
    assert spec("body", height).camera_rows == height


@pytest.mark.parametrize(("rows", "columns"), [(48, 64), (24, 32), (12, 16), (16, 64)])
def test_the_compiled_images_are_those_of_numpy(rows: int, columns: int) -> None:
    rng = np.random.default_rng(3)
    depth = rng.integers(0, 1 << 16, (5, 48, 64)).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.2] = 0
    depth[0, :4] = (1 << 16) - 1
    bytes_of = Bytes(rng.integers(0, 256, 1 << 16).astype(np.uint8))
    wanted = shrink_depth(depth, rows, columns, bytes_of)
    np.testing.assert_array_equal(observations.shrink_depth(depth, rows, columns, bytes_of), wanted)


@pytest.mark.parametrize("range_m", [3.0, 5.0, 10.0, 12.5, 18.0, 20.0, 30.0, 65.0])
def test_the_compiled_images_in_proportion_are_those_of_the_table(range_m: float) -> None:
    """Every depth value, at ranges supported by single precision and at 18 m, which is not."""
    depth = np.arange(1 << 16, dtype=np.uint16).reshape(1, 256, 256)
    layout = spec(height=256, width=256, range_m=range_m)
    found = encode_layout(layout, seen(depth), observations.COMPILED)["depth"]
    np.testing.assert_array_equal(found, encode_layout(layout, seen(depth), NUMPY)["depth"])


# --- colour


def random_colours(kind: CameraKind, n: int = 3, seed: int = 7) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (n, 48, 64, CHANNELS[kind]), np.uint8)


def coloured(image: NDArray[np.uint8], kind: CameraKind, **more: Any) -> Observation:
    known = seen(np.zeros(image.shape[:3], np.uint16))
    camera = Intrinsics.from_fov(64, 48, math.pi / 2, kind=kind)
    return replace(known, image=image, intrinsics=camera, **more)


@pytest.mark.parametrize("kind", ["rgb", "grey"])
@pytest.mark.parametrize(("rows", "columns"), [(48, 64), (24, 32), (16, 64), (12, 16)])
def test_a_colour_is_the_mean_of_its_block(kind: CameraKind, rows: int, columns: int) -> None:
    image = random_colours(kind)
    layout = spec(height=rows, width=columns, kind=kind)
    found = encode_layout(layout, coloured(image, kind))[kind]
    tall, wide = 48 // rows, 64 // columns
    blocks = image.reshape(3, rows, tall, columns, wide, -1).mean(axis=(2, 4))
    wanted = np.floor(np.moveaxis(blocks, -1, 1) + 0.5)
    np.testing.assert_array_equal(found, wanted)
    assert found.dtype == np.uint8
    assert found.shape[1:] == boxes(layout)[kind].shape == (CHANNELS[kind], rows, columns)
    compiled = encode_layout(layout, coloured(image, kind), observations.COMPILED)[kind]
    np.testing.assert_array_equal(compiled, found)


@pytest.mark.parametrize("kind", ["rgb", "grey"])
def test_colours_are_stacked_the_newest_first_and_black_before_the_first(kind: CameraKind) -> None:
    image, before = random_colours(kind), random_colours(kind, seed=8)
    layout = spec(height=48, width=64, kind=kind, frames=3)
    stack = encode_layout(layout, coloured(image, kind, earlier=(before,)))[kind]
    channels = CHANNELS[kind]
    assert stack.shape == (3, 3 * channels, 48, 64)
    np.testing.assert_array_equal(stack[:, :channels], np.moveaxis(image, -1, 1))
    np.testing.assert_array_equal(stack[:, channels : 2 * channels], np.moveaxis(before, -1, 1))
    assert not stack[:, 2 * channels :].any()
    one = {key: values[1] for key, values in encode_layout(layout, coloured(image, kind)).items()}
    np.testing.assert_array_equal(newest_frame(layout, one), image[1].squeeze())


def test_the_paper_s_layout_draws_its_strip_into_depth_alone() -> None:
    with pytest.raises(
        ValidationError, match="kind = 'rgb': accepted: 'depth' with layout 'paper'"
    ):
        spec("paper", 34, kind="rgb")


@pytest.mark.parametrize("asked", KINDS)
@pytest.mark.parametrize("given", KINDS)
def test_a_camera_serves_what_it_gives(asked: CameraKind, given: CameraKind) -> None:
    camera = Intrinsics.from_fov(64, 48, math.pi / 2, kind=given)
    wanted = None if asked == given else f"{given} camera; accepted: {asked}"
    assert camera_mismatch(spec(kind=asked), camera) == wanted


# --- candidates


def told(n: int) -> dict[str, Any]:
    """Return what the layout `candidates` needs besides `seen`."""
    state = Kinematics(np.zeros((n, 3)), np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)))
    return {"states": (state,), "in_flight": InFlight.of_first_decisions(n)}


def candidates_spec() -> ObservationSpec:
    return spec("candidates", in_flight=["command", "latency"])


def test_candidates_are_those_of_the_planner() -> None:
    depth = np.zeros((2, 48, 64))
    depth[1, :, 20:40] = 6000
    looked, wanted = seen(depth, **told(2)), candidates_spec()
    encoded = encode_layout(wanted, looked)
    for key, box in boxes(wanted).items():
        assert encoded[key].shape == (2, *box.shape)
        assert encoded[key].dtype == box.dtype
        assert np.isfinite(encoded[key]).all()
    for i in range(2):
        found = PlannerPolicy(LEARNED).candidates(looked.rows(i), features=True)
        known = len(found.costs)
        np.testing.assert_allclose(encoded["candidates"][i, :known], found.features, rtol=1e-6)
        assert encoded["costs"][i].argmin() == found.costs.argmin()
        assert (encoded["costs"][i, known:] == 2.0 * WORST_S).all()
        best = encoded["commands"][i, found.costs.argmin()] * LEARNED.limits
        np.testing.assert_allclose(best, found.commands[found.costs.argmin()], rtol=1e-6)


def test_an_encoder_remembers_its_flight_alone() -> None:
    wall = np.zeros((1, 48, 64))
    wall[0, :, 20:40] = 6000
    first, second = (layout_of("candidates").encoder() for _ in range(2))
    free = seen(np.zeros((1, 48, 64)), **told(1))
    for _ in range(3):
        first(candidates_spec(), seen(wall, **told(1)))
    remembered, fresh = (each(candidates_spec(), free) for each in (first, second))
    # With the longest flight.
    column = 2 * OUTCOME_FEATURES + 2
    gap, free_gap = (each["candidates"][0, :100, column] for each in (remembered, fresh))
    assert gap.min() < free_gap.min()
    np.testing.assert_array_equal(fresh["costs"], encode_layout(candidates_spec(), free)["costs"])


@pytest.mark.parametrize(
    ("field", "value"), [("frames", 3), ("in_flight", []), ("goal_height", True)]
)
def test_candidates_reject_other_inputs(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{field}.*accepted.*with layout 'candidates'"):
        spec("candidates", **({"in_flight": ["command", "latency"]} | {field: value}))

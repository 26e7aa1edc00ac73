"""Forward prediction: motion against an ODE solver, images against the renderer."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import quat_from_euler, quat_to_matrix, quats_to_euler
from airl_mav.policy.observation import Kinematics
from airl_mav.prediction import (
    LINK_US,
    RECENT,
    CameraPose,
    Compensator,
    ExpectedLatency,
    MotionBatch,
    PosedImage,
    Reprojector,
    flown_on,
    leaning,
)
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import Response, load_vehicle

QUAD = load_vehicle("quad")
RESPONSE = Response(
    dead_time_s=0.2,
    velocity_time_s=0.45,
    yaw_rate_dead_time_s=0.12,
    yaw_rate_time_s=0.1,
    drag_1_s=0.15,
)
LENS = Intrinsics.of(QUAD.camera)
RANGE_M = QUAD.camera.range_m
US_PER_S = 1_000_000

# --- motion


def integrated(
    start: np.ndarray, command: np.ndarray, seconds: float, response: Response
) -> np.ndarray:
    """Return position, velocity, heading and its rate (8,), by integration of the equations.

    Velocity and yaw rate each approach their setpoint with their time constant; the setpoint's
    horizontal part turns with the nose.
    """

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        cos, sin = math.cos(y[6]), math.sin(y[6])
        forward, right, down, turn = command
        wanted = np.array([forward * cos - right * sin, forward * sin + right * cos, down])
        velocity = (wanted - y[3:6]) / response.velocity_time_s
        return np.array([*y[3:6], *velocity, y[7], (turn - y[7]) / response.yaw_rate_time_s])

    found = solve_ivp(slope, (0.0, seconds), start, rtol=1e-9, atol=1e-10)
    return np.asarray(found.y[:, -1])


def flat(motion: MotionBatch) -> np.ndarray:
    """Return motions as rows (n, 8)."""
    return np.column_stack(motion)


def motion_of(rows: np.ndarray) -> MotionBatch:
    return MotionBatch(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7])


COMMANDS = np.array(
    [
        [4.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],
        [3.0, 1.5, -0.4, 1.2],
        [-2.0, -1.0, 0.3, -1.88],
        [1.0, 3.0, 0.0, 1e-9],
    ]
)


def starts(rng: np.random.Generator) -> np.ndarray:
    rows = rng.normal(0.0, 2.0, (len(COMMANDS), 8))
    rows[:, 7] = COMMANDS[:, 3]
    return rows


def test_motion_is_that_of_the_equations() -> None:
    """Exact once the turn is established, after any previous motion."""
    rng = np.random.default_rng(1)
    rows, seconds = starts(rng), rng.uniform(0.0, 1.5, len(COMMANDS))
    flown = flat(flown_on(motion_of(rows), COMMANDS, RESPONSE, seconds))
    for row, command, duration, found in zip(rows, COMMANDS, seconds, flown, strict=True):
        assert found == pytest.approx(integrated(row, command, duration, RESPONSE), abs=1e-6)


def test_while_a_turn_builds_up_only_the_velocity_is_approximate() -> None:
    rng = np.random.default_rng(2)
    rows, seconds = starts(rng), np.full(len(COMMANDS), 0.4)
    rows[:, 7] = 0.0
    flown = flat(flown_on(motion_of(rows), COMMANDS, RESPONSE, seconds))
    for row, command, found in zip(rows, COMMANDS, flown, strict=True):
        expected = integrated(row, command, 0.4, RESPONSE)
        assert found[6:] == pytest.approx(expected[6:], abs=1e-6)
        assert found[:3] == pytest.approx(expected[:3], abs=0.03)
        assert found[3:6] == pytest.approx(expected[3:6], abs=0.15)


def test_pieces_of_a_setpoint_are_the_whole() -> None:
    rng = np.random.default_rng(3)
    rows = rng.normal(0.0, 2.0, (len(COMMANDS), 8))
    whole = flown_on(motion_of(rows), COMMANDS, RESPONSE, np.full(len(rows), 0.9))
    pieces = motion_of(rows)
    for share in (0.0, 0.2, 0.3, 0.4):
        pieces = flown_on(pieces, COMMANDS, RESPONSE, np.full(len(rows), share))
    assert flat(pieces) == pytest.approx(flat(whole), abs=1e-12)


def test_it_leans_so_that_thrust_carries_weight_acceleration_and_drag() -> None:
    rng = np.random.default_rng(4)
    motion = motion_of(rng.normal(0.0, 2.0, (len(COMMANDS), 8)))
    roll, pitch = leaning(motion, COMMANDS, RESPONSE)
    for i, command in enumerate(COMMANDS):
        heading, velocity = motion.heading[i], motion.velocity[i, :2]
        turn = np.array(
            [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
        )
        accelerates = (turn @ command[:2] - velocity) / RESPONSE.velocity_time_s
        thrust = np.array([*(accelerates + RESPONSE.drag_1_s * velocity), -9.80665])
        body = quat_to_matrix(quat_from_euler(float(roll[i]), float(pitch[i]), float(heading)))
        assert -body[:, 2] == pytest.approx(thrust / np.linalg.norm(thrust), abs=1e-9)


# --- images


def arena_of(name: str, seed: int) -> Arena:
    spec = load_profile("arenas", name, ArenaSpec)
    return generate(spec, seed, name=name, vehicle_width_m=QUAD.body.width_m)


def sight(
    arena: Arena,
    north: float,
    east: float,
    heading: float,
    pitch: float = 0.0,
    lens: Intrinsics = LENS,
) -> PosedImage:
    """Return the view of a level or slightly lowered camera 2.5 m above the ground."""
    position = np.array([north, east, -2.5])
    quaternion = quat_from_euler(0.0, pitch, heading)
    centers = arena.centers_at(0)
    depth = render(arena, centers, lens, RANGE_M, position, quaternion)
    return PosedImage(depth_to_z16(depth), CameraPose(position, quat_to_matrix(quaternion)))


REPROJECTOR = Reprojector(QUAD.camera, LENS)

PANORAMA = load_vehicle("quad-panorama").camera
ROUND = Intrinsics.of(PANORAMA)


def test_from_where_it_was_taken_an_image_is_as_it_is() -> None:
    seen = sight(arena_of("static-obstacles", 5), 1.0, -2.0, 0.6, -0.1)
    assert (seen.depth_mm == 0).any()
    assert np.array_equal(REPROJECTOR.image([seen], seen.pose), seen.depth_mm)


def shown_by(seen: PosedImage, pose: CameraPose) -> np.ndarray:
    """Return the pixels of a view that depend on the depths of an image.

    Compares two walls in the image's frame, near and far.
    """
    views = []
    for depth_mm in (1000, 9000):
        wall = PosedImage(np.full_like(seen.depth_mm, depth_mm), seen.pose)
        views.append(REPROJECTOR.image([wall], pose))
    return views[0] != views[1]


def away(distance_m: float, heading: float) -> tuple[float, float]:
    return distance_m * math.cos(heading), distance_m * math.sin(heading)


def nearest_in_blocks(depth_mm: np.ndarray) -> np.ndarray:
    """Return the nearest depth in each block of 4 x 4 pixels."""
    far = np.where(depth_mm == 0, 1e6, depth_mm)
    return np.asarray(far.reshape(LENS.height // 4, 4, LENS.width // 4, 4).min(axis=(1, 3)))


def test_carried_forward_it_is_what_the_camera_sees_there() -> None:
    """One decision later: 1.2 m ahead, turned by 20 degrees, the nose lowered.

    Covers depths within half the camera's range, where half a pixel is not much. The previous
    image shows the area that enters the view at the side. Approached surfaces have holes, but
    depths are not too small.
    """
    agree, without, blocks, nearer = [], [], [], []
    for seed in range(8):
        arena = arena_of("static-obstacles", seed)
        heading = 2.0 * math.pi * seed / 8
        before = sight(arena, 0.0, 0.0, heading)
        earlier = sight(arena, *away(-0.6, heading), heading + 0.5)
        there = sight(arena, *away(1.2, heading), heading + 0.35, -0.1)
        true = there.depth_mm.astype(float)
        found = REPROJECTOR.image([before, earlier], there.pose).astype(float)
        close = (true > 0) & (true < 500.0 * RANGE_M)
        agree.append((np.abs(found - true) <= 0.1 * true)[close])
        without.append((np.abs(before.depth_mm - true) <= 0.1 * true)[close])
        pooled, told = nearest_in_blocks(true), nearest_in_blocks(found)
        blocks.append((np.abs(told - pooled) <= 0.1 * pooled)[pooled < 500.0 * RANGE_M])
        nearer.append((found > 0) & ((found < 0.8 * true) | (true == 0)))
    assert np.concatenate(agree).mean() > 0.75
    assert np.concatenate(without).mean() < 0.1
    assert np.concatenate(blocks).mean() > 0.9
    assert np.mean(nearer) < 0.005


def test_unseen_ground_is_level_at_the_height_of_the_take_off() -> None:
    there = sight(arena_of("no-obstacles", 1), 0.0, 0.0, 0.3, -0.2)
    ground = REPROJECTOR.image([], there.pose)
    down = there.pose.axes[2] @ np.stack(
        [
            np.ones((LENS.height, LENS.width)),
            *np.meshgrid(
                (np.arange(LENS.width) - LENS.cx) / LENS.focal,
                (np.arange(LENS.height) - LENS.cy) / LENS.focal,
            ),
        ]
    ).reshape(3, -1)
    floor = (ground > 0).ravel()
    assert np.array_equal(floor, (down > 0) & (2.5 / np.maximum(down, 1e-9) <= RANGE_M))
    # The renderer sees the same ground.
    assert np.abs(ground - there.depth_mm.astype(float)).ravel()[floor].max() <= 1.0


def test_the_newest_image_decides_and_older_ones_fill_what_it_did_not_see() -> None:
    arena = arena_of("static-obstacles", 3)
    newest, older = (sight(arena, 0.0, 0.0, heading) for heading in (0.0, 1.0))
    pose = sight(arena, 0.0, 0.0, 0.5).pose
    alone, both, other = (
        REPROJECTOR.image(sights, pose) for sights in ([newest], [newest, older], [older])
    )
    seen = shown_by(newest, pose)
    assert np.array_equal(both[seen], alone[seen])
    assert np.array_equal(both[~seen], other[~seen])
    assert 0.2 < seen.mean() < 0.8
    # Nearer depths of an older image do not occlude the newest.
    stale = PosedImage(np.full_like(newest.depth_mm, 500), newest.pose)
    assert np.array_equal(REPROJECTOR.image([newest, stale], newest.pose), newest.depth_mm)


def test_all_round_an_image_is_as_it_is_from_where_it_was_taken() -> None:
    seen = sight(arena_of("static-obstacles", 5), 1.0, -2.0, 0.6, -0.1, ROUND)
    assert (seen.depth_mm == 0).any()
    assert np.array_equal(Reprojector(PANORAMA, ROUND).image([seen], seen.pose), seen.depth_mm)


@pytest.mark.parametrize("columns", [1, 40, 64, 127])
def test_all_round_a_turn_shifts_the_image(columns: int) -> None:
    """Columns that leave at one end enter at the other."""
    arena = arena_of("static-obstacles", 5)
    here = sight(arena, 1.0, -2.0, 0.6, lens=ROUND)
    turned = sight(arena, 1.0, -2.0, 0.6 + columns / ROUND.focal, lens=ROUND)
    found = Reprojector(PANORAMA, ROUND).image([here], turned.pose)
    np.testing.assert_array_equal(found, np.roll(here.depth_mm, -columns, axis=1))


def test_all_round_an_image_is_carried_forward_on_every_side() -> None:
    """1.2 m ahead and turned: as much of each quarter of the image is right, the rear's, too."""
    quarters: list[list[np.ndarray]] = [[], [], [], []]
    for seed in range(8):
        arena = arena_of("static-obstacles", seed)
        heading = 2.0 * math.pi * seed / 8
        before = sight(arena, 0.0, 0.0, heading, lens=ROUND)
        there = sight(arena, *away(1.2, heading), heading + 0.35, -0.1, ROUND)
        true = there.depth_mm.astype(float)
        found = Reprojector(PANORAMA, ROUND).image([before], there.pose).astype(float)
        right = np.abs(found - true) <= 0.1 * true
        close = (true > 0) & (true < 500.0 * RANGE_M)
        for quarter in range(4):
            part = np.s_[:, 32 * quarter : 32 * quarter + 32]
            quarters[quarter].append(right[part][close[part]])
    for each in quarters:
        assert np.concatenate(each).mean() > 0.7


# --- latency


def test_the_mean_of_the_newest_latencies_is_expected() -> None:
    rng = np.random.default_rng(5)
    latency = ExpectedLatency(3)
    assert latency.expected_us().tolist() == [0, 0, 0]
    measured = rng.integers(1000, 900_000, (RECENT + 9, 2))
    for k, each in enumerate(measured, start=1):
        latency.measure(np.array([0, 2]), each)
        mean = measured[max(0, k - RECENT) : k].mean(axis=0)
        assert latency.expected_us()[[0, 2]] == pytest.approx(mean, abs=1.0)
        assert latency.expected_us()[1] == 0
    latency.begin(0)
    assert latency.expected_us()[0] == 0


# --- both together


def states(rows: np.ndarray) -> Kinematics:
    """Return level vehicles' telemetry of motions (n, 8)."""
    level = np.array([quat_from_euler(0.0, 0.0, float(heading)) for heading in rows[:, 6]])
    return Kinematics(rows[:, :3].copy(), rows[:, 3:6].copy(), level)


def times(*us: int) -> np.ndarray:
    return np.array(us, np.int64)


def test_where_nothing_is_late_a_hover_is_as_it_is() -> None:
    compensator = Compensator(1, QUAD, LENS)
    compensator.begin(0)
    rows = np.array([[1.0, -2.0, -2.5, 0.0, 0.0, 0.0, 0.7, 0.0]])
    seen = sight(arena_of("static-obstacles", 2), 0.0, 0.0, 0.0).depth_mm[None]
    now = states(rows)
    image, then = compensator.foresee(np.array([0]), seen, times(0), times(0), now)
    assert np.array_equal(image, seen)
    assert np.array_equal(then.position, now.position)
    assert np.array_equal(then.velocity, now.velocity)
    assert then.quaternion == pytest.approx(now.quaternion, abs=1e-12)


def test_the_yaw_rate_answers_sooner_than_the_velocity() -> None:
    vehicle = QUAD.model_copy(update={"response": RESPONSE})
    compensator = Compensator(1, vehicle, LENS)
    compensator.begin(0)
    one, command = np.array([0]), np.array([3.0, 0.0, 0.0, 0.9])
    compensator.decided(one, command[None], times(300_000), times(0))
    row = np.array([0.0, 0.0, -2.5, 0.0, 0.0, 0.0, 0.2, 0.0])
    blank = np.zeros((1, LENS.height, LENS.width), np.uint16)
    _, then = compensator.foresee(one, blank, times(0), times(0), states(row[None]))
    turns_s, flies_s = RESPONSE.yaw_rate_dead_time_s, RESPONSE.dead_time_s
    turned = integrated(row, np.array([0, 0, 0, 0.9]), flies_s - turns_s, RESPONSE)
    expected = integrated(turned, command, 0.3 - flies_s, RESPONSE)
    _, _, heading = quats_to_euler(then.quaternion)
    assert heading[0] == pytest.approx(expected[6], abs=1e-6)
    assert then.velocity[0] == pytest.approx(expected[3:6], abs=0.02)
    # With one dead time for both the heading would be behind.
    assert heading[0] - 0.2 > 1.5 * (integrated(row, command, 0.3 - flies_s, RESPONSE)[6] - 0.2)


@pytest.mark.parametrize("stopped_us", [10**9, 500_000])
def test_setpoints_in_flight_are_flown_one_after_the_other(stopped_us: int) -> None:
    """Sent every 60 ms, answered 200 ms later; the last expires, or does not."""
    vehicle = QUAD.model_copy(update={"response": RESPONSE})
    compensator = Compensator(1, vehicle, LENS)
    compensator.begin(0)
    one, dead_us = np.array([0]), round(RESPONSE.dead_time_s * US_PER_S) + LINK_US
    sent = np.column_stack([np.linspace(1.0, 4.0, 6), *np.zeros((2, 6)), np.zeros(6)])
    sent[3:, 1] = 1.0
    moments = [60_000 * k for k in range(1, 7)]
    for command, sent_us in zip(sent, moments, strict=True):
        compensator.decided(one, command[None], times(400_000), times(sent_us), times(stopped_us))
    now_us, row = 370_000, np.array([0.5, 1.0, -2.5, 1.2, 0.1, 0.0, 0.4, 0.0])
    blank = np.zeros((1, LENS.height, LENS.width), np.uint16)
    _, then = compensator.foresee(one, blank, times(0), times(now_us), states(row[None]))
    acts_us = now_us + 400_000 + LINK_US
    edges = [*(moment + dead_us for moment in moments), stopped_us + dead_us, 10**9]
    flown = [np.zeros(4), *sent, np.zeros(4)]
    begins_us, expected = now_us, row
    for command, ends_us in zip(flown, edges, strict=True):
        ends_us = min(max(ends_us, begins_us), acts_us)
        if ends_us > begins_us:
            seconds = (ends_us - begins_us) / US_PER_S
            expected = integrated(expected, command, seconds, RESPONSE)
        begins_us = ends_us
    assert then.position[0] == pytest.approx(expected[:3], abs=1e-5)
    assert then.velocity[0] == pytest.approx(expected[3:6], abs=1e-5)


def test_each_of_many_is_as_if_alone() -> None:
    rng = np.random.default_rng(6)
    n, everyone = 3, np.arange(3)
    many = Compensator(n, QUAD, LENS)
    alone = [Compensator(1, QUAD, LENS) for _ in range(n)]
    for i in range(n):
        many.begin(i)
        alone[i].begin(0)
    now_us = times(0, 4000, 8000)
    for _ in range(5):
        images = rng.integers(0, 20_000, (n, LENS.height, LENS.width), np.uint16)
        age_us, state = rng.integers(0, 40_000, n), states(rng.normal(0.0, 2.0, (n, 8)))
        image, then = many.foresee(everyone, images, age_us, now_us, state)
        command, t2_us = rng.normal(0.0, 2.0, (n, 4)), rng.integers(50_000, 400_000, n)
        many.decided(everyone, command, t2_us, now_us + t2_us)
        for i, each in enumerate(alone):
            own = slice(i, i + 1)
            row = Kinematics(state.position[own], state.velocity[own], state.quaternion[own])
            found, motion = each.foresee(np.array([0]), images[own], age_us[own], now_us[own], row)
            assert np.array_equal(found[0], image[i])
            for name in ("position", "velocity", "quaternion"):
                assert np.array_equal(getattr(motion, name)[0], getattr(then, name)[i])
            each.decided(np.array([0]), command[own], t2_us[own], (now_us + t2_us)[own])
        now_us = now_us + t2_us + 500_000


def test_a_vehicle_of_unknown_response_is_refused_in_one_line() -> None:
    unknown = QUAD.model_copy(update={"response": None})
    with pytest.raises(FieldError, match="has no table `response`; scripts/fit-response") as caught:
        Compensator(1, unknown, LENS)
    assert "\n" not in f"{caught.value}"
    assert caught.value.field == "compensate"


@pytest.mark.parametrize("aside", [{}, {"yaw_deg": -70.0, "right_m": -0.3}])
def test_the_camera_sits_where_the_renderer_has_it(aside: dict[str, float]) -> None:
    """Before the centre, above it, tilted and turned: the same pose as the renderer's."""
    camera = QUAD.camera.model_copy(update={"pitch_up_deg": 12.0, "up_m": 0.2, **aside})
    vehicle = QUAD.model_copy(update={"camera": camera})
    arena = arena_of("static-obstacles", 4)
    quaternion = quat_from_euler(0.05, -0.15, 0.9)
    position = np.array([2.0, 1.0, -2.5])
    angles = map(math.radians, (camera.pitch_up_deg, camera.yaw_deg))
    mount = Mount((camera.forward_m, camera.right_m, -camera.up_m), *angles)
    view = partial(render, arena, arena.centers_at(0), LENS, RANGE_M)
    seen = depth_to_z16(view(*camera_pose(position, quaternion, mount)))
    compensator = Compensator(1, vehicle, LENS)
    compensator.begin(0)
    # In a hover it will be level then; its first setpoint has not been sent.
    now = Kinematics(position[None], np.zeros((1, 3)), quaternion[None])
    image, then = compensator.foresee(np.array([0]), seen[None], times(0), times(0), now)
    true = depth_to_z16(view(*camera_pose(position, then.quaternion[0], mount))).astype(float)
    assert np.mean(np.abs(image[0] - true) <= 0.05 * true) > 0.9
    assert np.mean(np.abs(seen - true) <= 0.05 * true) < 0.8

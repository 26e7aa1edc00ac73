"""Failure causes on constructed flights, and visibility of the obstacle to the camera."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from airl_mav.addons.colour.profile import Appearance
from airl_mav.addons.forensics.long_flights import (
    MIN_TURNS,
    NO_CAUSE,
    SPOT_M,
    Evidence,
    longest_limit_cycle,
    swinging_stretches,
)
from airl_mav.addons.forensics.worst import (
    USUAL,
    bearing,
    cause_of,
    decisions_in_effect,
    examine_collision,
    hit_number,
    nearest_spot,
    view_obstacle,
    view_wall,
)
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, PlacedMesh, Shape, Tour
from airl_mav.camera.render import camera_pose
from airl_mav.core.frames import quat_to_matrix
from airl_mav.envs.stopping import braking_of
from airl_mav.flight.episode_record import (
    EpisodeRecord,
    UsualFlight,
    path_excess,
    straight_m,
    time_lost_s,
    usual_flight,
)
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory, measure_quality
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.report.policy_view import PolicyCamera

CAMERA = load_vehicle("quad").camera
BRAKING = braking_of(load_vehicle("quad"))
SIGHT = PolicyCamera.of(CAMERA)
USUAL_RUN = UsualFlight(pace_s_m=0.4, path_ratio=1.05, speed_m_s=2.5)


def arena_of(
    *things: tuple[Shape, float, float, float, float], tours: tuple[Tour, ...] = ()
) -> Arena:
    """Make an arena; a thing is its shape, north, east, half size or radius, yaw [deg]."""
    n = len(things)
    half_height = 3.0
    return Arena(
        name="made",
        seed=1,
        bounds=Bounds(-30.0, 30.0, -30.0, 30.0, 10.0),
        wall_colour=(100, 100, 100),
        obstacles=Obstacles(
            np.array([t[0] for t in things], np.int8).reshape(n),
            np.array([[t[1], t[2], -half_height] for t in things]).reshape(n, 3),
            np.array(
                [[t[3], t[3], t[3] if t[0] == Shape.SPHERE else half_height] for t in things]
            ).reshape(n, 3),
            np.radians([t[4] for t in things]).reshape(n),
        ),
        tours=tours,
        goal=np.array([20.0, 0.0]),
    )


def hard_brakes(speed_m_s: float) -> float:
    return speed_m_s**2 / (2.0 * 9.8)


def facing(degrees: float) -> list[float]:
    half = 0.5 * math.radians(degrees)
    return [math.cos(half), 0.0, 0.0, math.sin(half)]


def flight_of(
    points: list[tuple[float, float, float]], heading_deg: float | list[float] = 0.0
) -> Trajectory:
    """Fly along (time [s], north, east) at 3 m height, 50 Hz."""
    t, north, east = np.array(points).T
    times = np.arange(0, round(t[-1] * 1e6) + 1, 20_000)
    s = times / 1e6
    position = np.stack([np.interp(s, t, north), np.interp(s, t, east), np.full(len(s), -3.0)], 1)
    velocity = np.gradient(position, s, axis=0)
    degrees = np.interp(s, t, np.broadcast_to(heading_deg, t.shape))
    attitude = np.array([facing(angle) for angle in degrees])
    return Trajectory(times, position, velocity, attitude, np.full(len(s), 450.0))


def record_of(
    path: Trajectory, outcome: Outcome, reason: str, goal: tuple[float, float] = (20.0, 0.0)
) -> EpisodeRecord:
    end = int(path.time_us[-1])
    return EpisodeRecord(
        index=0,
        seed=1,
        arena="made",
        arena_seed=1,
        outcome=outcome,
        reason=reason,
        goal=goal,
        goal_radius_m=2.0,
        time_limit_s=60.0,
        started_us=0,
        navigation_us=0,
        ended_us=end,
        wall_s=None,
        slipped_us=0,
        battery_remaining=0.5,
        quality=measure_quality(path, 0, end, 2.0),
    )


def stamps_of(
    path: Trajectory,
    lag_s: float = 0.1,
    period_s: float = 0.5,
    yaw: list[float] | None = None,
    last_s: float | None = None,
) -> dict[str, np.ndarray]:
    """Decide every period: frame, and `lag_s` later setpoint and motors."""
    end_s = path.time_us[-1] / 1e6 if last_s is None else last_s
    frames = np.arange(0.0, end_s - lag_s, period_s)
    capture = np.round(frames * 1e6).astype(np.int64)
    motor = capture + round(lag_s * 1e6)
    setpoint = np.zeros((len(frames), 4), np.float32)
    setpoint[:, 0] = 2.0
    if yaw is not None:
        setpoint[:, 3] = np.resize(yaw, len(frames))
    sent = motor - 1_000
    return {"capture_us": capture, "sent_us": sent, "motor_us": motor, "setpoint": setpoint}


def crash(
    path: Trajectory, arena: Arena, reason: str, stamps: dict[str, np.ndarray]
) -> tuple[str, str]:
    record = record_of(path, Outcome.COLLISION, reason)
    cause = cause_of(Evidence(record, path, stamps, arena, SIGHT, hard_brakes), USUAL_RUN)
    return cause.kind, " ".join(cause.sentences)


AHEAD = flight_of([(0.0, 0.0, 0.0), (4.0, 8.0, 0.0)])
"""Straight north at 2 m/s."""


def test_an_obstacle_ahead_was_seen_and_flown_into() -> None:
    box = arena_of((Shape.BOX, 9.3, 0.0, 1.0, 0.0))
    kind, words = crash(AHEAD, box, "hit static-box-0", stamps_of(AHEAD))
    assert kind == "seen and flown into"
    # The last frame whose motors answered in time was taken at 3.5 s, at 7 m: 1.3 m off.
    assert "1.3 m off, straight ahead" in words
    assert "0.50 s old at the collision; the vehicle flew 1.0 m on it" in words
    assert "5 of the last 5 frames" in words
    assert "0.10 s and 0.2 m went by; speed at the collision 2.0 m/s" in words


def test_with_a_slow_computer_it_was_too_late() -> None:
    box = arena_of((Shape.BOX, 9.3, 0.0, 1.0, 0.0))
    fast = flight_of([(0.0, -8.0, 0.0), (4.0, 8.0, 0.0)])
    slow = stamps_of(fast, lag_s=0.6, period_s=1.0)
    kind, words = crash(fast, box, "hit static-box-0", slow)
    # Frame at 3 s, at 4 m: 4.3 m off; 2.4 m until the motors answer, then 0.8 m of v² / 2a.
    assert "4.3 m off" in words
    assert kind == "seen and flown into"
    late = stamps_of(fast, lag_s=0.99, period_s=1.0)
    kind, words = crash(fast, box, "hit static-box-0", late)
    assert "0.99 s and 4.0 m went by" in words
    assert kind == "seen too late to act"
    record = record_of(fast, Outcome.COLLISION, "hit static-box-0")
    # 1.6 m are left after 2.4 m: from 4 m/s the quad takes 2.7 m, another one 1.5 m.
    weak = cause_of(Evidence(record, fast, slow, box, SIGHT, BRAKING.distance_from_m), USUAL_RUN)
    assert weak.kind == "seen too late to stop"
    strong = cause_of(Evidence(record, fast, slow, box, SIGHT, lambda _: 1.5), USUAL_RUN)
    assert strong.kind == "seen and flown into"


def test_what_the_camera_does_not_show_is_said_so() -> None:
    sideways = flight_of([(0.0, 0.0, 0.0), (4.0, 8.0, 0.0)], heading_deg=90.0)
    box = arena_of((Shape.BOX, 9.3, 0.0, 1.0, 0.0))
    kind, words = crash(sideways, box, "hit static-box-0", stamps_of(sideways))
    assert kind == "hit out of the picture"
    assert "90° to the left; the camera sees 45° to either side" in words
    assert "flying 90° to the left of its heading, where the camera does not look" in words
    assert "0 of the last 5 frames" in words


def test_what_stands_behind_something_nearer_is_hidden() -> None:
    # A frame at the start only, when the first box covers the second; then a way round the first.
    path = flight_of([(0.0, 0.0, 0.0), (2.0, 3.0, 4.0), (4.0, 8.2, 0.0)])
    both = arena_of((Shape.BOX, 4.0, 0.0, 1.5, 0.0), (Shape.BOX, 9.3, 0.0, 0.8, 0.0))
    kind, _ = crash(path, both, "hit static-box-1", stamps_of(path, last_s=0.3))
    assert kind == "hidden behind something nearer"
    alone = arena_of((Shape.BOX, 4.0, 20.0, 1.5, 0.0), (Shape.BOX, 9.3, 0.0, 0.8, 0.0))
    assert crash(path, alone, "hit static-box-1", stamps_of(path, last_s=0.3))[0] == (
        "seen and flown into"
    )


def of_glass(arena: Arena) -> Arena:
    """The same arena, of whose obstacles the last one alone is of glass."""
    look = Appearance.model_validate({"static": {"materials": ["glass"]}})
    made = replace(arena, appearance=look)
    made.__dict__["clear"] = np.arange(len(arena.obstacles)) == len(arena.obstacles) - 1
    return made


def test_glass_is_the_cause_where_depth_passes_through_it() -> None:
    box = of_glass(arena_of((Shape.BOX, 9.3, 0.0, 1.0, 0.0)))
    kind, words = crash(AHEAD, box, "hit static-box-0", stamps_of(AHEAD))
    assert kind == "glass, which depth passes through"
    assert words.startswith("static-box-0 is of glass; the camera measured through it. It lay 1.3")
    # A colour camera sees it.
    colours = replace(SIGHT, intrinsics=replace(SIGHT.intrinsics, kind="rgb"))
    record = record_of(AHEAD, Outcome.COLLISION, "hit static-box-0")
    seen = cause_of(Evidence(record, AHEAD, stamps_of(AHEAD), box, colours, hard_brakes), USUAL_RUN)
    assert seen.kind == "seen and flown into"


def test_nothing_is_hidden_behind_glass() -> None:
    path = flight_of([(0.0, 0.0, 0.0), (2.0, 3.0, 4.0), (4.0, 8.2, 0.0)])
    behind = (Shape.BOX, 9.3, 0.0, 0.8, 0.0), (Shape.BOX, 4.0, 0.0, 1.5, 0.0)
    stamps = stamps_of(path, last_s=0.3)
    assert crash(path, arena_of(*behind), "hit static-box-0", stamps)[0] == (
        "hidden behind something nearer"
    )
    glass = of_glass(arena_of(*behind))
    assert crash(path, glass, "hit static-box-0", stamps)[0] == "seen and flown into"


def test_walls_have_a_place_too() -> None:
    path = flight_of([(0.0, 0.0, 0.0), (4.0, 0.0, 29.7)], heading_deg=0.0)
    stamps = stamps_of(path)
    kind, words = crash(path, arena_of(), "hit wall", stamps)
    assert kind == "hit out of the picture"
    assert "90° to the right" in words
    view = view_wall(path, int(stamps["capture_us"][-1]), int(path.time_us[-1]), arena_of())
    assert view.distance_m == pytest.approx(30.0 - 29.7 * stamps["capture_us"][-1] / 4e6)


def test_a_collision_without_decisions_or_recording_claims_nothing() -> None:
    box = arena_of((Shape.BOX, 9.3, 0.0, 1.0, 0.0))
    kind, _ = crash(AHEAD, box, "hit static-box-0", {})
    assert kind == "hit before the first decision"
    record = record_of(AHEAD, Outcome.COLLISION, "hit static-box-0")
    nothing = AHEAD.between(9_000_000_000, 9_000_000_001)
    assert cause_of(Evidence(record, nothing, {}), USUAL_RUN).kind == NO_CAUSE
    # Without arena or camera the times stand, and no cause is made up.
    bare = cause_of(Evidence(record, AHEAD, stamps_of(AHEAD)), USUAL_RUN)
    assert bare.kind == NO_CAUSE
    assert "flew 1.0 m on it" in " ".join(bare.sentences)
    early = replace(record, reason="hit floor during the take-off")
    assert cause_of(Evidence(early, AHEAD, {}), USUAL_RUN).kind == "hit during the take-off"


def test_the_share_of_a_sphere_is_its_projected_area() -> None:
    """The image of a sphere on the axis is a disc with the tangent cone's radius."""
    radius, away = 1.0, 6.0
    mount = (CAMERA.forward_m, -3.0 - CAMERA.up_m)
    arena = arena_of((Shape.SPHERE, away + mount[0], 0.0, radius, 0.0))
    arena.obstacles.center[0, 2] = mount[1]
    still = flight_of([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    view = view_obstacle(still, 0, 1_000_000, arena, 0, 0, SIGHT)
    k = SIGHT.intrinsics
    disc = math.pi * (k.focal * math.tan(math.asin(radius / away))) ** 2
    assert view.share == pytest.approx(disc / (k.width * k.height), rel=0.08)
    assert view.bearing_rad == pytest.approx(0.0, abs=1e-9)
    assert math.degrees(SIGHT.half_angle_rad) == pytest.approx(0.5 * CAMERA.horizontal_fov_deg)


def test_the_share_of_a_mesh_is_that_of_its_triangles(tmp_path: Path) -> None:
    """A fine ball's is a sphere's, whichever of its boxes was hit, also where another is nearer."""
    trimesh = pytest.importorskip("trimesh")
    from tests.support.meshes import kept, triangles

    radius, away = 1.0, 6.0
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    file = kept(triangles(ball), tmp_path / "ball.npz")
    shapes = [(Shape.BOX, away + CAMERA.forward_m, 0.0, 1.4, 0.0)] * 2
    arena = arena_of((Shape.BOX, 3.0, 20.0, 1.0, 0.0), *shapes)
    mesh = PlacedMesh(file, (away + CAMERA.forward_m, 0.0), 0.3, 1.0, 1, 2)
    arena = replace(arena, meshes=(mesh,))
    still = flight_of([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    # The whole arena, and the mesh alone, each from the same eye.
    shares = [view_obstacle(still, 0, 1_000_000, arena, 0, i, SIGHT).share for i in (1, 2)]
    eye, attitude = camera_pose(np.array([0.0, 0.0, -3.0]), np.array([1.0, 0, 0, 0]), SIGHT.mount)
    k = SIGHT.intrinsics
    v, u = np.mgrid[: k.height, : k.width]
    rays = np.stack([np.ones(u.shape), (u - k.cx) / k.focal, (v - k.cy) / k.focal], -1)
    rays = rays @ quat_to_matrix(np.array(attitude)).T
    to_middle = np.array([away + CAMERA.forward_m, 0.0, -radius]) - np.array(eye)
    along = rays @ to_middle / np.linalg.norm(rays, axis=-1)
    disc = to_middle @ to_middle - along**2 <= radius**2
    assert shares[0] == shares[1] == pytest.approx(float(disc.mean()), rel=0.05)


def test_a_moving_obstacle_is_looked_for_where_it_was() -> None:
    tour = Tour(np.array([0.0, 4.0, 8.0]), np.array([[9.0, 8.0], [9.0, 0.0], [9.0, 8.0]]))
    arena = arena_of((Shape.CYLINDER, 9.0, 8.0, 0.8, 0.0), tours=(tour,))
    # At 2 s it stood 4 m to the east; it came 4 m nearer until the collision at 4 s.
    view = view_obstacle(AHEAD, 2_000_000, 4_000_000, arena, 0, 0, SIGHT)
    spot = np.array([9.0 - 0.8, 4.0])
    assert view.distance_m == pytest.approx(np.hypot(*(spot - [4.0, 0.0])), abs=1e-6)
    assert view.bearing_rad == pytest.approx(math.atan2(4.0, 4.2))


@pytest.mark.parametrize("yaw", [0.0, 30.0, 75.0])
def test_the_nearest_spot_of_a_box_is_the_nearest_of_its_outline(yaw: float) -> None:
    o = arena_of((Shape.BOX, 2.0, -1.0, 1.5, yaw)).obstacles
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    u = np.linspace(-1.5, 1.5, 1501)
    edges = np.concatenate(
        [np.stack([np.full_like(u, k), u], 1) for k in (-1.5, 1.5)]
        + [np.stack([u, np.full_like(u, k)], 1) for k in (-1.5, 1.5)]
    )
    outline = edges @ np.array([[c, s], [-s, c]]) + [2.0, -1.0]
    for place in ([6.0, 3.0], [-4.0, 0.5], [2.0, -5.0]):
        spot = nearest_spot(o, 0, o.center[0], np.array([*place, -3.0]))
        best = np.linalg.norm(outline - place, axis=1).min()
        assert np.linalg.norm(spot - place) == pytest.approx(best, abs=2e-3)


def test_bearings_are_from_the_heading_to_the_right() -> None:
    east = np.array(facing(90.0))
    assert math.degrees(bearing(east, np.array([0.0, 1.0]))) == pytest.approx(0.0, abs=1e-9)
    assert math.degrees(bearing(east, np.array([-1.0, 0.0]))) == pytest.approx(90.0)
    assert math.degrees(bearing(np.array(facing(170.0)), np.array([-1.0, -0.2]))) == pytest.approx(
        21.31, abs=0.01
    )


def test_reading_a_verdict() -> None:
    arena = arena_of((Shape.BOX, 9.0, 0.0, 1.0, 0.0), (Shape.BOX, 0.0, 9.0, 1.0, 0.0))
    assert hit_number("hit static-box-1", arena) == 1
    assert hit_number("hit obstacle 0", arena) == 0
    assert hit_number("hit moving-cylinder-7", arena) is None
    for reason in ("hit wall", "hit wall-north", "hit floor", "battery empty"):
        assert hit_number(reason, arena) is None
    assert hit_number("hit static-box-1", None) is None


def test_decisions_act_when_the_motors_answer() -> None:
    stamps = {
        "capture_us": np.array([0, 10, 20, 30]),
        "sent_us": np.array([5, 15, 25, 35]),
        "motor_us": np.array([7, 17, -1, 40]),
    }
    assert decisions_in_effect(stamps, 36).tolist() == [0, 1]
    assert decisions_in_effect(
        {k: v for k, v in stamps.items() if k != "motor_us"}, 36
    ).tolist() == [0, 1, 2, 3]
    assert decisions_in_effect({}, 36).size == 0


# --- flights without arrival, and long flights


def test_swinging_is_found_counted_and_timed() -> None:
    left_right = [1.26, 1.26, -1.26, -1.26]
    spin = flight_of([(0.0, 0.0, 0.0), (4.0, 12.0, 0.0), (60.0, 12.5, 0.0)])
    stamps = stamps_of(spin, yaw=left_right)
    swing = longest_limit_cycle(stamps, spin, int(spin.time_us[-1]))
    assert swing is not None
    assert swing.on_the_spot
    # Every second decision turns; it stays within SPOT_M of the end from 3.5 s on.
    assert swing.turns == pytest.approx((60.0 - 3.5) / 1.0, abs=1)
    assert swing.time_s == pytest.approx(60.0 - 3.5, abs=1.5)
    record = record_of(spin, Outcome.TIMEOUT, "7.50 m from the goal after 60 s")
    cause = cause_of(Evidence(record, spin, stamps), USUAL_RUN)
    assert cause.kind == "swung left and right on the spot"
    words = " ".join(cause.sentences)
    assert "7.5 m (radius 2 m, 20.0 m at the start); 7.5 m at the end" in words
    assert f"the vehicle stayed within {SPOT_M:g} m" in words


def test_an_evasion_is_no_swinging() -> None:
    few = np.array([0.0, 1.0, 1.0, -1.0, 0.0, 1.0, -1.0, 0.0, 0.0])
    assert swinging_stretches(few) == []
    apart = np.zeros(80)
    apart[::8] = np.resize([1.0, -1.0], 10)
    assert swinging_stretches(apart) == []
    many = np.resize([0.0, 1.0, -1.0], 3 * MIN_TURNS)
    (run,) = swinging_stretches(many)
    # From + to - and, over the zero, back again.
    assert len(run) == 2 * MIN_TURNS - 1
    assert run[0] == 2


def test_circling() -> None:
    round_and_round = flight_of(
        [(0.0, 0.0, 0.0), (30.0, 6.0, 0.0)], heading_deg=[0.0, -4.0 * 360.0]
    )
    record = record_of(round_and_round, Outcome.TIMEOUT, "14.00 m from the goal after 30 s")
    cause = cause_of(Evidence(record, round_and_round, {}), USUAL_RUN)
    assert cause.kind == "circled"
    assert "4.0 times round to the left" in " ".join(cause.sentences)


def test_passing_the_goal_is_told_with_the_distance() -> None:
    past = flight_of([(0.0, 0.0, 0.0), (8.0, 20.0, 2.5), (12.0, 30.0, 2.5), (17.0, 21.0, 1.0)])
    record = record_of(past, Outcome.SUCCESS, "1.41 m from the goal")
    cause = cause_of(Evidence(record, past, {}), USUAL_RUN)
    assert "passed the goal at 2.5 m and left again" in " ".join(cause.sentences)
    assert cause.kind == "passed the goal"


def test_a_detour_is_one_with_or_without_need() -> None:
    way = flight_of([(0.0, 0.0, 0.0), (5.0, 10.0, 9.0), (10.0, 18.1, 0.0)])
    record = record_of(way, Outcome.SUCCESS, "1.90 m from the goal")
    barred = arena_of((Shape.BOX, 10.0, 0.0, 2.0, 0.0))
    free = arena_of((Shape.BOX, 10.0, 20.0, 2.0, 0.0))
    kinds = [cause_of(Evidence(record, way, {}, a), USUAL_RUN).kind for a in (barred, free)]
    assert kinds == ["a detour round obstacles", "a detour without need"]


def test_a_usual_flight_has_no_cause_and_a_strange_one_none_made_up() -> None:
    good = flight_of([(0.0, 0.0, 0.0), (7.2, 18.1, 0.0)])
    record = record_of(good, Outcome.SUCCESS, "1.90 m from the goal")
    assert cause_of(Evidence(record, good, stamps_of(good)), USUAL_RUN).kind == USUAL
    away = flight_of([(0.0, 0.0, 0.0), (10.0, -25.0, 0.0)])
    lost = record_of(away, Outcome.TIMEOUT, "45.00 m from the goal after 10 s")
    assert cause_of(Evidence(lost, away, stamps_of(away)), USUAL_RUN).kind == NO_CAUSE
    aborted = replace(lost, outcome=Outcome.ABORTED, reason="Ctrl-C")
    assert cause_of(Evidence(aborted, away, {}), USUAL_RUN).sentences == ("Ctrl-C.",)


def test_what_is_usual_and_what_was_lost() -> None:
    fast = flight_of([(0.0, 0.0, 0.0), (6.0, 18.0, 0.0)])
    slow = flight_of([(0.0, 0.0, 0.0), (9.0, 18.0, 0.0)])
    records = tuple(record_of(p, Outcome.SUCCESS, "") for p in (fast, fast, slow))
    assert straight_m(records[0]) == 18.0
    usual = usual_flight(records)
    assert usual.pace_s_m == pytest.approx(6.0 / 18.0)
    assert time_lost_s(records[2], usual) == pytest.approx(3.0)
    assert path_excess(records[2]) == pytest.approx(0.0, abs=1e-9)
    failed = record_of(slow, Outcome.TIMEOUT, "")
    assert usual_flight((failed,)) == UsualFlight(None, None, None)
    assert time_lost_s(failed, usual_flight((failed,))) is None


def test_a_collision_taken_apart_and_one_that_was_none() -> None:
    box = arena_of((Shape.BOX, 9.3, 0.0, 1.0, 0.0))
    record = record_of(AHEAD, Outcome.COLLISION, "hit static-box-0")
    found = examine_collision(Evidence(record, AHEAD, stamps_of(AHEAD), box, SIGHT))
    assert found is not None
    assert found.what == "static-box-0"
    assert found.answer_m_s == pytest.approx(2.0)
    good = replace(record, outcome=Outcome.SUCCESS)
    assert examine_collision(Evidence(good, AHEAD, stamps_of(AHEAD), box, SIGHT)) is None

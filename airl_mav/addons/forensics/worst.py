"""Worst flights of a run and their causes."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.forensics import long_flights
from airl_mav.arena.geometry import Arena, Ground, Obstacles, PlacedMesh, Shape
from airl_mav.camera.render import camera_pose, render
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import quat_yaw
from airl_mav.envs.stopping import braking_of
from airl_mav.flight import episode_record
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory, measure_leg, pose_at
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.profiles.arena import DEFAULT_APPEARANCE
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun, flown_path
from airl_mav.report import document
from airl_mav.report.policy_view import PolicyCamera
from airl_mav.report.run_report import EXAMINED, Cause, ExaminedFlight, ReportInput

LOOK_BACK = 5
"""Number of decisions before a collision with examined frames."""

SEEN_SHARE = 0.002
"""Minimum share of the image for a visible obstacle: 6 pixels of 64 x 48."""

_THING = re.compile(r"hit (?:(?:static|moving)-)?([a-z]+(?:-[a-z]+)*(?:[- ](\d+))?)")


@dataclass(frozen=True)
class CollisionAnalysis:
    """Analysis of a collision."""

    what: str
    """Obstacle as named by the plant: `static-box-3`, `wall`, `floor`."""
    speed_m_s: float
    """Speed at the collision."""
    off_heading_rad: float
    """Direction of flight at the collision relative to the heading, positive to the right."""
    before_s: float | None
    """Time from the exposure of the last effective frame to the collision [s]; None if no decision
    took effect."""
    blind_m: float | None
    """Distance flown since that exposure."""
    lag_s: float | None
    """Time from that exposure to the motors' response."""
    lag_m: float | None
    """Distance flown before the motors' response."""
    answer_m_s: float | None
    """Speed at the motors' response."""
    view: ObstacleView | None
    """Point of impact as seen in that frame; None without the arena or the camera."""
    glass: bool
    """True if the obstacle is glass and the camera measures through it."""
    seen: tuple[bool, ...]
    """Visibility of the obstacle in each of the last frames with a decision, oldest first."""


def decisions_in_effect(stamps: Mapping[str, NDArray[Any]], ended_us: int) -> NDArray[np.int64]:
    """Return the decisions that moved the motors before a time, or the sent ones if unknown."""
    if "sent_us" not in stamps or "capture_us" not in stamps:
        return np.zeros(0, np.int64)
    acts = stamps["sent_us"]
    motor = stamps.get("motor_us")
    if motor is not None and np.any(motor != NO_STAMP):
        acts = motor
    flown = (acts != NO_STAMP) & (acts <= ended_us) & (stamps["capture_us"] != NO_STAMP)
    return np.flatnonzero(flown).astype(np.int64)


def hit_number(reason: str, arena: Arena | None) -> int | None:
    """Return the obstacle number in a verdict; None for walls, floor and unknown obstacles."""
    found = _THING.match(reason)
    if found is None or found[2] is None or arena is None:
        return None
    number = int(found[2])
    return number if number < len(arena.obstacles) else None


def examine_collision(flight: long_flights.Evidence) -> CollisionAnalysis | None:
    """Return the analysis of a collision; None without a collision or a recording."""
    record, path, stamps, arena = flight.record, flight.path, flight.stamps, flight.arena
    if record.outcome is not Outcome.COLLISION or not len(path):
        return None
    hit_us = record.ended_us
    _, velocity, quaternion = pose_at(path, hit_us)
    number = hit_number(record.reason, arena)
    before_s = blind_m = lag_s = lag_m = answer_m_s = view = None
    seen: tuple[bool, ...] = ()
    glass = False
    decisions = decisions_in_effect(stamps, hit_us)
    if decisions.size:
        frames = stamps["capture_us"][decisions[-LOOK_BACK:]]
        frame_us = int(frames[-1])
        before_s = (hit_us - frame_us) / US_PER_S
        blind_m = measure_leg(path, frame_us, hit_us).distance_m
        motor_us = int(stamps.get("motor_us", stamps["sent_us"])[decisions[-1]])
        if motor_us != NO_STAMP:
            lag_s = (motor_us - frame_us) / US_PER_S
            lag_m = measure_leg(path, frame_us, motor_us).distance_m
            answer_m_s = float(np.linalg.norm(pose_at(path, motor_us)[1]))
        if arena is not None and flight.camera is not None:
            if number is not None:
                began_us, camera = record.started_us, flight.camera
                views = [
                    view_obstacle(path, int(frame), hit_us, arena, began_us, number, camera)
                    for frame in frames
                ]
                view = views[-1]
                glass = passes_through(arena, number, camera)
                seen = tuple((v.share or 0.0) >= SEEN_SHARE for v in views)
            elif "wall" in record.reason:
                view = view_wall(path, frame_us, hit_us, arena)
    return CollisionAnalysis(
        what=record.reason.removeprefix("hit ").removesuffix(" during the take-off"),
        speed_m_s=float(np.linalg.norm(velocity)),
        off_heading_rad=bearing(quaternion, velocity) if math.hypot(*velocity[:2]) > 0.2 else 0.0,
        before_s=before_s,
        blind_m=blind_m,
        lag_s=lag_s,
        lag_m=lag_m,
        answer_m_s=answer_m_s,
        view=view,
        glass=glass,
        seen=seen,
    )


SLOW_EXCESS = 0.25
"""Excess over the run's median, as a fraction, above which a flight is slow or long."""

ACT_S = 0.2
"""Minimum time from the motors' response to an effect on the path [s]: a multicopter has to tilt
before it brakes or swerves."""

USUAL = "as usual"


def cause_of(flight: long_flights.Evidence, usual: episode_record.UsualFlight) -> Cause:
    """Return the cause of a failure or of a longer flight than usual."""
    outcome = flight.record.outcome
    if outcome is Outcome.ABORTED:
        return Cause("aborted", (f"{flight.record.reason}.",))
    if outcome is Outcome.COLLISION:
        crash = examine_collision(flight)
        return (
            Cause(long_flights.NO_CAUSE, ())
            if crash is None
            else _cause_of_collision(flight, crash)
        )
    if not len(flight.path):
        return Cause(long_flights.NO_CAUSE, ())
    if outcome is Outcome.SUCCESS and not _slow(flight.record, usual):
        return Cause(USUAL, ())
    return long_flights.cause_of_long_flight(flight)


def _slow(record: episode_record.EpisodeRecord, usual: episode_record.UsualFlight) -> bool:
    """Return True if time or distance of a flight clearly exceeds the run's median."""
    lost, excess = episode_record.time_lost_s(record, usual), episode_record.path_excess(record)
    if lost is None or excess is None or usual.pace_s_m is None or usual.path_ratio is None:
        return False
    slow = lost > SLOW_EXCESS * usual.pace_s_m * episode_record.straight_m(record)
    return slow or excess + 1.0 > (1.0 + SLOW_EXCESS) * usual.path_ratio


def _cause_of_collision(flight: long_flights.Evidence, crash: CollisionAnalysis) -> Cause:
    if flight.record.navigation_us is None or flight.record.reason.endswith("take-off"):
        return Cause("hit during the take-off", (f"At {crash.speed_m_s:.1f} m/s.",))
    if crash.before_s is None or crash.blind_m is None:
        return Cause("hit before the first decision", ("No decision had reached the motors yet.",))
    sentences = [
        f"The last frame that still moved the motors was {crash.before_s:.2f} s old at the "
        f"collision; the vehicle flew {crash.blind_m:.1f} m on it."
    ]
    kind = long_flights.NO_CAUSE
    if (view := crash.view) is not None:
        sentences.insert(0, _where(crash, flight.camera))
        half_angle = flight.camera.half_angle_rad if flight.camera else math.pi
        aside = flight.camera.aside_rad if flight.camera else abs
        shown = crash.seen[-1] if crash.seen else aside(view.bearing_rad) <= half_angle
        if crash.glass:
            kind = "glass, which depth passes through"
        elif not shown:
            kind = "hidden behind something nearer" if view.hidden else "hit out of the picture"
        else:
            kind = _seen(crash, view, flight.braking_m)
        if len(crash.seen) > 1 and not crash.glass:
            sentences.append(
                f"It was in {sum(crash.seen)} of the last {len(crash.seen)} frames used."
            )
        if aside(crash.off_heading_rad) > half_angle:
            sentences.append(
                f"It was flying {_side(crash.off_heading_rad)} of its heading, where the camera "
                "does not look."
            )
    if crash.lag_s is not None and crash.lag_m is not None:
        sentences.append(
            f"Until the motors answered that frame, {crash.lag_s:.2f} s and {crash.lag_m:.1f} m "
            f"went by; speed at the collision {crash.speed_m_s:.1f} m/s."
        )
    return Cause(kind, tuple(sentences))


def _seen(
    crash: CollisionAnalysis,
    view: ObstacleView,
    braking_m: Callable[[float], float] | None,
) -> str:
    """Return the cause for a visible obstacle, by the time to act and the distance to stop."""
    if crash.lag_m is None or crash.lag_s is None or crash.before_s is None:
        return "seen and flown into"
    if crash.before_s - crash.lag_s < ACT_S:
        return "seen too late to act"
    room_m = max(0.0, view.distance_m - long_flights.HALF_WIDTH_M - crash.lag_m)
    if braking_m is None or crash.answer_m_s is None:
        return "seen and flown into"
    stops = braking_m(crash.answer_m_s) <= room_m
    return "seen and flown into" if stops else "seen too late to stop"


def _where(crash: CollisionAnalysis, camera: PolicyCamera | None) -> str:
    """Return a sentence on the obstacle's position in the last effective frame."""
    view = crash.view
    if view is None or camera is None:
        return ""
    place = f"{view.distance_m:.1f} m off, {_side(view.bearing_rad)}"
    if view.share is not None and view.share >= SEEN_SHARE:
        return f"On the last frame used, {crash.what} filled {view.share:.1%} of it: {place}."
    limit = math.degrees(camera.half_angle_rad)
    if crash.glass:
        return f"{crash.what} is of glass; the camera measured through it. It lay {place}."
    if view.hidden:
        return f"On the last frame used, {crash.what} was hidden by something nearer: {place}."
    if camera.aside_rad(view.bearing_rad) > camera.half_angle_rad:
        return (
            f"On the last frame used, {crash.what} lay {place}; the camera sees {limit:.0f}° to "
            "either side."
        )
    if view.share is None:
        return f"On the last frame used, the spot of the {crash.what} that was hit lay {place}."
    return f"On the last frame used, {crash.what} was barely in the picture: {place}."


def _side(angle_rad: float) -> str:
    degrees = round(math.degrees(angle_rad))
    if degrees == 0:
        return "straight ahead"
    return f"{abs(degrees)}° to the {'right' if degrees > 0 else 'left'}"


LISTED = 12
"""Maximum number of rows in the table of worst flights."""

NAMED = 6
"""Maximum number of flights listed per cause."""

NOT_RECORDED = Trajectory(
    np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0)
)


def examine_worst(
    run: LoadedRun, arenas: Mapping[int, Arena], vehicle: VehicleProfile | None
) -> list[ExaminedFlight]:
    """Return up to `EXAMINED` worst flights with their causes, as far as data allow."""
    usual = episode_record.usual_flight(run.episodes)
    camera = None if vehicle is None else PolicyCamera.of(vehicle.camera)
    brake = None if vehicle is None else partial(_braking_m, vehicle)
    examined = []
    for record in episode_record.ranked(run.episodes)[:EXAMINED]:
        path = flown_path(run, record)
        flight = long_flights.Evidence(
            record,
            NOT_RECORDED if path is None else path,
            run.latency.get(record.index, {}),
            arenas.get(record.index),
            camera,
            brake,
        )
        lost_s, excess = (
            episode_record.time_lost_s(record, usual),
            episode_record.path_excess(record),
        )
        examined.append(ExaminedFlight(record, cause_of(flight, usual), lost_s, excess))
    return examined


def worst_table(judged: Sequence[ExaminedFlight], total: int) -> document.TableView | None:
    """Return the worst flights with their causes; None without flights."""
    if not judged:
        return None
    columns = document.columns_of(
        "# | seed | <outcome | after [s] | time lost [s] | way [x straight] | <cause"
    )
    shown = judged[:LISTED]
    notes = [
        "Failed flights first, each by time lost: its time less that of the run's median pace over "
        "the same straight way. Causes are worked out from what was recorded."
    ]
    if len(shown) < total:
        notes.append(f"The {len(shown)} worst of {total:,} flights.")
    rows, links = tuple(map(_row, shown)), [each.record.index for each in shown]
    return document.TableView("worst", "Worst flights", columns, rows, tuple(notes), links=links)


def _row(judged: ExaminedFlight) -> tuple[str, ...]:
    record = judged.record
    arrived = record.outcome is Outcome.SUCCESS
    # Time lost is meaningless for flights that ended early.
    whole = arrived or record.outcome is Outcome.TIMEOUT
    return (
        f"{record.index}",
        f"{record.seed}",
        document.OUTCOME_LABELS[record.outcome],
        f"{(record.ended_us - record.zero_us) / US_PER_S:.1f}",
        document.NONE
        if judged.lost_s is None or not whole
        else f"{round(judged.lost_s, 1) + 0.0:+.1f}",
        document.NONE if judged.excess is None or not arrived else f"{1.0 + judged.excess:.2f}",
        judged.cause.kind,
    )


def causes_table(judged: Sequence[ExaminedFlight], run: LoadedRun) -> document.TableView | None:
    """Return the number of failed flights by cause; None for fewer than two failures."""
    failed = [j for j in judged if j.record.outcome is not Outcome.SUCCESS]
    if len(failed) < 2:
        return None
    counts = Counter(j.cause.kind for j in failed)
    rows = []
    for kind, count in counts.most_common():
        which = [f"{j.record.index}" for j in failed if j.cause.kind == kind]
        more = ", …" if len(which) > NAMED else ""
        share = f"{100.0 * count / len(failed):.0f}"
        rows.append((kind, f"{count}", share, ", ".join(which[:NAMED]) + more))
    columns = document.columns_of("<cause | flights | of those that failed [%] | <which")
    all_failed = sum(e.outcome is not Outcome.SUCCESS for e in run.episodes)
    notes: tuple[str, ...] = ()
    if all_failed > len(failed):
        notes = (f"The first {len(failed)} of {all_failed:,} flights that failed.",)
    return document.TableView("causes", "Why flights failed", columns, tuple(rows), notes)


def worst_section(page: ReportInput) -> tuple[document.Section, ...]:
    """Return the causes of failed flights, and the worst flights."""
    causes = document.tables_section(causes_table(page.worst, page.run))
    return causes + document.tables_section(worst_table(page.worst, len(page.run.episodes)))


def _braking_m(vehicle: VehicleProfile, speed_m_s: float) -> float:
    return braking_of(vehicle).distance_from_m(speed_m_s)


Floats = NDArray[np.float64]

NOTHING_M = 1e-6
"""Half extents of a removed obstacle [m]."""

SAME_DEPTH_M = 1e-3
"""Tolerance for depths of the same surface."""


@dataclass(frozen=True)
class ObstacleView:
    """Point of impact as seen from the vehicle at the exposure of a frame."""

    distance_m: float
    """Horizontal distance from the vehicle's centre [m]."""
    bearing_rad: float
    """Bearing from the vehicle's heading, positive to the right [rad]."""
    share: float | None
    """Share of the image that shows the obstacle, 0 to 1; None for a wall or the floor."""
    hidden: bool
    """True if the obstacle is within the image but completely occluded."""


def passes_through(arena: Arena, i: int, camera: PolicyCamera) -> bool:
    """Return True if obstacle i is glass and the camera measures through it."""
    clear = _clear(arena, camera)
    return clear is not None and bool(clear[i])


def _clear(arena: Arena, camera: PolicyCamera) -> NDArray[np.bool_] | None:
    """Return a mask (n,) of obstacles invisible to a camera; None if all are visible."""
    return arena.clear if camera.intrinsics.kind == "depth" else None


def bearing(quaternion: Floats, offset: Floats) -> float:
    """Return the bearing [rad] of an offset NED [m] from the heading, positive to the right."""
    angle = math.atan2(offset[1], offset[0]) - quat_yaw(quaternion)
    return math.remainder(angle, 2.0 * math.pi)


def nearest_spot(obstacles: Obstacles, i: int, center: Floats, position: Floats) -> Floats:
    """Return the point (2,) of obstacle i's outline nearest to a position NED [m]."""
    offset = position[:2] - center[:2]
    if obstacles.shape[i] == Shape.BOX:
        cos, sin = math.cos(float(obstacles.yaw[i])), math.sin(float(obstacles.yaw[i]))
        axes = np.array([[cos, sin], [-sin, cos]])
        half = obstacles.half_size[i, :2]
        spot: Floats = center[:2] + np.clip(axes @ offset, -half, half) @ axes
        return spot
    reach = float(np.linalg.norm(offset))
    radius = float(obstacles.half_size[i, 0])
    return center[:2] + offset * min(1.0, radius / reach if reach else 0.0)


def view_obstacle(
    path: Trajectory,
    frame_us: int,
    hit_us: int,
    arena: Arena,
    began_us: int,
    i: int,
    camera: PolicyCamera,
) -> ObstacleView:
    """Return direction and visibility of obstacle i in a frame; it may move since `began_us`."""
    position, _, quaternion = pose_at(path, frame_us)
    centers = arena.centers_at(frame_us - began_us)
    centers_then = arena.centers_at(hit_us - began_us)
    spot = nearest_spot(arena.obstacles, i, centers_then[i], pose_at(path, hit_us)[0])
    offset = spot + (centers[i] - centers_then[i])[:2] - position[:2]
    eye, attitude = camera_pose(position, quaternion, camera.mount)
    clear = _clear(arena, camera)
    if passes_through(arena, i, camera):
        distance = float(np.linalg.norm(offset))
        return ObstacleView(distance, bearing(quaternion, offset), 0.0, hidden=False)

    def depth(
        keep: slice, meshes: tuple[PlacedMesh, ...], ground: Ground | None = None
    ) -> NDArray[np.float32]:
        """Return the depth image (h, w) of the arena with only the kept obstacles."""
        o, half = arena.obstacles, arena.obstacles.half_size
        if clear is not None:
            # A negligible size makes glass invisible and keeps the obstacle numbers.
            half = np.where(clear[:, None], NOTHING_M, half)
        some = Obstacles(o.shape[keep], o.center[keep], half[keep], o.yaw[keep])
        # Without appearance and statics, all remaining obstacles are opaque.
        bare = replace(arena, obstacles=some, tours=(), meshes=meshes, ground=ground, statics=None)
        bare = replace(bare, appearance=DEFAULT_APPEARANCE)
        return render(bare, centers[keep], camera.intrinsics, camera.range_m, eye, attitude)

    whole = depth(slice(None), arena.meshes, arena.ground)
    empty = depth(slice(0, 0), ())
    if (mesh := arena.mesh_of(i)) is None:
        alone = depth(slice(i, i + 1), ())
    else:
        owned = slice(mesh.first, mesh.first + mesh.count)
        alone = depth(owned, (replace(mesh, first=0),))
    outline = np.abs(alone - empty) > SAME_DEPTH_M
    shown = outline & (np.abs(whole - alone) <= SAME_DEPTH_M)
    return ObstacleView(
        distance_m=float(np.linalg.norm(offset)),
        bearing_rad=bearing(quaternion, offset),
        share=float(shown.mean()),
        hidden=bool(outline.any() and not shown.any()),
    )


def view_wall(path: Trajectory, frame_us: int, hit_us: int, arena: Arena) -> ObstacleView:
    """Return the direction of a wall's point of impact at the exposure of a frame."""
    b = arena.bounds
    north, east = pose_at(path, hit_us)[0][:2]
    spots = np.array(
        [[b.north_max, east], [b.north_min, east], [north, b.east_max], [north, b.east_min]]
    )
    spot = spots[np.argmin(np.linalg.norm(spots - [north, east], axis=1))]
    position, _, quaternion = pose_at(path, frame_us)
    offset = spot - position[:2]
    return ObstacleView(
        float(np.linalg.norm(offset)), bearing(quaternion, offset), None, hidden=False
    )

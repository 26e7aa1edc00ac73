"""The environment generator: (spec, seed) -> Arena, a pure function."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np

from airl_mav.arena import geometry, placement
from airl_mav.arena.placed_assets import AssetBodies, Things, draw_bodies, draw_things, generate_own
from airl_mav.arena.relief import draw_ground, stand_on
from airl_mav.arena.tours import draw_tours
from airl_mav.arena.walls import (
    Openings,
    Plan,
    behind,
    closed_from_above,
    draw_openings,
    draw_plan,
    frames,
    room_walls,
    standing_on_the_floor,
    with_gates,
    with_walls,
)
from airl_mav.core import errors, streams
from airl_mav.profiles.arena import OBSTACLES, ArenaSpec
from airl_mav.profiles.walls import HEADROOM_M

LAYOUTS = 20
"""Layouts drawn before generation fails."""

GOALS_PER_LAYOUT = 4
"""Goals drawn in a layout before the layout is discarded for lack of a passage."""


class _Stream(IntEnum):
    """Independent random streams of a seed: changing one draw leaves the others unchanged."""

    COUNT = 0
    STATIC = 1
    GOAL = 2
    MOVING = 3
    GATES = 4
    HEIGHT = 5
    ROOMS = 6
    TERRAIN = 7


@dataclass(frozen=True)
class _Request:
    """Values shared by all layouts of one call."""

    spec: ArenaSpec
    bounds: geometry.Bounds
    counts: tuple[int, int]
    ring_m: tuple[float, float]
    vehicle_width_m: float
    openings: Openings
    plan: Plan | None
    ground: geometry.Ground | None
    """Hills; None = flat floor."""

    @cached_property
    def walls(self) -> geometry.Obstacles:
        """Boxes of the gates, or of the walls between rooms."""
        if self.plan is None:
            return frames(self.openings, self.bounds)
        return room_walls(self.plan, self.bounds)[0]

    def with_walls(
        self, statics: geometry.Statics | None, standing: geometry.Obstacles
    ) -> geometry.Statics | None:
        """Return the owners of static primitives, followed by the boxes of walls."""
        if self.plan is None:
            return with_gates(statics, standing, len(self.openings))
        return with_walls(statics, standing, room_walls(self.plan, self.bounds)[1])

    @property
    def building(self) -> geometry.Building | None:
        """Summary of the rooms for the arena; None = no rooms."""
        if self.plan is None:
            return None
        return geometry.Building(len(self.plan.rooms), len(self.plan.doors), len(self.walls))

    @property
    def hills(self) -> placement.Hills | None:
        """Ground that obstructs flight at the flight altitude; None = flat floor."""
        if self.ground is None:
            return None
        return placement.Hills(self.ground, self.spec.flight_altitude_m - HEADROOM_M)

    @cached_property
    def start_box(self) -> placement.Boxes:
        """Box around the start that stays free of obstacles."""
        return _around(np.zeros(2), self.spec.start.clearance_m)


def generate(
    spec: ArenaSpec, seed: int, *, name: str, vehicle_width_m: float, zone: int | None = None
) -> geometry.Arena:
    """Generate the arena of a seed, deterministic on any machine with the same numpy.

    `spec.count_period` consecutive seeds, from 0 on, share their obstacle counts. A passage at
    least `vehicle_width_m` wide joins start and goal. The curriculum `zone` bounds the goal, None =
    the largest. The obstacles depend on the zone only if a first layout had no room for the goal.
    Raises UsageError with the reason if an argument is invalid or LAYOUTS layouts failed.
    """
    if seed < 0:
        raise errors.UsageError(f"seed = {seed}: accepted: value >= 0")
    if not vehicle_width_m > 0.0:
        raise errors.UsageError(f"vehicle_width_m = {vehicle_width_m:g}: accepted: value > 0 m")
    if spec.generator != OBSTACLES:
        return generate_own(spec, seed, name=name, vehicle_width_m=vehicle_width_m, zone=zone)
    openings = draw_openings(_rng(seed, _Stream.GATES), spec)
    _check_openings(openings, name, seed, vehicle_width_m)
    bounds = local_bounds(spec)
    request = _Request(
        openings=openings,
        plan=_draw_rooms(spec, seed, bounds, name, vehicle_width_m),
        ground=(
            draw_ground(_rng(seed, _Stream.TERRAIN), spec.terrain, bounds)
            if spec.terrain.drawn
            else None
        ),
        spec=spec,
        bounds=bounds,
        counts=_draw_counts(spec, seed),
        ring_m=(spec.goal.min_distance_m, placement.zone_radius_m(spec, zone)),
        vehicle_width_m=vehicle_width_m,
    )
    # A fixed goal outside the zone fails in every layout, so test it once.
    _check_fixed_goal(request, zone)
    static_rng, goal_rng, moving_rng = (
        _rng(seed, stream) for stream in (_Stream.STATIC, _Stream.GOAL, _Stream.MOVING)
    )
    # The failure with the most progress explains best what is missing.
    failure = placement.NoRoomError("", -1)
    for _ in range(LAYOUTS):
        try:
            static, standing, statics, meshes = _draw_static(static_rng, request)
            goal = _draw_reachable_goal(goal_rng, request, static, standing)
            moving, tours = _draw_moving(moving_rng, request, standing)
        except placement.NoRoomError as error:
            failure = max(failure, error, key=lambda each: each.progress)
            continue
        return geometry.Arena(
            name=name,
            seed=seed,
            bounds=request.bounds,
            wall_colour=spec.wall_colour,
            obstacles=_concatenate(_concatenate(static, request.walls), moving),
            tours=tours,
            goal=goal,
            appearance=spec.appearance,
            meshes=meshes,
            statics=request.with_walls(statics, static),
            goal_height_m=_draw_height(request, seed, goal),
            n_gates=len(openings),
            building=request.building,
            ground=request.ground,
        )
    raise errors.UsageError(f"arena {name!r}, seed {seed}: {failure} (best of {LAYOUTS} layouts)")


def local_bounds(spec: ArenaSpec) -> geometry.Bounds:
    """Return the walls in local NED, origin at the start."""
    return geometry.Bounds(
        north_min=-spec.start.north_m,
        north_max=spec.size.north_m - spec.start.north_m,
        east_min=-spec.start.east_m,
        east_max=spec.size.east_m - spec.start.east_m,
        height=spec.size.height_m,
        ceiling=spec.size.ceiling,
    )


def free_area_fraction(arena: geometry.Arena) -> float:
    """Return the share of the floor not covered by static obstacles, seen from above."""
    b, n = arena.bounds, arena.n_static
    if arena.statics is not None:  # Parts of one asset may overlap.
        return placement.free_share(b, arena.obstacles, n)
    floor = (b.north_max - b.north_min) * (b.east_max - b.east_min)
    return 1.0 - float(placement.footprint_areas(arena.obstacles)[:n].sum()) / floor


def _rng(seed: int, stream: _Stream) -> np.random.Generator:
    return streams.seeded(seed, stream)


def _draw_counts(spec: ArenaSpec, seed: int) -> tuple[int, int]:
    """Return the numbers of static and moving obstacles, shared within a count period."""
    # Counts depend on the period, not on the seed, so consecutive seeds share them.
    rng = _rng(seed // spec.count_period, _Stream.COUNT)
    static = rng.integers(*spec.static.count, endpoint=True)
    moving = rng.integers(*spec.moving.count, endpoint=True)
    return int(static), int(moving)


def _check_fixed_goal(request: _Request, zone: int | None) -> None:
    """Reject a fixed goal outside the requested zone; the spec has checked it against the walls."""
    fixed, radius = request.spec.goal.fixed, request.ring_m[1]
    if fixed is None or zone is None:
        return
    if (distance := float(np.hypot(*fixed))) > radius:
        raise errors.UsageError(
            f"goal.north_m = {fixed[0]:g}, goal.east_m = {fixed[1]:g}: fixed {distance:.1f} m from "
            f"the start; accepted: value <= {radius:g} m in zone {zone}"
        )


def _draw_rooms(
    spec: ArenaSpec, seed: int, bounds: geometry.Bounds, name: str, vehicle_width_m: float
) -> Plan | None:
    """Draw the rooms; None = no rooms. Raises UsageError for narrow doors or if no plan fits."""
    if not spec.rooms.drawn:
        return None
    # The passage search works on a raster, so a door needs more than the vehicle's width.
    least = placement.least_gap_m(bounds, vehicle_width_m)
    if spec.rooms.door_width_m[0] < least:
        raise errors.UsageError(
            f"arena {name!r}: rooms.door_width_m = {list(spec.rooms.door_width_m)}: accepted: value"
            f" >= {least:.2f} m, so that a vehicle {vehicle_width_m:g} m wide finds its way through"
        )
    keep_off = _around(np.zeros(2), spec.start.clearance_m)
    if spec.goal.fixed is not None:
        goal = _around(np.array(spec.goal.fixed), spec.goal.clearance_m)
        keep_off = placement.join(keep_off, goal)
    return draw_plan(_rng(seed, _Stream.ROOMS), spec, bounds, keep_off, name)


def _check_openings(openings: Openings, name: str, seed: int, vehicle_width_m: float) -> None:
    """Reject an opening too small for the vehicle at any attitude."""
    if not len(openings):
        return
    least = 2.0 * float(openings.half_size[:, 1:].min())
    if least <= vehicle_width_m:
        raise errors.UsageError(
            f"arena {name!r}, seed {seed}: an opening of a gate is {least:.2f} m wide or high "
            f"(gates.width_m, gates.height_m); accepted: more than the vehicle's "
            f"{vehicle_width_m:g} m"
        )


def _draw_height(request: _Request, seed: int, goal: placement.Floats) -> float | None:
    spec = request.spec
    if spec.goal.height_m is None:
        return None
    low, high = spec.goal.height_m
    height_m = low if low == high else float(_rng(seed, _Stream.HEIGHT).uniform(low, high))
    if request.ground is not None:
        height_m += request.ground.height_at(float(goal[0]), float(goal[1]))
    return height_m


def _draw_static(
    rng: np.random.Generator, request: _Request
) -> tuple[
    geometry.Obstacles, placement.Boxes, geometry.Statics | None, tuple[geometry.PlacedMesh, ...]
]:
    """Draw and place the static obstacles; return bounding boxes, groups and meshes, too."""
    spec, (n, _) = request.spec, request.counts
    bodies: AssetBodies | Things
    if spec.has_assets:
        bodies = things = draw_things(rng, n, spec)
        statics: geometry.Statics | None = things.statics
    else:
        bodies, statics = draw_bodies(rng, n, spec.static, spec.flight_altitude_m), None
    # Obstacles keep off start, goal, walls and doors.
    keep_off = request.start_box
    if spec.goal.fixed is not None:
        keep_off = placement.join(
            keep_off, _around(np.array(spec.goal.fixed), spec.goal.clearance_m)
        )
    if len(request.walls):
        keep_off = placement.join(
            keep_off, placement.bounding_boxes(request.walls).grown(spec.min_clearance_m)
        )
    if request.plan is not None:
        keep_off = placement.join(
            keep_off, request.plan.grown_passages(spec.rooms.door_clearance_m)
        )
    try:
        places = placement.place_all(
            rng, bodies.bounding_half, keep_off, request.bounds, spec.min_clearance_m
        )
    except placement.NoRoomError as error:
        floor = spec.size.north_m * spec.size.east_m
        taken = 4.0 * np.prod(bodies.bounding_half + spec.min_clearance_m / 2.0, axis=1).sum()
        raise placement.NoRoomError(
            f"too dense: {error.progress} of {n} static obstacles found a place, none for the next "
            f"in {placement.TRIES} tries; with half of min_clearance_m {spec.min_clearance_m:g} "
            f"around each, all would take {taken / floor:.0%} of the {spec.size.north_m:g} x "
            f"{spec.size.east_m:g} m floor",
            error.progress,
        ) from None
    standing = placement.Boxes(places, bodies.bounding_half)
    static = bodies.at(places)
    meshes = bodies.meshes_at(places) if isinstance(bodies, Things) else ()
    if request.ground is not None:
        static, meshes = stand_on(request.ground, static, standing, statics, meshes)
    return static, standing, statics, meshes


def _draw_reachable_goal(
    rng: np.random.Generator,
    request: _Request,
    static: geometry.Obstacles,
    standing: placement.Boxes,
) -> placement.Floats:
    """Return the fixed goal, or draw a free and reachable one."""
    spec, progress = request.spec, len(static)
    keep_off = standing.grown(spec.goal.clearance_m)
    boxes: placement.Boxes | None = standing
    clearance_m = spec.goal.clearance_m
    # Behind the last gate, so that the flight passes all gates.
    if len(request.openings):
        keep_off = placement.join(keep_off, behind(request.openings, request.bounds, clearance_m))
        # The vehicle passes through openings: only boxes of full height block it.
        static, boxes = _concatenate(static, closed_from_above(request.walls)), None
    elif request.plan is not None:
        around = placement.join(placement.bounding_boxes(request.walls), request.plan.passages())
        keep_off = placement.join(keep_off, around.grown(clearance_m))
        # Lintels hang above the doors, so they do not block the passage.
        static, boxes = _concatenate(static, standing_on_the_floor(request.walls)), None
    for _ in range(GOALS_PER_LAYOUT):
        goal = (
            placement.draw_goal(
                rng, request.bounds, keep_off, request.ring_m, spec.goal.clearance_m
            )
            if spec.goal.fixed is None
            else np.array(spec.goal.fixed)
        )
        if goal is None:
            near, far = request.ring_m
            raise placement.NoRoomError(
                f"no free place for the goal {near:g} to {far:g} m from the start, "
                f"goal.clearance_m {spec.goal.clearance_m:g}, among {len(static)} static obstacles",
                progress,
            )
        if placement.passage_exists(
            request.bounds, static, goal, request.vehicle_width_m, boxes, request.hills
        ):
            return goal
    hills = "" if request.ground is None else " and hills"
    raise placement.NoRoomError(
        f"no way {request.vehicle_width_m:g} m wide from the start to the goal among "
        f"{len(static)} static obstacles{hills}",
        progress,
    )


def _draw_moving(
    rng: np.random.Generator, request: _Request, standing: placement.Boxes
) -> tuple[geometry.Obstacles, tuple[geometry.Tour, ...]]:
    """Draw the moving obstacles at time 0, and their tours, around the static bounding boxes."""
    spec, (_, n) = request.spec, request.counts
    bodies = draw_bodies(rng, n, spec.moving, spec.flight_altitude_m)
    gap, walking_gap = spec.min_clearance_m, spec.moving.clearance_m
    if len(request.walls):
        standing = placement.join(standing, placement.bounding_boxes(request.walls))
    always = request.start_box
    if request.plan is not None:  # Moving obstacles stay in their rooms.
        always = placement.join(always, request.plan.grown_passages(spec.rooms.door_clearance_m))
    on_the_way = placement.join(always, standing.grown(walking_gap))
    # The gap at time 0 may be larger than the gap on the way.
    at_first = on_the_way
    if gap > walking_gap:
        at_first = placement.join(always, standing.grown(gap))
    tours = draw_tours(
        rng,
        bodies.bounding_half,
        at_first,
        on_the_way,
        request.bounds,
        gap,
        spec.moving,
    )
    if len(tours) < n:
        raise placement.NoRoomError(
            f"too dense: {len(tours)} of {n} moving obstacles found a place and a tour among "
            f"{len(standing)} static ones",
            len(standing) + len(tours),
        )
    places = np.array([tour.points[0] for tour in tours]).reshape(n, 2)
    return bodies.at(places), tuple(tours)


def _around(center: placement.Floats, clearance: float) -> placement.Boxes:
    """Return the box that extends `clearance` [m] from a point."""
    return placement.Boxes(center[None], np.full((1, 2), clearance))


def _concatenate(static: geometry.Obstacles, moving: geometry.Obstacles) -> geometry.Obstacles:
    return geometry.Obstacles(
        *(
            np.concatenate([getattr(static, field), getattr(moving, field)])
            for field in ("shape", "center", "half_size", "yaw")
        )
    )

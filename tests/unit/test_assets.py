"""Assets made of parts: poses and materials of the parts, sensing and contacts."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
import pytest
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

from airl_mav.addons.colour.appearance import OBSTACLE, TEXTURES, linear_of
from airl_mav.addons.colour.profile import MATERIALS
from airl_mav.arena.generate import free_area_fraction, generate
from airl_mav.arena.geometry import Arena, Shape, Statics
from airl_mav.arena.placement import Boxes, bounding_boxes, gaps_suffice
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import render
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import ned_to_enu, quat_from_euler
from airl_mav.envs.arena_batch import NOTHING, WALL, touches
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from firmware_sim.plant.bullet_body import BulletWorld

WIDTH_M = 1.0
SEEDS = range(6)
HALF_HEIGHT_M = 0.1
BARK, FOLIAGE = (np.array(MATERIALS[name].albedo) for name in ("bark", "foliage"))

T_SHAPE = """base = "no-obstacles"
asset_scale = [2.0, 2.0]
[static]
count = [1, 1]
shapes = ["t-shape"]
[[assets.t-shape.parts]]
shape = "cylinder"
radius_m = 0.1
height_m = 1.0
forward_m = 0.25
material = "brick"
[[assets.t-shape.parts]]
shape = "box"
length_m = 0.2
width_m = 1.0
height_m = 0.1
bottom_m = 1.0
right_m = 0.5
yaw_deg = 30
"""


def park(seed: int, **knobs: Any) -> Arena:
    spec = load_profile("arenas", "park", ArenaSpec)
    spec = ArenaSpec.model_validate({**spec.model_dump(), **knobs})
    return generate(spec, seed, name="park", vehicle_width_m=WIDTH_M)


def own(tmp_path: Path, text: str = T_SHAPE, seed: int = 0) -> Arena:
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    spec = load_profile("arenas", str(path), ArenaSpec)
    return generate(spec, seed, name="own", vehicle_width_m=WIDTH_M)


def off_edges(bodies: np.ndarray) -> np.ndarray:
    """Return which pixels have all eight neighbours on the same body."""
    inner = bodies[1:-1, 1:-1]
    h, w = bodies.shape
    same = [bodies[i : h - 2 + i, j : w - 2 + j] == inner for i in range(3) for j in range(3)]
    return np.pad(np.all(same, axis=0), 1)


def touched(arena: Arena, place: tuple[float, float, float], radius_m: float) -> int:
    """Return what a disc 0.2 m high touches, as `envs.arenas.touches`."""
    o = arena.obstacles
    return touches(
        *(place, radius_m, HALF_HEIGHT_M, arena.bounds.as_array(), len(o)),
        *(o.shape, o.center, o.half_size, o.yaw),
    )


def statics_of(arena: Arena) -> Statics:
    assert arena.statics is not None
    return arena.statics


def things_of(arena: Arena) -> list[np.ndarray]:
    """Return the numbers of the primitives of each thing."""
    statics = statics_of(arena)
    return [np.flatnonzero(statics.of == k) for k in range(len(statics.names))]


def half_sizes(arena: Arena, name: str) -> list[list[float]]:
    """Return the half sizes of all parts of the things of a name, sorted."""
    statics, sizes = statics_of(arena), arena.obstacles.half_size.tolist()
    return sorted(
        size for part, size in enumerate(sizes[: arena.n_static]) if statics.name_of(part) == name
    )


def test_the_parts_keep_their_places_in_the_thing(tmp_path: Path) -> None:
    headings = []
    for seed in range(5):
        obstacles = own(tmp_path, seed=seed).obstacles
        assert obstacles.shape.tolist() == [Shape.CYLINDER, Shape.BOX]
        np.testing.assert_allclose(obstacles.half_size, [[0.2, 0.2, 1.0], [0.2, 1.0, 0.1]])
        np.testing.assert_allclose(obstacles.center[:, 2], [-1.0, -2.1])
        heading = obstacles.yaw[1] - math.radians(30.0)
        turn = Rotation.from_euler("z", heading).as_matrix()[:2, :2]
        between = obstacles.center[1, :2] - obstacles.center[0, :2]
        np.testing.assert_allclose(between, turn @ [-0.5, 1.0], atol=1e-12)
        headings.append(heading)
    assert len(set(headings)) == 5


def test_kinds_sizes_and_headings_are_drawn() -> None:
    arenas = [park(seed, asset_scale=[0.5, 1.1]) for seed in range(30)]
    names = [name for arena in arenas if arena.statics for name in arena.statics.names]
    kinds = ("tree", "lamp-post", "wire", "fence", "pylon", "rock", "window-frame", "box")
    assert set(names) == set(kinds)
    trunks = [
        float(arena.obstacles.half_size[parts[0], 0]) / 0.14
        for arena in arenas
        for parts, name in zip(things_of(arena), statics_of(arena).names, strict=True)
        if name == "tree"
    ]
    assert min(trunks) < 0.6
    assert max(trunks) > 1.0
    assert all(0.5 <= scale <= 1.1 for scale in trunks)


def test_the_same_seed_is_the_same_and_what_one_thing_is_changes_no_other() -> None:
    again = park(3)
    np.testing.assert_array_equal(park(3).obstacles.center, again.obstacles.center)
    shapes = ["tree", "lamp-post", "wire", "fence", "pylon", "rock", "window-frame", "box"]
    other = [{"tree": "chair"}.get(name, name) for name in shapes]
    static = load_profile("arenas", "park", ArenaSpec).static.model_dump()
    changed = park(3, static={**static, "shapes": other})
    kept = set(statics_of(again).names) - {"tree"}
    assert kept
    for name in kept:
        assert half_sizes(changed, name) == half_sizes(again, name)


@pytest.mark.parametrize("seed", SEEDS)
def test_things_keep_their_distance_and_leave_a_way(seed: int) -> None:
    arena = park(seed)
    boxes, b = bounding_boxes(arena.obstacles), arena.bounds
    corners = [
        ((boxes.center - boxes.half)[parts].min(axis=0), (boxes.center + boxes.half)[parts].max(0))
        for parts in things_of(arena)
    ]
    for i, (low, high) in enumerate(corners):
        assert (low > np.array([b.north_min, b.east_min]) + 1.5 - 1e-9).all()
        assert (high < np.array([b.north_max, b.east_max]) - 1.5 + 1e-9).all()
        for other_low, other_high in corners[:i]:
            assert max(*(other_low - high), *(low - other_high)) > 1.5 - 1e-9
    middle = np.array([(low + high) / 2.0 for low, high in corners])
    half = np.array([(high - low) / 2.0 for low, high in corners])
    # One box a thing: its parts touch each other, which closes no way.
    assert gaps_suffice(b, arena.obstacles, arena.goal, WIDTH_M, Boxes(middle, half))
    assert not gaps_suffice(b, arena.obstacles, arena.goal, WIDTH_M)


def test_the_free_share_counts_what_is_above_each_other_once(tmp_path: Path) -> None:
    text = """base = "no-obstacles"
[size]
north_m = 20
east_m = 20
[start]
east_m = 10
[static]
count = [1, 1]
shapes = ["stack"]
[[assets.stack.parts]]
shape = "box"
length_m = 2.0
width_m = 2.0
height_m = 1.0
[[assets.stack.parts]]
shape = "sphere"
radius_m = 0.5
bottom_m = 1.0
"""
    assert free_area_fraction(own(tmp_path, text)) == pytest.approx(1.0 - 4.0 / 400.0, abs=5e-4)


def test_parts_share_a_draw_and_have_materials_of_their_own() -> None:
    arena = park(7, appearance={"static": {"materials": ["brick", "plaster"], "tint": 0.3}})
    finish = arena.look.finish
    assert arena.statics is not None
    factors = []
    for parts, name in zip(things_of(arena), arena.statics.names, strict=True):
        rows = OBSTACLE + parts
        textures = [TEXTURES[finish.texture[row]] for row in rows]
        if name == "tree":
            assert textures == ["noise", *4 * ["foliage"]]
            bark = finish.albedo[rows[0], 0] / linear_of(BARK / 255.0)
            leaves = finish.albedo[rows[1], 0] / linear_of(FOLIAGE / 255.0)
            np.testing.assert_allclose(bark, leaves)  # The same brightness and tint.
            factors.append(bark)
        elif name == "box":
            assert textures[0] in ("brick", "plain")
    assert all(np.ptp(factor) > 0.01 for factor in factors)
    alike = park(7)
    # Moving obstacles and light are drawn as if each thing were one obstacle.
    np.testing.assert_array_equal(alike.look.light.to_sun, arena.look.light.to_sun)


@pytest.mark.parametrize("seed", SEEDS)
def test_depth_is_what_pybullet_s_rays_measure(seed: int) -> None:
    arena, rng = park(seed), np.random.default_rng(seed)
    statics = arena.statics
    assert statics is not None
    world, k = BulletWorld(arena, 1.0), Intrinsics(64, 48, 60.0, 31.5, 23.5)
    numbers = {name: body for body, name in world.names.items()}
    first = min(numbers[arena.name_of(i)] for i in range(arena.n_static))
    u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
    ahead = np.stack([np.ones(u.shape), (u - k.cx) / k.focal, (v - k.cy) / k.focal], axis=-1)
    seen: set[str] = set()
    compared = 0
    try:
        for parts in things_of(arena):
            target = arena.obstacles.center[parts].mean(axis=0)
            bearing, height = rng.uniform(-math.pi, math.pi), rng.uniform(1.0, 4.0)
            away = 6.0 * np.array([math.cos(bearing), math.sin(bearing)])
            position = np.array([*(target[:2] - away), -height])
            rays = ahead.reshape(-1, 3) @ Rotation.from_euler("z", bearing).as_matrix().T
            ends = ned_to_enu(position + 40.0 * rays).tolist()
            starts = [ned_to_enu(position).tolist()] * len(ends)
            hits = pybullet.rayTestBatch(starts, ends, physicsClientId=world.number)
            place = (float(position[0]), float(position[1]), float(position[2]))
            if touched(arena, place, 0.3) != NOTHING:
                continue  # It sees nothing from inside.
            # A ray's share of 40 m is of depth, as its component along the axis is 1.
            expected = 40.0 * np.array([hit[2] for hit in hits]).reshape(u.shape)
            bodies = np.array([hit[0] for hit in hits]).reshape(u.shape)
            attitude = quat_from_euler(0.0, 0.0, bearing)
            found = render(arena, arena.centers_at(0), k, 39.9, position, attitude)
            # At a silhouette a rounding error decides.
            near = off_edges(bodies) & (bodies >= first) & (expected > 0.5)
            assert np.abs(found - expected)[near].max(initial=0.0) < 2e-3
            compared += int(np.count_nonzero(near))
            seen |= {statics.name_of(body - first) for body in bodies[near].tolist()}
    finally:
        world.close()
    assert compared > 1000
    assert len(seen) > 1


@pytest.mark.parametrize("seed", SEEDS)
def test_a_vehicle_touches_what_pybullet_says_it_touches(seed: int) -> None:
    arena, rng = park(seed), np.random.default_rng(seed)
    o, world, radius = arena.obstacles, BulletWorld(arena, 1.0), 0.25
    client = world.number
    disc = pybullet.createCollisionShape(
        pybullet.GEOM_CYLINDER, radius=radius, height=2 * HALF_HEIGHT_M, physicsClientId=client
    )
    body = pybullet.createMultiBody(1.0, disc, physicsClientId=client)
    obstacles = [n for n, name in world.names.items() if name.startswith("static-")]
    compared = touching = 0
    try:
        for part in rng.integers(len(o), size=400).tolist():
            spread = o.half_size[part] + 0.5
            position = o.center[part] + rng.uniform(-spread, spread)
            position[2] = min(position[2], -0.15)
            pybullet.resetBasePositionAndOrientation(
                body, ned_to_enu(position).tolist(), (0, 0, 0, 1), client
            )
            gaps = [
                point[8]
                for other in obstacles
                for point in pybullet.getClosestPoints(body, other, 0.3, physicsClientId=client)
            ]
            gap = min(gaps, default=1.0)
            if abs(gap) < 0.02:
                continue  # Bullet keeps margins around its bodies.
            place = (float(position[0]), float(position[1]), float(position[2]))
            found = touched(arena, place, radius)
            if found == WALL:
                continue
            assert (found != NOTHING) == (gap < 0.0)
            compared, touching = compared + 1, touching + int(gap < 0.0)
    finally:
        world.close()
    assert compared > 250
    assert 50 < touching < compared - 50


def test_a_frame_can_be_flown_through_and_a_wire_cannot(tmp_path: Path) -> None:
    def hit(name: str, height: float, right: float = 0.0) -> str:
        text = f"""base = "no-obstacles"
[static]
count = [1, 1]
shapes = ["{name}"]
"""
        arena = own(tmp_path, text)
        o = arena.obstacles
        # The first part is in the middle, or a post 4 m left of it.
        turn = o.yaw[-1]
        middle = o.center[-1, :2] + right * np.array([-math.sin(turn), math.cos(turn)])
        found = touched(arena, (float(middle[0]), float(middle[1]), -height), 0.25)
        return "" if found == NOTHING else arena.name_of(found)

    assert hit("window-frame", 2.5) == ""
    assert hit("window-frame", 1.5) == "static-window-frame-0"
    assert hit("window-frame", 2.5, right=1.0) == "static-window-frame-2"
    assert hit("wire", 2.8) == ""
    assert hit("wire", 2.41, right=3.0) == "static-wire-2"


def test_a_name_says_what_was_hit() -> None:
    arena = park(2)
    assert arena.statics is not None
    for parts, name in zip(things_of(arena), arena.statics.names, strict=True):
        assert [arena.name_of(int(i)) for i in parts] == [f"static-{name}-{i}" for i in parts]


def test_a_view_is_told_what_belongs_together() -> None:
    arena = park(5)
    shown = TypeAdapter(Arena).validate_json(TypeAdapter(Arena).dump_json(arena))
    np.testing.assert_array_equal(shown.look.finish.albedo, arena.look.finish.albedo)
    assert shown.statics is not None
    assert arena.statics is not None
    assert shown.statics.names == arena.statics.names


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('["t-shape"]', '["t-shap"]', "static.shapes.0 = 't-shap': accepted: box, cylinder, sphe"),
        ('"brick"', '"brass"', "assets.t-shape.parts.0.material = 'brass': accepted: plaster, con"),
        ("assets.t-shape", "assets.sphere", "assets.sphere: accepted: a name of small letters"),
        ("assets.t-shape", "assets.T2", "assets.T2: accepted: a name of small letters"),
        ("[2.0, 2.0]", "[2.0, 9.0]", "static.shapes.0 = 't-shape': reaches up to 9.9 m (asset_sc"),
        ("radius_m = 0.1\n", "", "assets.t-shape.parts.0.radius_m: missing"),
        ("height_m = 1.0", "height_m = 0", "assets.t-shape.parts.0.height_m = 0: accepted: 0.01"),
        ('"cylinder"', '"cone"', "assets.t-shape.parts.0.shape = 'cone': accepted: 'box', 'cylin"),
    ],
)
def test_wrong_assets_get_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in T_SHAPE
    with pytest.raises(UsageError) as raised:
        own(tmp_path, T_SHAPE.replace(old, new))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)

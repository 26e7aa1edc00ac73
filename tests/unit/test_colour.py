"""The colour kernel beside closed forms of light, and beside a float64 caster of shadow rays."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.addons.colour.appearance import FLOOR, OBSTACLE, TEXTURES, linear_of, srgb_of
from airl_mav.addons.colour.picture import Picture, grey, render_picture, unpack
from airl_mav.addons.colour.profile import Appearance
from airl_mav.addons.colour.textures import PERIOD, SIDE, atlas, pattern
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.camera import primitives
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import render
from airl_mav.core.frames import quat_from_euler, quat_to_matrix
from airl_mav.profiles.arena import DEFAULT_APPEARANCE, ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.projections import Projection
from tests.support.lenses import AT_NIGHT_THE_FISHEYE, rays_of_fisheye

LEVEL = quat_from_euler(0.0, 0.0, 0.0)
DOWN = quat_from_euler(0.0, -math.pi / 2, 0.0)
FAR = 10_000.0
WHITE: dict[str, Any] = {"w": {"albedo": [255, 255, 255]}}
BARE: dict[str, Any] = {
    "materials": WHITE,
    **{kind: {"materials": ["w"], "brightness": [0.5, 0.5], "tint": 0.0}
       for kind in ("floor", "walls", "static", "moving")},
}  # fmt: skip
"""Everything has the albedo 0.5."""


BLACK_FLOOR = {"materials": ["w"], "brightness": [0.0, 0.0]}


def bodies(*found: tuple[Shape, tuple[float, ...], tuple[float, ...], float]) -> Obstacles:
    return Obstacles(
        np.array([b[0] for b in found], np.int8),
        np.array([b[1] for b in found], np.float64).reshape(-1, 3),
        np.array([b[2] for b in found], np.float64).reshape(-1, 3),
        np.array([b[3] for b in found], np.float64),
    )


def arena(obstacles: Obstacles, side: float = 20.0, **appearance: Any) -> Arena:
    look = Appearance.model_validate({**BARE, **appearance})
    bounds = Bounds(-side, side, -side, side, 5.0)
    return Arena("some", 0, bounds, (153, 0, 0), obstacles, (), np.zeros(2), look)


def sun(azimuth: float, elevation: float, irradiance: float = 1.0) -> dict[str, Any]:
    return {
        "azimuth_deg": [azimuth, azimuth],
        "elevation_deg": [elevation, elevation],
        "irradiance": [irradiance, irradiance],
        "colour": [255, 255, 255],
    }


def sky(irradiance: float) -> dict[str, Any]:
    grey_sky = [200, 200, 200]
    return {"irradiance": [irradiance, irradiance], "zenith": grey_sky, "horizon": grey_sky}


def see(
    scene: Arena,
    position: tuple[float, float, float],
    attitude: NDArray[np.float64] = LEVEL,
    k: Intrinsics | None = None,
) -> Picture:
    k = k or Intrinsics.from_fov(65, 49, math.pi / 2)
    return render_picture(scene, scene.obstacles.center, k, np.array(position), attitude)


def light_at(picture: Picture, row: int, column: int) -> float:
    """Linear light of a grey pixel, to half a step of its code."""
    red, green, blue = picture.rgb[row, column]
    assert red == green == blue
    return float(linear_of(np.array(red / 255.0)))


def expect(picture: Picture, row: int, column: int, linear: float) -> None:
    code = 255.0 * float(srgb_of(np.array(linear)))
    assert picture.rgb[row, column, 0] == pytest.approx(code, abs=0.6)


# --- light


@pytest.mark.parametrize("azimuth", [120.0, 150.0, 180.0, 225.0, 250.0])
@pytest.mark.parametrize("elevation", [15.0, 45.0, 70.0])
def test_a_wall_shines_by_lamberts_cosine(azimuth: float, elevation: float) -> None:
    """The north wall faces south: the cosine follows from two angles of the sun."""
    # The far south wall throws its shadow 5 m / tan(elevation) far at most: not up to here.
    scene = arena(bodies(), sun=sun(azimuth, elevation, 0.9), sky=sky(0.0), floor=BLACK_FLOOR)
    cosine = math.cos(math.radians(elevation)) * -math.cos(math.radians(azimuth))
    expect(see(scene, (0.0, 0.0, -2.5)), 24, 32, 0.5 * 0.9 * cosine)


def test_what_faces_away_from_the_sun_is_black_without_a_sky() -> None:
    scene = arena(bodies(), sun=sun(0.0, 45.0), sky=sky(0.0), floor=BLACK_FLOOR)
    assert not see(scene, (0.0, 0.0, -2.5)).rgb[24, 32].any()


def test_sky_and_ground_light_a_plane_by_its_tilt() -> None:
    """Liu and Jordan: a level plane gets the whole sky, an upright one half of sky and ground."""
    scene = arena(bodies(), sun=sun(0.0, 30.0, 0.8), sky=sky(0.4))
    floor = 0.5 * (0.4 + 0.8 * math.sin(math.radians(30.0)))
    expect(see(scene, (0.0, 0.0, -2.5), DOWN), 24, 32, floor)
    expect(see(scene, (0.0, 0.0, -2.5)), 24, 32, 0.5 * (0.5 * 0.4 + 0.5 * floor))


@pytest.mark.parametrize("height", [2.0, 4.0])
@pytest.mark.parametrize("elevation", [30.0, 50.0])
@pytest.mark.parametrize("azimuth", [0.0, 90.0, 180.0, 270.0])
def test_a_boxs_shadow_ends_where_trigonometry_says(
    height: float, elevation: float, azimuth: float
) -> None:
    box = bodies((Shape.BOX, (0.0, 0.0, -height / 2), (0.5, 0.5, height / 2), 0.0))
    scene = arena(box, side=40.0, sun=sun(azimuth, elevation), sky=sky(0.0))
    k = Intrinsics.from_fov(801, 801, math.pi / 2)
    camera_height = 15.0
    seen = see(scene, (0.0, 0.0, -camera_height), DOWN, k)
    dark = (seen.seen == primitives.FLOOR) & (seen.rgb[..., 0] == 0)
    v, u = np.nonzero(dark)
    # North is up in this image, east to the right.
    north, east = (400 - v) / k.focal * camera_height, (u - 400) / k.focal * camera_height
    away = math.radians(azimuth + 180.0)
    along = north * math.cos(away) + east * math.sin(away)
    across = east * math.cos(away) - north * math.sin(away)
    pixel = camera_height / k.focal
    reach = along[np.abs(across) < 0.4].max()
    assert reach == pytest.approx(0.5 + height / math.tan(math.radians(elevation)), abs=pixel)
    assert np.abs(across).max() == pytest.approx(0.5, abs=pixel)


def test_walls_throw_shadows_onto_the_floor() -> None:
    scene = arena(bodies(), side=10.0, sun=sun(90.0, 45.0), sky=sky(0.0))
    k = Intrinsics.from_fov(401, 401, math.pi / 2)
    seen = see(scene, (0.0, 0.0, -12.0), DOWN, k)
    # 5 m high on the east edge under 45 degrees: 5 m of floor are dark.
    row = seen.rgb[200, :, 0]
    east = (np.arange(401) - 200) / k.focal * 12.0
    floor = seen.seen[200] == primitives.FLOOR
    dark = floor & (row == 0)
    assert east[dark].min() == pytest.approx(5.0, abs=12.0 / k.focal)
    assert east[dark].max() == pytest.approx(10.0, abs=12.0 / k.focal)


@pytest.mark.parametrize("extinction", [0.02, 0.1, 0.5])
def test_fog_follows_beer_and_lambert(extinction: float) -> None:
    fog = {"extinction_1_m": [extinction, extinction]}
    scene = arena(bodies(), sun=sun(180.0, 40.0), sky=sky(0.3), fog=fog)
    clear = arena(bodies(), sun=sun(180.0, 40.0), sky=sky(0.3))
    for column in (32, 60):
        along = math.hypot(1.0, (column - 32) / Intrinsics.from_fov(65, 49, math.pi / 2).focal)
        share = math.exp(-extinction * 12.0 * along)
        before = light_at(see(clear, (8.0, 0.0, -2.5)), 24, column)
        after = share * before + (1.0 - share) * 0.3
        expect(see(scene, (8.0, 0.0, -2.5)), 24, column, after)


def test_night_has_no_sun() -> None:
    scene = arena(bodies(), sun=sun(180.0, 45.0, 0.0), sky=sky(0.01))
    seen = see(scene, (0.0, 0.0, -2.5))
    assert 0 < seen.rgb.max() < 40


# --- geometry: the same as depth's, and every shadow ray


def busy(seed: int, n: int = 14) -> Obstacles:
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.4, 2.0, (n, 3))
    shape = (np.arange(n) % 3).astype(np.int8)
    half[shape == Shape.CYLINDER, 1] = half[shape == Shape.CYLINDER, 0]
    half[shape == Shape.SPHERE] = half[shape == Shape.SPHERE, :1]
    lift = np.where(shape == Shape.SPHERE, rng.uniform(0.0, 2.0, n), 0.0)
    center = np.column_stack([rng.uniform(-14, 14, (n, 2)), -half[:, 2] - lift])
    return Obstacles(shape, center, half, rng.uniform(-np.pi, np.pi, n))


def poses(seed: int, n: int) -> list[tuple[tuple[float, float, float], NDArray[np.float64]]]:
    rng = np.random.default_rng(100 + seed)
    found = []
    for _ in range(n):
        north, east, down = rng.uniform([-18, -18, -9], [18, 18, -0.3])
        roll, pitch, yaw = rng.normal(0, 0.4), rng.normal(0, 0.4), rng.uniform(-np.pi, np.pi)
        found.append(((north, east, down), quat_from_euler(roll, pitch, yaw)))
    return found


def camera_of(projection: Projection) -> Intrinsics:
    fov = {"pinhole": 1.6, "cylindrical": 2 * np.pi, "fisheye": math.radians(190.0)}
    return Intrinsics.from_fov(64, 48, fov[projection], projection)


@pytest.mark.parametrize("projection", AT_NIGHT_THE_FISHEYE)
def test_depth_is_that_of_the_depth_camera_to_the_bit(projection: Projection) -> None:
    k = camera_of(projection)
    for seed in range(3):
        scene = arena(busy(seed))
        for position, attitude in poses(seed, 12):
            centers = scene.obstacles.center
            seen = see(scene, position, attitude, k)
            depth = render(scene, centers, k, FAR, np.array(position), attitude)
            np.testing.assert_array_equal(seen.depth_m, depth)
            assert ((seen.seen == primitives.SKY) == (depth == 0)).all()


def rays_of(k: Intrinsics, attitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays (h, w, 3) NED, as `Intrinsics` defines them."""
    v, u = np.mgrid[: k.height, : k.width]
    x, y = (u - k.cx) / k.focal, (v - k.cy) / k.focal
    ahead, right = (np.cos(x), np.sin(x)) if k.model.cylindrical else (np.ones_like(x), x)
    if k.projection == "fisheye":
        ahead, right, y = np.moveaxis(np.nan_to_num(rays_of_fisheye(k)), -1, 0)
    rays: NDArray[np.float64] = np.stack([ahead, right, y], -1) @ quat_to_matrix(attitude).T
    return rays


def surface_gap(o: Obstacles, i: int, p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of points (n, 3) from the surface of an obstacle [m]."""
    q, half = p - o.center[i], o.half_size[i]
    if o.shape[i] == Shape.SPHERE:
        return np.abs(np.linalg.norm(q, axis=1) - half[0])
    if o.shape[i] == Shape.CYLINDER:
        outside = np.stack([np.hypot(q[:, 0], q[:, 1]) - half[0], np.abs(q[:, 2]) - half[2]])
        return np.abs(outside.max(axis=0))
    cos, sin = math.cos(o.yaw[i]), math.sin(o.yaw[i])
    turned = np.stack([cos * q[:, 0] + sin * q[:, 1], cos * q[:, 1] - sin * q[:, 0], q[:, 2]], 1)
    return np.abs((np.abs(turned) - half).max(axis=1))


@pytest.mark.parametrize("projection", AT_NIGHT_THE_FISHEYE)
def test_every_point_lies_on_what_the_segmentation_names(projection: Projection) -> None:
    k, named = camera_of(projection), 0
    for seed in range(3):
        scene = arena(busy(seed))
        b = scene.bounds
        for position, attitude in poses(seed, 12):
            seen = see(scene, position, attitude, k)
            if not seen.rgb.any():
                continue  # Inside an obstacle.
            points = np.array(position) + seen.depth_m[..., None] * rays_of(k, attitude)
            gaps = {
                primitives.FLOOR: np.abs(points[..., 2]),
                primitives.WALL_NORTH_SOUTH: np.abs(np.abs(points[..., 0]) - b.north_max),
                primitives.WALL_EAST_WEST: np.abs(np.abs(points[..., 1]) - b.east_max),
            }
            for number, gap in gaps.items():
                assert gap[seen.seen == number].max(initial=0.0) < 1e-3
            for i in range(len(scene.obstacles)):
                mine = points[seen.seen == primitives.OBSTACLE + i]
                named += len(mine)
                assert surface_gap(scene.obstacles, i, mine).max(initial=0.0) < 1e-3
    assert named > 5000


def hidden(o: Obstacles, i: int, p: NDArray[np.float64], s: NDArray[np.float64]) -> Any:
    """Return True for each point (n, 3) whose ray along s meets an obstacle.

    Samples the ray in float64, independent of slabs and quadratics.
    """
    steps = np.linspace(0.01, 40.0, 4000)
    inside = np.zeros(len(p), bool)
    for part in np.array_split(steps, 20):
        way = p[:, None] + part[:, None] * s
        q, half = way - o.center[i], o.half_size[i]
        if o.shape[i] == Shape.SPHERE:
            within = np.linalg.norm(q, axis=-1) < half[0]
        elif o.shape[i] == Shape.CYLINDER:
            within = (np.hypot(q[..., 0], q[..., 1]) < half[0]) & (np.abs(q[..., 2]) < half[2])
        else:
            cos, sin = math.cos(o.yaw[i]), math.sin(o.yaw[i])
            a, b = cos * q[..., 0] + sin * q[..., 1], cos * q[..., 1] - sin * q[..., 0]
            within = (np.abs(a) < half[0]) & (np.abs(b) < half[1]) & (np.abs(q[..., 2]) < half[2])
        inside |= within.any(axis=1)
    return inside


@pytest.mark.parametrize("projection", AT_NIGHT_THE_FISHEYE)
def test_every_floor_point_is_dark_where_a_way_to_the_sun_is_blocked(
    projection: Projection,
) -> None:
    k, wrong, dark_points, total = camera_of(projection), 0, 0, 0
    for seed, (azimuth, elevation) in enumerate([(40.0, 35.0), (200.0, 60.0), (300.0, 20.0)]):
        scene = arena(busy(seed), sun=sun(azimuth, elevation), sky=sky(0.0))
        to_sun, b = scene.look.light.to_sun, scene.bounds
        for position, attitude in poses(seed, 2):
            seen = see(scene, position, attitude, k)
            floor = seen.seen == primitives.FLOOR
            # Every fifth: all of them take half a minute.
            p = (np.array(position) + seen.depth_m[..., None] * rays_of(k, attitude))[floor][::5]
            # Where the way leaves the walls, seen from above, and how high it is there.
            edge = np.where(to_sun[:2] > 0, b.north_max, b.north_min)
            run = ((edge - p[:, :2]) / to_sun[:2]).min(axis=1)
            blocked = run * -to_sun[2] < b.height
            for i in range(len(scene.obstacles)):
                blocked |= hidden(scene.obstacles, i, p, to_sun)
            found = seen.rgb[floor][::5, 0] == 0
            wrong += int((blocked != found).sum())
            dark_points, total = dark_points + int(found.sum()), total + len(p)
    assert dark_points > 200
    # Ways are sampled every centimetre: grazing ones miss a corner.
    assert wrong < 0.002 * total


def test_a_cylinder_sees_on_its_axis_what_a_pinhole_sees() -> None:
    scene = replace(arena(busy(1)), appearance=DEFAULT_APPEARANCE)
    pinhole = Intrinsics(65, 49, 40.0, 32.0, 24.0)
    cylinder = Intrinsics(65, 49, 40.0, 32.0, 24.0, "cylindrical")
    for position, attitude in poses(1, 10):
        a, b = (
            see(scene, position, attitude, k).rgb[:, 32].astype(int) for k in (pinhole, cylinder)
        )
        assert (np.abs(a.astype(int) - b).max(axis=1) <= 1).mean() > 0.95


def test_inside_an_obstacle_everything_is_black() -> None:
    scene = arena(bodies((Shape.SPHERE, (0, 0, -2), (1, 1, 1), 0)))
    seen = see(scene, (0.0, 0.0, -2.0))
    assert not seen.rgb.any()
    assert (seen.seen == primitives.OBSTACLE).all()


# --- textures and colours


def with_floor(scene: Arena, texture: str, size_m: float) -> Arena:
    """The scene with a black and white texture that begins in the start."""
    finish = scene.look.finish
    texture_, albedo, size, offset = (
        np.array(getattr(finish, name)) for name in ("texture", "albedo", "size_m", "offset")
    )
    texture_[FLOOR], size[FLOOR], offset[FLOOR] = TEXTURES.index(texture), size_m, 0.0
    albedo[FLOOR] = [[0.0] * 3, [1.0] * 3]
    scene.__dict__["look"] = replace(
        scene.look,
        finish=replace(finish, texture=texture_, albedo=albedo, size_m=size, offset=offset),
    )
    return scene


def test_checks_lie_where_they_should() -> None:
    scene = with_floor(arena(bodies(), sun=sun(0.0, 90.0, 0.5), sky=sky(0.0)), "checker", 1.0)
    k = Intrinsics.from_fov(201, 201, math.pi / 2)
    seen = see(scene, (0.37, 0.21, -4.0), DOWN, k)
    v, u = np.mgrid[:201, :201]
    north, east = 0.37 + (100 - v) / k.focal * 4.0, 0.21 + (u - 100) / k.focal * 4.0
    checks = np.floor(-north) + np.floor(east)
    floor = seen.seen == primitives.FLOOR
    found = seen.rgb[..., 0] > 0
    assert (found == (checks % 2 == 1))[floor].mean() > 0.97  # Edges of checks.


def test_far_textures_fade_into_their_mean() -> None:
    """Mip maps: half black and half white is grey, not a moiré."""
    scene = with_floor(
        arena(bodies(), side=200.0, sun=sun(0.0, 90.0, 0.5), sky=sky(0.0)), "checker", 0.05
    )
    seen = see(scene, (0.0, 0.0, -4.0))
    far = (seen.seen == primitives.FLOOR) & (seen.depth_m > 60.0)
    assert far.sum() > 100
    codes = seen.rgb[far].astype(int)
    assert np.abs(codes - 255.0 * float(srgb_of(np.array(0.25)))).max() < 2


@pytest.mark.parametrize("name", TEXTURES[1:])
def test_patterns_repeat_without_a_seam(name: str) -> None:
    """Across the seam a pattern changes as much as anywhere else."""
    p = pattern(name)
    assert p.min() == 0.0
    assert p.max() <= 1.0
    for axis in (0, 1):
        jumps = np.abs(np.diff(np.concatenate([p, p.take([0], axis)], axis), axis=axis))
        per_line = jumps.mean(axis=1 - axis)
        assert per_line[-1] <= per_line[:-1].max() + 1e-12
    assert PERIOD[name] >= 1.0


@pytest.mark.nightly
def test_every_level_of_the_atlas_has_the_same_mean() -> None:
    for number, name in enumerate(TEXTURES):
        n = SIDE
        while n:
            begin = number * 2 * SIDE * SIDE + n * n
            level = atlas()[begin : begin + n * n]
            assert level.mean() == pytest.approx(pattern(name).mean(), abs=1e-5)
            n //= 2


def test_the_wall_colour_reaches_the_sensor() -> None:
    spec = load_profile("arenas", "no-obstacles", ArenaSpec)
    red, blue = (
        generate(spec.model_copy(update={"wall_colour": colour}), 0, name="x", vehicle_width_m=0.5)
        for colour in ((153, 0, 0), (0, 0, 153))
    )
    codes = [see(each, (20.0, 0.0, -2.5)).rgb[24, 32].astype(int) for each in (red, blue)]
    assert codes[0][0] > 40
    assert codes[0][2] == 0
    assert codes[1][2] > 40
    assert codes[1][0] == 0


def test_grey_is_the_luma_of_pillow() -> None:
    image = pytest.importorskip("PIL.Image")
    rgb = np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8)
    theirs = np.asarray(image.fromarray(rgb).convert("L")).astype(int)
    assert np.abs(grey(rgb).astype(int) - theirs).max() <= 1


def test_same_arena_same_image() -> None:
    scene = replace(arena(busy(0)), appearance=DEFAULT_APPEARANCE)
    a, b = (see(replace(scene), (0.0, 0.0, -8.0)).rgb for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert len(np.unique(a.reshape(-1, 3), axis=0)) > 200
    assert OBSTACLE + len(scene.obstacles) == len(scene.look.finish.texture)


@pytest.mark.parametrize(("width", "height"), [(8, 6), (9, 7), (10, 9), (11, 8)])
def test_packed_pixels_are_unpacked_whatever_their_number(width: int, height: int) -> None:
    """Words of four pixels, and an incomplete last word, against numpy's bytes."""
    colours = np.random.default_rng(width).integers(0, 1 << 24, width * height, dtype=np.int32)
    rgb = np.zeros((height, width, 3), np.uint8)
    unpack(rgb, colours, False)
    expected = (colours[:, None] >> np.array([0, 8, 16])) & 255
    np.testing.assert_array_equal(rgb.reshape(-1, 3), expected)

"""Textures from files: placement, comparison with Mitsuba, and rejected files."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pydantic import TypeAdapter

from airl_mav.addons.colour.appearance import OBSTACLE, TEXTURES, linear_of
from airl_mav.addons.colour.batch import Looks
from airl_mav.addons.colour.picture import ColourArrays, antialiased, render_picture
from airl_mav.addons.colour.profile import ImageFile
from airl_mav.addons.colour.textures import SIDE, STRIDE, atlas, texels_of
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.primitives import FLOOR
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile, profile_digest

PROFILE = """
base = "dense-obstacles"
description = "posters"

[appearance.floor]
materials = ["poster"]
[appearance.static]
materials = ["poster"]
brightness = [1.0, 1.0]
tint = 0.0
[appearance.sun]
irradiance = [0.6, 0.6]
azimuth_deg = [200, 200]
elevation_deg = [42, 42]
[appearance.sky]
irradiance = [0.4, 0.4]
zenith = [200, 200, 200]
horizon = [200, 200, 200]

[appearance.materials.poster]
albedo = [255, 255, 255]
size_m = 2.0
[appearance.materials.poster.image]
file = "poster.png"
sha256 = "DIGEST"
"""


def quarters(side: int = 256) -> NDArray[np.uint8]:
    """Red, green, blue and white in the quarters of a picture, top left first."""
    picture = np.empty((side, side, 3), np.uint8)
    half = side // 2
    picture[:half, :half], picture[:half, half:] = (200, 30, 20), (30, 160, 40)
    picture[half:, :half], picture[half:, half:] = (20, 60, 190), (220, 220, 220)
    return picture


def written(
    folder: Path, pixels: NDArray[np.uint8] | None = None, name: str = "poster.png"
) -> Path:
    Image.fromarray(quarters() if pixels is None else pixels).save(folder / name)
    return folder / name


def profile(folder: Path, image: Path) -> Path:
    digest = hashlib.sha256(image.read_bytes()).hexdigest()
    path = folder / "posters.toml"
    path.write_text(PROFILE.replace("poster.png", image.name).replace("DIGEST", digest))
    return path


def loaded(path: Path) -> ArenaSpec:
    return load_profile("arenas", str(path), ArenaSpec)


@pytest.fixture
def arena(tmp_path: Path) -> Arena:
    spec = loaded(profile(tmp_path, written(tmp_path)))
    return generate(spec, 3, name="posters", vehicle_width_m=0.55)


def named(path: Path) -> ImageFile:
    return ImageFile(file=str(path), sha256=hashlib.sha256(path.read_bytes()).hexdigest())


def test_the_floor_shows_the_picture_where_it_lies(arena: Arena) -> None:
    """Independently computed picture position of every floor pixel, seen from above."""
    camera = Intrinsics.from_fov(64, 64, 1.2)
    down = quat_from_euler(0.0, -np.pi / 2, 0.0)
    place, checked = np.array([12.0, 0.0, -2.4]), 0  # Beyond the shadow of the south wall.
    seen = render_picture(arena, arena.centers_at(0), camera, place, down)
    v, u = np.mgrid[:64, :64]
    # Looking down, north at the top: right is east, the image's down is south.
    east = 2.4 * (u - camera.cx) / camera.focal
    north = 12.0 - 2.4 * (v - camera.cy) / camera.focal
    begin = arena.look.finish.offset[0]
    across, along = (east / 2.0 + begin[0]) % 1.0, (-north / 2.0 + begin[1]) % 1.0
    kind = (along >= 0.5).astype(int) * 2 + (across >= 0.5)
    near = np.minimum(np.abs(across % 0.5 - 0.25), np.abs(along % 0.5 - 0.25)) < 0.22
    colours = linear_of(np.array([(200, 30, 20), (30, 160, 40), (20, 60, 190), (220,) * 3]) / 255.0)
    light = arena.look.light
    for which in range(4):
        lit = colours[which] * (light.sky - light.to_sun[2] * light.sun)
        wanted = 255.0 * np.where(lit > 0.0031308, 1.055 * lit ** (1 / 2.4) - 0.055, 12.92 * lit)
        for pixel in np.argwhere((kind == which) & near & (seen.seen == FLOOR)):
            off = np.abs(seen.rgb[tuple(pixel)] - wanted).max()
            in_shadow = seen.rgb[tuple(pixel)].sum() < 0.9 * wanted.sum()
            assert off <= 1.0 or in_shadow
            checked += off <= 1.0
    assert checked > 800


def test_images_are_those_of_mitsuba(arena: Arena) -> None:
    from tests.support.mitsuba_scene import path_traced

    camera, attitude = Intrinsics.from_fov(96, 64, 1.5), quat_from_euler(0.03, -0.08, 0.3)
    place, centers = np.array([6.0, -6.0, -3.0]), arena.centers_at(0)
    ours = antialiased(arena, centers, camera, place, attitude, 4).astype(float)
    theirs = path_traced(arena, centers, camera, place, attitude, samples=48)
    assert np.abs(ours - theirs).mean() / 255.0 < 0.03
    # Red and blue the other way round are far off: the limit can fail.
    assert np.abs(ours[..., ::-1] - theirs).mean() / 255.0 > 0.05


def test_levels_are_means_of_light(tmp_path: Path) -> None:
    """Texels are block means of the picture in linear light, not of pixel values."""
    rng = np.random.default_rng(4)
    pixels = rng.integers(0, 256, (512, 512, 3)).astype(np.uint8)
    file = named(written(tmp_path, pixels))
    light = linear_of(pixels / 255.0)
    blocks = light.reshape(SIDE, 4, SIDE, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(texels_of(file, SIDE), blocks, atol=1e-5)
    made = atlas((file,))
    assert len(made) == (len(TEXTURES) + 3) * STRIDE
    np.testing.assert_array_equal(made[: len(TEXTURES) * STRIDE], atlas())
    for channel in range(3):
        last = made[(len(TEXTURES) + channel) * STRIDE + 1]
        assert last == pytest.approx(light[..., channel].mean(), abs=1e-5)


def test_a_small_picture_and_a_jpeg_are_read(tmp_path: Path) -> None:
    grey = np.full((4, 4), 128, np.uint8)
    small = texels_of(named(written(tmp_path, grey, "grey.png")), SIDE)
    np.testing.assert_allclose(small, linear_of(np.array(128 / 255.0)), atol=1e-6)
    jpeg = texels_of(named(written(tmp_path, quarters(), "poster.jpg")), SIDE)
    np.testing.assert_allclose(jpeg[5, 5], linear_of(np.array([200, 30, 20]) / 255.0), atol=0.03)


def test_a_look_says_which_surfaces_have_it(arena: Arena) -> None:
    finish = arena.look.finish
    assert finish.texture[0] == finish.texture[OBSTACLE] == len(TEXTURES)
    arrays = ColourArrays.of(arena.look)
    np.testing.assert_allclose(arrays.per_m[OBSTACLE:], 0.5)
    shown = TypeAdapter(Arena).validate_json(TypeAdapter(Arena).dump_json(arena))
    assert shown.look.finish.images == finish.images


def test_moved_with_its_profile_it_is_the_same_arena(tmp_path: Path) -> None:
    here, there = tmp_path / "a", tmp_path / "b"
    for folder in (here, there):
        folder.mkdir()
        profile(folder, written(folder))
    one, other = loaded(here / "posters.toml"), loaded(there / "posters.toml")
    assert profile_digest(one) == profile_digest(other)
    changed = profile(there, written(there, quarters()[::-1]))
    assert profile_digest(loaded(changed)) != profile_digest(one)


def test_arenas_side_by_side_have_the_same_images(arena: Arena, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    spec = loaded(profile(folder, written(folder, quarters()[::-1])))
    looks = Looks(2)
    looks.put(0, arena)
    with pytest.raises(UsageError, match="the same images in all arenas"):
        looks.put(1, generate(spec, 1, name="other", vehicle_width_m=0.55))


# --- rejected files


def test_one_that_is_gone_or_has_changed_is_told_in_one_line(tmp_path: Path) -> None:
    image = written(tmp_path)
    path = profile(tmp_path, image)
    written(tmp_path, quarters()[::-1].copy())
    with pytest.raises(UsageError, match=r"posters.toml: appearance.materials: .*: changed since"):
        loaded(path)
    image.unlink()
    with pytest.raises(UsageError, match=r"appearance.materials: .*poster.png: No such file"):
        loaded(path)
    image.mkdir()
    with pytest.raises(UsageError, match=r"poster.png: Is a directory"):
        loaded(path)


def broken(folder: Path, what: str) -> Path:
    path = folder / "bad.png"
    if what == "text":
        path.write_text("no picture")
    elif what == "cut":
        data = written(folder).read_bytes()
        path.write_bytes(data[: len(data) // 2])
    elif what == "gif":
        Image.fromarray(quarters()).save(path, format="GIF")
    elif what == "wide":
        written(folder, quarters()[:100], "bad.png")
    elif what == "huge":
        Image.new("1", (5000, 5000)).save(path)
    elif what == "clear":
        Image.fromarray(quarters()).convert("RGBA").save(path)
    elif what == "deep":
        Image.fromarray(np.zeros((8, 8), np.uint16)).save(path)
    else:  # The header of a picture far larger than memory.
        header = bytearray(_png(1))
        header[16:24] = (2_000_000).to_bytes(4, "big") * 2
        path.write_bytes(bytes(header))
    return path


def _png(side: int) -> bytes:
    held = io.BytesIO()
    Image.new("L", (side, side)).save(held, format="PNG")
    return held.getvalue()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("text", "no PNG or JPEG that can be read"),
        ("cut", "no PNG or JPEG that can be read"),
        ("gif", "no PNG or JPEG that can be read"),
        ("bomb", "no PNG or JPEG that can be read"),
        ("wide", "256 x 100 px; accepted: as wide as high, 2 to 4096 px"),
        ("huge", "5000 x 5000 px; accepted: as wide as high"),
        ("clear", "of mode RGBA; accepted: 8 bits a channel, without transparency"),
        ("deep", "of mode I;16; accepted: 8 bits a channel"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, what: str, message: str) -> None:
    with pytest.raises(UsageError) as refused:
        texels_of(named(broken(tmp_path, what)), SIDE)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"texture": "brick"}, "texture = 'brick': accepted: none with an image"),
        ({"albedo_2": [1, 2, 3]}, "albedo_2 = [1, 2, 3]: accepted: none with an image"),
    ],
)
def test_an_image_and_a_pattern_do_not_go_together(more: dict[str, Any], message: str) -> None:
    image = {"file": "poster.png", "sha256": "0" * 64}
    material = {"albedo": [255, 255, 255], "image": image} | more
    with pytest.raises(ValueError, match="accepted: none with an image") as refused:
        ArenaSpec.model_validate(
            {"description": "x", "appearance": {"materials": {"poster": material}}}
        )
    assert message in str(refused.value)

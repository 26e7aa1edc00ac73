"""The eleven knobs of the paper's environment generator: each changes geometry or pixels.

Source: Krishnan et al., arXiv 1906.00421, the table of configurations of the environment generator.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from airl_mav.addons.colour.picture import render_picture
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile

LOOK = {"static": {"materials": ["plaster"]}}
KNOBS: dict[str, tuple[dict[str, Any], bool]] = {
    "arena size": ({"size": {"north_m": 40, "east_m": 50, "height_m": 6}}, True),
    "wall colours": ({"wall_colour": [0, 90, 160]}, False),
    "asset": ({"static": {"count": [8, 8], "shapes": ["tree", "pylon"]}}, True),
    "static obstacles": ({"static": {"count": [9, 9], "shapes": ["box"]}}, True),
    "dynamic obstacles": ({"moving": {"count": [4, 4]}}, True),
    "minimum distance": ({"min_clearance_m": 4.0}, True),
    "goal position": ({"goal": {"north_m": 20.0, "east_m": 5.0}}, True),
    "velocity": ({"moving": {"count": [3, 3], "speed_m_s": [4.0, 5.0]}}, True),
    "materials": ({"appearance": {"static": {"materials": ["concrete"]}}}, False),
    "textures": (
        {
            "appearance": {
                **LOOK,
                "materials": {
                    "plaster": {
                        "albedo": [222, 214, 196],
                        "albedo_2": [40, 40, 40],
                        "texture": "checker",
                    }
                },
            }
        },
        False,
    ),
}


def arena(seed: int = 5, **knobs: Any) -> Arena:
    """An arena of eight standing and three moving boxes, with one knob turned."""
    data = load_profile("arenas", "static-obstacles", ArenaSpec).model_dump()
    data["static"] |= {"count": [8, 8], "shapes": ["box"]}
    data["moving"] |= {"count": [3, 3], "speed_m_s": [1.0, 2.0]}
    data["count_period"], data["appearance"] = 1, LOOK
    for knob, value in knobs.items():
        data[knob] = data[knob] | value if isinstance(value, dict) else value
    spec = ArenaSpec.model_validate(data)
    return generate(spec, seed, name="knobs", vehicle_width_m=1.0)


def geometry(of: Arena) -> list[np.ndarray]:
    o = of.obstacles
    tours = [array for tour in of.tours for array in (tour.times_s, tour.points)]
    return [of.bounds.as_array(), of.goal, o.shape, o.center, o.half_size, o.yaw, *tours]


def pixels(of: Arena) -> np.ndarray:
    k = Intrinsics(64, 48, 32.0, 31.5, 23.5)
    place, north = (0.0, 0.0, -2.5), (1.0, 0.0, 0.0, 0.0)
    return render_picture(of, of.centers_at(4_000_000), k, place, north).rgb


def same(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return len(one) == len(other) and all(map(np.array_equal, one, other))


def test_without_a_knob_nothing_changes() -> None:
    assert same(geometry(arena()), geometry(arena()))
    np.testing.assert_array_equal(pixels(arena()), pixels(arena()))


@pytest.mark.parametrize("knob", KNOBS)
def test_each_knob_changes_geometry_or_pixels(knob: str) -> None:
    knobs, of_geometry = KNOBS[knob]
    before, after = arena(), arena(**knobs)
    assert same(geometry(before), geometry(after)) is not of_geometry
    if not of_geometry:
        assert np.any(pixels(before) != pixels(after))


def test_the_eleventh_knob_is_the_seed() -> None:
    assert len(KNOBS) == 10
    assert not same(geometry(arena(seed=5)), geometry(arena(seed=6)))

"""Arena profiles: the shipped ones are the paper's, a wrong one gets one clear line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from airl_mav.core.errors import UsageError
from airl_mav.core.fields import range_of, unit_of
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile

NO_NUMBERS = (
    *("description", "shapes", "generator", "options", "materials", "assets"),
    "ceiling",
)


def load(text: str, folder: Path) -> ArenaSpec:
    path = folder / "mine.toml"
    path.write_text('description = "mine"\n' + text, encoding="utf-8")
    return load_profile("arenas", str(path), ArenaSpec)


def test_shipped_arenas_are_the_papers() -> None:
    none, static, dynamic = (
        load_profile("arenas", f"{name}-obstacles", ArenaSpec)
        for name in ("no", "static", "dynamic")
    )
    for spec in (none, static, dynamic):
        assert (spec.size.north_m, spec.size.east_m, spec.size.height_m) == (50, 50, 5)
        assert spec.wall_colour == (153, 0, 0)
        assert spec.zones_m == (16, 32, 48)
        assert spec.min_clearance_m == 2
        # Near the middle of the south edge: every zone has floor in it.
        assert (spec.start.north_m, spec.start.east_m) == (3, 25)
    assert (none.static.count, none.moving.count) == ((0, 0), (0, 0))
    assert (static.static.count, static.moving.count) == ((5, 10), (0, 0))
    assert static.count_period == 4
    assert (dynamic.static.count, dynamic.moving.count) == ((5, 5), (1, 5))
    assert dynamic.moving.speed_m_s == (1, 2.5)
    assert dynamic.moving.leg_max_m == 30
    assert dynamic.moving.dwell_s == 0.2


def test_defaults_make_a_spec(tmp_path: Path) -> None:
    spec = load("", tmp_path)
    assert spec == load_profile("arenas", "no-obstacles", ArenaSpec).model_copy(
        update={"description": "mine"}
    )


def fields(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, FieldInfo]]:
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from fields(inner, f"{path}{name}.")
        else:
            yield path + name, field


def test_every_number_has_meaning_unit_and_range() -> None:
    seen = dict(fields(ArenaSpec))
    assert len(seen) > 25
    for path, field in seen.items():
        assert field.description, path
        if path.rsplit(".", 1)[-1] in {*NO_NUMBERS}:
            continue
        assert unit_of(field) is not None, path
        assert "<= value" in range_of(field), path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[static]\ncount = [5, 1000]", "static.count = [5, 1000]: accepted: 0 <= value <= 200"),
        ("[static]\ncount = [9, 5]", "static.count: [9, 5]; accepted: numbers in ascending order"),
        ("[static]\ncount = 5", "static.count: 5; accepted: a list of 2 numbers"),
        ("[static]\ncount = [1, 2, 3]", "static.count: [1, 2, 3]; accepted: a list of 2 numbers"),
        ("[static]\ncount = [1.5, 2]", "static.count.0 = 1.5: accepted: 0 <= value <= 200"),
        (
            "[static]\nhalf_width_m = [0.01, 1]",
            "static.half_width_m = [0.01, 1]: accepted: 0.1 <= value <= 20 m",
        ),
        (
            "[static]\nhalf_width_m = ['wide', 1]",
            "static.half_width_m.0 = 'wide': accepted: 0.1 <= value <= 20 m",
        ),
        (
            "[static]\nhalf_width_m = [nan, 1]",
            "static.half_width_m.0 = nan: accepted: 0.1 <= value",
        ),
        (
            "[static]\nshapes = ['cone']",
            "static.shapes.0 = 'cone': accepted: box, cylinder, sphere, tree",
        ),
        ("[static]\nshapes = []", "static.shapes = []: accepted: "),
        (
            "[static]\ncount = [1, 1]\nheight_m = [3, 6]",
            "static.height_m = [3.0, 6.0]: accepted: value <= 5 m (size.height_m, the walls)",
        ),
        (
            "[moving]\ncount = [1, 1]\nhalf_width_m = [1, 3]",
            "moving.half_width_m = [1.0, 3.0]: a sphere across flight_altitude_m 2.5 would reach "
            "up to 7 m; accepted: a top <= 5 m",
        ),
        (
            "[moving]\nspeed_m_s = [1, 25]",
            "moving.speed_m_s = [1, 25]: accepted: 0.1 <= value <= 15 m/s",
        ),
        ("[moving]\nvelocity = [1, 2]", "moving.velocity: unknown field; fields: count, shapes"),
        ("[moving]\nspeed = [1, 2]", "moving.speed: unknown field; did you mean 'speed_m_s'?"),
        ("[size]\nnorth_m = 0", "size.north_m = 0: accepted: 5 <= value <= 500 m"),
        (
            "[start]\nnorth_m = 1",
            "start.north_m = 1: accepted: 3 <= value <= 47 m (size.north_m 50",
        ),
        ("[goal]\nnorth_m = 10", "goal: east_m: missing; a fixed goal needs north_m and east_m"),
        (
            "[goal]\nnorth_m = 10\neast_m = 30",
            "goal.east_m = 30: accepted: -23 <= value <= 23 m from the start",
        ),
        ("[goal]\nmin_distance_m = 16", "goal.min_distance_m = 16: accepted: value < 16 m"),
        ("wall_colour = [153, 0, 256]", "wall_colour = [153, 0, 256]: accepted: 0 <= value <= 255"),
        ("zones_m = []", "zones_m: []; accepted: a list of one or more numbers"),
        ("zones_m = [32, 16]", "zones_m: [32.0, 16.0]; accepted: numbers in ascending order"),
        ("count_period = 0", "count_period = 0: accepted: 1 <= value <= 10000"),
        ("default_seed = -1", "default_seed = -1: accepted: 0 <= value <= 999999"),
        ("min_clearence_m = 1", "min_clearence_m: unknown field; did you mean 'min_clearance_m'?"),
        ("wall_colour = [1, 2", "not valid TOML: "),
        (
            "[appearance.sun]\nelevation_deg = [0, 30]",
            "appearance.sun.elevation_deg = [0, 30]: accepted: 1 <= value <= 90 deg",
        ),
        (
            "[appearance.fog]\nextinction_1_m = [0.2, 0.1]",
            "appearance.fog.extinction_1_m: [0.2, 0.1]; accepted: numbers in ascending order",
        ),
        (
            "[appearance.static]\nmaterials = ['brik']",
            "appearance: static.materials = 'brik': accepted: plaster, concrete, gravel",
        ),
        ("[appearance.static]\ntint = 2", "appearance.static.tint = 2: accepted: 0 <= value <= 1"),
        (
            "[appearance.materials.mine]\nalbedo = [1, 2, 300]",
            "appearance.materials.mine.albedo = [1, 2, 300]: accepted: 0 <= value <= 255",
        ),
        (
            "[appearance.materials.mine]\nalbedo = [1, 2, 3]\ntexture = 'stripes'",
            "appearance.materials.mine.texture = 'stripes': accepted: 'plain'",
        ),
        (
            "[appearance.materials.wall_colour]\nalbedo = [1, 2, 3]",
            "appearance: materials.wall_colour: this name stands for the arena's own field",
        ),
        ("[appearance]\nperiod = 0", "appearance.period = 0: accepted: 1 <= value <= 10000"),
    ],
)
def test_wrong_fields_get_one_clear_line(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        load(text, tmp_path)
    line = str(caught.value)
    assert line.startswith(f"{tmp_path / 'mine.toml'}: ")
    assert message in line
    assert "\n" not in line


def test_missing_description_is_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("")
    with pytest.raises(UsageError, match="description: missing"):
        load_profile("arenas", str(path), ArenaSpec)


def test_oversized_kinds_that_are_not_drawn_are_no_matter(tmp_path: Path) -> None:
    """Heights over the walls matter only for obstacles that there are, of shapes that stand."""
    load("[static]\nheight_m = [3, 20]", tmp_path)
    load("[static]\ncount = [1, 1]\nshapes = ['sphere']\nheight_m = [3, 20]", tmp_path)
    load("[static]\ncount = [1, 1]\nshapes = ['box']\nhalf_width_m = [1, 9]", tmp_path)

"""Meshes as assets of boxes: they cover the mesh, and little else. trimesh is the reference."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from airl_mav.addons.meshes.mesh_boxes import MeshBoxes, boxes_of_mesh, joined
from airl_mav.arena.generate import generate
from airl_mav.arena.triangles import standing
from airl_mav.cli.main import main
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.assets import BoxPart
from airl_mav.profiles.loading import load_profile, profile_digest

SAMPLES = 20_000


def export(mesh: trimesh.Trimesh, path: Path) -> Path:
    mesh.export(path)
    return path


def limits(made: MeshBoxes) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corners of the boxes (n, 3): forward, right, up."""
    boxes = [part for part in made.asset.parts if isinstance(part, BoxPart)]
    assert len(boxes) == len(made.asset.parts)
    half = np.array([box.half_size_m for box in boxes])
    middle = np.array([(b.forward_m, b.right_m, b.bottom_m) for b in boxes])
    middle[:, 2] += half[:, 2]
    return middle - half, middle + half


def held(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return True for each point (m, 3) in any box."""
    # Parts are written to a tenth of a millimetre.
    inside = (points[:, None] >= low - 1e-4) & (points[:, None] <= high + 1e-4)
    found: np.ndarray = np.any(np.asarray(np.all(inside, axis=2)), axis=1)
    return found


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=0.8)


def pipe() -> trimesh.Trimesh:
    return trimesh.creation.annulus(0.4, 0.6, 2.0)


def bracket() -> trimesh.Trimesh:
    """Return an L of two boxes."""
    foot = trimesh.creation.box((1.2, 0.4, 0.2))
    post = trimesh.creation.box((0.2, 0.4, 1.5))
    post.apply_translation((-0.5, 0.0, 0.85))
    both = trimesh.util.concatenate([foot, post])
    assert isinstance(both, trimesh.Trimesh)
    return both


def bowl() -> trimesh.Trimesh:
    """Return the lower half of the ball's surface, without an inside."""
    whole = ball()
    below = whole.triangles_center[:, 2] < 0.0
    return trimesh.Trimesh(whole.vertices, whole.faces[below])


def in_ball(points: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(points, axis=1) < 0.8)


def in_pipe(points: np.ndarray) -> np.ndarray:
    radius = np.hypot(points[:, 0], points[:, 1])
    return (radius > 0.4) & (radius < 0.6) & (np.abs(points[:, 2]) < 1.0)


def in_bracket(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    foot = (np.abs(x) < 0.6) & (np.abs(z) < 0.1)
    post = (np.abs(x + 0.5) < 0.1) & (z > 0.0) & (z < 1.6)
    return (np.abs(y) < 0.2) & (foot | post)


Inside = Callable[[np.ndarray], np.ndarray]
MESHES: dict[str, tuple[trimesh.Trimesh, Inside]] = {
    "ball": (ball(), in_ball),
    "pipe": (pipe(), in_pipe),
    "bracket": (bracket(), in_bracket),
}
"""Meshes, each with its interior in closed form."""


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("most", [8, pytest.param(64, marks=pytest.mark.nightly)])
def test_boxes_cover_the_mesh_and_reach_no_further_than_is_told(
    name: str, most: int, tmp_path: Path
) -> None:
    own, inside = MESHES[name]
    mesh = own.copy()
    mesh.apply_translation((3.0, -2.0, 7.0))
    made = boxes_of_mesh(export(mesh, tmp_path / f"{name}.stl"), most=most)
    assert 1 <= len(made.asset.parts) <= most
    low, high = limits(made)
    # On its place: the middle of the footprint above (0, 0), its lowest point on the floor; the
    # mesh's y points left, the asset's to the right.
    bounds = np.asarray(own.bounds)
    place, mirror = np.array([*bounds.mean(axis=0)[:2], bounds[0, 2]]), np.array([1.0, -1.0, 1.0])
    points = np.asarray(trimesh.sample.sample_surface(own, SAMPLES, seed=1)[0])
    assert held((points - place) * mirror, low, high).all()
    # Every corner of a box is near the surface, or inside the closed mesh.
    masks = product((True, False), repeat=3)
    corners = np.concatenate([np.where(mask, low, high) for mask in masks]) * mirror + place
    away_m = np.asarray(cKDTree(points).query(corners)[0])
    spacing_m = 3.0 * np.sqrt(own.area / SAMPLES)
    assert away_m[~inside(corners)].max() <= made.beyond_m + spacing_m


def test_more_boxes_fit_better(tmp_path: Path) -> None:
    path = export(ball(), tmp_path / "ball.stl")
    cells = [boxes_of_mesh(path, most=most).cell_m for most in (4, 16, 64)]
    assert cells == sorted(cells, reverse=True)
    assert cells[-1] < 0.5 * cells[0]


def test_what_is_closed_is_filled_and_what_is_open_is_not(tmp_path: Path) -> None:
    filled = boxes_of_mesh(export(ball(), tmp_path / "ball.stl"))
    open_ = boxes_of_mesh(export(bowl(), tmp_path / "bowl.stl"))
    assert (filled.closed, open_.closed) == (True, False)
    middle = np.array([[0.0, 0.0, 0.8]])
    assert held(middle, *limits(filled)).all()
    assert not held(np.array([[0.0, 0.0, 0.7]]), *limits(open_)).any()


def test_y_points_up_in_glb_and_z_in_all_others(tmp_path: Path) -> None:
    post = trimesh.creation.box((0.2, 0.4, 3.0))
    glb, stl = export(post, tmp_path / "post.glb"), export(post, tmp_path / "post.stl")
    assert boxes_of_mesh(stl).size_m == pytest.approx((0.2, 0.4, 3.0))
    assert boxes_of_mesh(stl, up="y").size_m == pytest.approx((0.2, 3.0, 0.4))
    assert boxes_of_mesh(glb).size_m == pytest.approx((0.2, 3.0, 0.4))
    assert boxes_of_mesh(glb, up="z").size_m == pytest.approx((0.2, 0.4, 3.0))
    assert boxes_of_mesh(stl, scale=0.1).size_m == pytest.approx((0.02, 0.04, 0.3))


@given(st.integers(0, 2**27 - 1))
def test_joined_boxes_are_exactly_the_cells(bits: int) -> None:
    cells = np.array([bits >> i & 1 for i in range(27)], np.bool_).reshape(3, 3, 3)
    boxes = joined(cells, 27)
    assert boxes is not None
    filled = np.zeros((3, 3, 3), np.int64)
    for low, high in boxes:
        filled[tuple(map(slice, low, high))] += 1
    assert np.array_equal(filled, cells)  # None twice.
    if boxes:
        assert joined(cells, len(boxes) - 1) is None


def asset(path: Path, out: Path, *words: str) -> ArenaSpec:
    """Run `airl asset` and return the arena that it wrote."""
    with pytest.raises(SystemExit) as ended:
        main(["asset", str(path), "--out", str(out), *words])
    assert not ended.value.code
    return load_profile("arenas", str(out), ArenaSpec)


def test_cameras_see_the_mesh_in_the_place_of_its_boxes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = export(bracket(), tmp_path / "bracket.stl")
    seen = asset(path, tmp_path / "seen.toml", "--scale", "0.8")
    assert "cameras see its 24 triangles" in capsys.readouterr().out
    boxes = asset(path, tmp_path / "boxes.toml", "--scale", "0.8", "--seen", "boxes")
    assert "cameras see the boxes" in capsys.readouterr().out
    assert not (tmp_path / "boxes.npz").exists()
    arenas = [generate(spec, 3, name="x", vehicle_width_m=0.55) for spec in (seen, boxes)]
    for field in ("shape", "center", "half_size", "yaw"):
        first, second = (getattr(arena.obstacles, field) for arena in arenas)
        np.testing.assert_array_equal(first, second)
    assert not arenas[1].meshes
    assert len(arenas[0].meshes) == len(arenas[0].statics.names)  # type: ignore[union-attr]
    o = arenas[0].obstacles
    ends = 0
    for each in arenas[0].meshes:
        assert each.first == ends
        ends += each.count
        # Every corner is in a box that represents the mesh.
        places, _ = standing(each)
        own = slice(each.first, ends)
        cos, sin = np.cos(o.yaw[own]), np.sin(o.yaw[own])
        away = places[:, None] - o.center[own]
        forward = away[..., 0] * cos + away[..., 1] * sin
        right = away[..., 1] * cos - away[..., 0] * sin
        within = np.abs(np.stack([forward, right, away[..., 2]], axis=-1)) <= (
            o.half_size[own] + 1e-3
        )
        assert within.all(axis=-1).any(axis=-1).all()
    assert ends == len(o)


def test_a_mesh_that_has_changed_or_gone_is_told_in_one_line(tmp_path: Path) -> None:
    path, out = export(bracket(), tmp_path / "bracket.stl"), tmp_path / "brackets.toml"
    spec = asset(path, out)
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("brackets.toml", "brackets.npz"):
        (moved / name).write_bytes((tmp_path / name).read_bytes())
    other = load_profile("arenas", str(moved / "brackets.toml"), ArenaSpec)
    # The digest of an arena is independent of its folder.
    assert profile_digest(other) == profile_digest(spec)
    assert other.assets["bracket"].mesh != spec.assets["bracket"].mesh
    # An asset without a mesh has no such field.
    assert "mesh" not in asset(path, out, "--seen", "boxes").model_dump_json()
    data = bytearray((moved / "brackets.npz").read_bytes())
    data[200] ^= 1
    (moved / "brackets.npz").write_bytes(bytes(data))
    with pytest.raises(
        UsageError, match=r"brackets\.npz: changed since its arena was made"
    ) as told:
        load_profile("arenas", str(moved / "brackets.toml"), ArenaSpec)
    assert "\n" not in str(told.value)
    (moved / "brackets.npz").unlink()
    with pytest.raises(UsageError, match=r"brackets\.npz: No such file"):
        load_profile("arenas", str(moved / "brackets.toml"), ArenaSpec)


def test_too_many_triangles_are_refused_unless_boxes_are_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("airl_mav.addons.meshes.command.MOST_TRIANGLES", 23)
    path = export(bracket(), tmp_path / "bracket.stl")
    with pytest.raises(SystemExit) as ended:
        main(["asset", str(path), "--out", str(tmp_path / "x.toml")])
    assert ended.value.code == 2
    assert "at most 23 triangles, not 24" in capsys.readouterr().err
    assert not list(tmp_path.glob("x.*"))
    assert asset(path, tmp_path / "x.toml", "--seen", "boxes").assets["bracket"].mesh is None


def test_what_is_no_mesh_for_an_asset_gets_one_line(tmp_path: Path) -> None:
    with pytest.raises(FieldError, match=r"a file that ends in \.stl"):
        boxes_of_mesh(tmp_path / "a.step")
    with pytest.raises(UsageError, match=r"a\.stl"):
        boxes_of_mesh(tmp_path / "a.stl")
    (tmp_path / "b.obj").write_text("nothing", encoding="utf-8")
    with pytest.raises(UsageError, match=r"b\.obj"):
        boxes_of_mesh(tmp_path / "b.obj")
    large = export(trimesh.creation.box((30.0, 1.0, 1.0)), tmp_path / "large.stl")
    with pytest.raises(FieldError, match=r"at most 20 m a side, not 30 x 1 x 1 m \(see --scale\)"):
        boxes_of_mesh(large)


def test_a_damaged_mesh_that_its_reader_takes_gets_one_line(tmp_path: Path) -> None:
    flat = tmp_path / "flat.obj"
    flat.write_text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", encoding="utf-8")
    with pytest.raises(UsageError, match=r"flat\.obj: its places do not have three coordinates"):
        boxes_of_mesh(flat)
    whole = export(trimesh.creation.box(), tmp_path / "box.glb").read_bytes()
    indices = np.asarray(trimesh.creation.box().faces, np.uint32).tobytes()
    assert whole.count(indices) == 1
    far = tmp_path / "far.glb"
    far.write_bytes(whole.replace(indices, b"\xff\xff\xff\x0f" + indices[4:]))
    with pytest.raises(UsageError, match=r"far\.glb: has triangles with corners that it does not"):
        boxes_of_mesh(far)


def test_the_command_writes_an_arena_that_stands_full_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = export(bracket(), tmp_path / "My_Bracket.stl"), tmp_path / "brackets.toml"
    with pytest.raises(SystemExit) as ended:
        main(["asset", str(path), "--out", str(out)])
    assert not ended.value.code
    assert "my-bracket: " in capsys.readouterr().out
    spec = load_profile("arenas", str(out), ArenaSpec)
    arena = generate(spec, 3, name="brackets", vehicle_width_m=0.55)
    assert spec.static.shapes == ("my-bracket",)
    assert len(arena.obstacles) >= 2 * spec.static.count[0]
    for words, said in (
        (["--name", "box"], "--name box: accepted: small letters"),
        (["--out", str(tmp_path / "x.txt")], "accepted: a file name that ends in .toml"),
        (["--arena", "nowhere"], "nowhere"),
        (["--out", "/nowhere/x.toml"], "cannot write"),
    ):
        before = ["asset", str(path), *([] if "--out" in words else ["--out", str(out)])]
        with pytest.raises(SystemExit) as ended:
            main([*before, *words])
        assert ended.value.code == 2
        assert said in capsys.readouterr().err

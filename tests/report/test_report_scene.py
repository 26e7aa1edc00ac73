"""Content of the 3D views, compared with the run and its arenas."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest

from airl_mav.addons.colour.profile import Appearance
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Ground, Shape
from airl_mav.flight.judge import Outcome
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report.document import OUTCOME_LABELS
from airl_mav.report.plotly_scene import (
    POINTS,
    SceneFlight,
    body_mesh,
    flight_view,
    plotly_script,
    scene_json,
)
from tests.support.run_demo import demo_arena, write_demo_run

Demo = tuple[LoadedRun, dict[int, Arena]]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    folder, arenas = write_demo_run(
        tmp_path_factory.mktemp("scene") / "demo", episodes=3, profile="dynamic-obstacles"
    )
    return load(folder.path), arenas


def shown(demo: Demo) -> list[SceneFlight]:
    run, arenas = demo
    return [SceneFlight(e, run.trajectories[e.index], arenas[e.index]) for e in run.episodes]


def trace(view: dict[str, Any], name: str) -> dict[str, Any]:
    return dict(next(each for each in view["figure"]["data"] if each["name"] == name))


def test_every_view_is_a_figure_that_plotly_accepts(demo: Demo) -> None:
    views = json.loads(scene_json(shown(demo), 90.0))
    assert len(views) == 3
    for view in views:
        # Raises on a property, or a value, that the library does not know.
        figure = go.Figure(view["figure"])
        assert len(figure.data) == len(view["figure"]["data"]) >= 3
    assert "Plotly" in plotly_script()
    assert "</script" not in plotly_script()


def test_the_path_is_that_of_the_flight(demo: Demo) -> None:
    for flight in shown(demo):
        view = flight_view(flight, 5.0, 90.0)
        path, record = flight.path, flight.record
        places = np.array(view["path"]["place"])
        assert len(places) == len(view["path"]["time"]) <= POINTS
        # East, north, up, to a centimetre, at the same moment.
        at = np.array(view["path"]["time"]) * 1e6 + record.started_us
        for axis, sign, column in ((1, 1, 0), (0, 1, 1), (2, -1, 2)):
            true = np.interp(at, path.time_us, sign * path.position[:, axis])
            assert np.abs(places[:, column] - true).max() < 0.1
        line = trace(view, "path")
        assert [list(p) for p in zip(line["x"], line["y"], line["z"], strict=True)] == (
            view["path"]["place"]
        )
        assert max(line["line"]["color"]) <= path.speed().max() + 0.01
        goal = trace(view, "goal")
        east, north = np.array(goal["x"]), np.array(goal["y"])
        away = np.hypot(east - record.goal[1], north - record.goal[0])
        assert np.allclose(away, record.goal_radius_m, atol=0.01)
        assert view["navigation"] == 5.0


def test_nothing_can_end_the_script_element(demo: Demo, monkeypatch: pytest.MonkeyPatch) -> None:
    evil = "</script><!--<script>"
    monkeypatch.setitem(OUTCOME_LABELS, Outcome.SUCCESS, evil)
    text = scene_json(shown(demo), 0.0)
    assert "<" not in text
    assert evil in json.dumps(json.loads(text))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_body_is_closed_and_has_the_shape_size_and_place_of_its_obstacle(seed: int) -> None:
    arena = demo_arena(seed, "dense-obstacles")
    o = arena.obstacles
    assert set(o.shape) == set(Shape)
    for i in range(len(o)):
        corners, triangles = body_mesh(o, i, o.center[i])
        north, east, down = o.center[i]
        away = corners - [east, north, -down]
        assert np.abs(away[:, 2]).max() == pytest.approx(o.half_size[i, 2])
        if o.shape[i] == Shape.BOX:
            yaw, half = float(o.yaw[i]), o.half_size[i]
            along = away[:, 1] * math.cos(yaw) + away[:, 0] * math.sin(yaw)
            across = away[:, 0] * math.cos(yaw) - away[:, 1] * math.sin(yaw)
            # All corners but the middles of bottom and top.
            assert np.allclose(np.abs(along[:-2]), half[0])
            assert np.allclose(np.abs(across[:-2]), half[1])
        else:
            reach = np.linalg.norm(away[:, :2], axis=1)
            if o.shape[i] == Shape.SPHERE:
                reach = np.linalg.norm(away, axis=1)
                assert np.allclose(reach, o.half_size[i, 0])
            else:
                assert np.allclose(reach[:-2], o.half_size[i, 0])
        # Every edge belongs to two triangles.
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}


def test_the_view_has_the_triangles_of_meshes(demo: Demo, tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    from airl_mav.arena.triangles import standing
    from tests.support.meshes import kept, ring, scene_of, triangles

    arena = scene_of(kept(triangles(ring()), tmp_path / "ring.npz"), [(3.0, 2.0, 0.5, 1.5)])
    run, _ = demo
    flight = SceneFlight(run.episodes[0], run.trajectories[0], arena)
    body = trace(flight_view(flight, 5.0, 90.0), "obstacle")
    places, faces = standing(arena.meshes[0])
    drawn = np.stack([body["x"], body["y"], body["z"]], axis=1)
    np.testing.assert_allclose(drawn, places[:, [1, 0, 2]] * [1.0, 1.0, -1.0], atol=0.006)
    np.testing.assert_array_equal(np.stack([body[axis] for axis in "ijk"], axis=1), faces)


def test_the_view_shows_through_glass(demo: Demo) -> None:
    spec = load_profile("arenas", "static-obstacles", ArenaSpec)
    look = Appearance.model_validate({"static": {"materials": ["glass", "brick"]}})
    spec = spec.model_copy(update={"appearance": look})
    arena = generate(spec, 3, name="glass", vehicle_width_m=0.55)
    assert arena.clear is not None
    run, _ = demo
    flight = SceneFlight(run.episodes[0], run.trajectories[0], arena)
    view = flight_view(flight, 5.0, 90.0)
    glass, solid = trace(view, "glass"), trace(view, "obstacle")
    assert glass["opacity"] < 0.5 < solid["opacity"]
    shown = {True: glass, False: solid}
    for clear, body in shown.items():
        expected = [
            len(body_mesh(arena.obstacles, i, arena.obstacles.center[i])[0])
            for i in np.flatnonzero(arena.clear == clear).tolist()
        ]
        assert len(body["x"]) == sum(expected) > 0


def test_the_view_has_hills_and_what_lies_on_them(demo: Demo) -> None:
    spec = load_profile("arenas", "hills", ArenaSpec)
    arena = generate(spec, 3, name="hills", vehicle_width_m=0.6)
    ground = arena.ground
    assert ground is not None
    run, _ = demo
    flight = SceneFlight(run.episodes[0], run.trajectories[0], arena)
    view = flight_view(flight, 5.0, 90.0)
    body = trace(view, "ground")
    drawn = np.stack([body["x"], body["y"], body["z"]], axis=1)
    np.testing.assert_allclose(drawn, ground.points[:, [1, 0, 2]] * [1.0, 1.0, -1.0], atol=0.006)
    np.testing.assert_array_equal(np.stack([body[axis] for axis in "ijk"], axis=1), ground.faces)
    shadow = trace(view, "shadow")
    for east, north, up in zip(shadow["x"], shadow["y"], shadow["z"], strict=True):
        assert up == pytest.approx(ground.height_at(north, east) + 0.05, abs=0.02)


def test_hills_of_many_cells_are_drawn_with_fewer() -> None:
    rng = np.random.default_rng(0)
    north, east = np.arange(101), np.arange(121)
    heights = 2.0 + np.sin(north[:, None] / 15.0) + np.cos(east / 20.0) + 0.0 * rng.random()
    fine = Ground(heights, -10.0, -20.0, 0.5, 0.4)
    coarse = fine.coarser(3000)
    assert (np.array(coarse.heights.shape) - 1).prod() <= 3000
    assert fine.coarser(12_000) is fine
    np.testing.assert_allclose(coarse.points[0], fine.points[0])
    np.testing.assert_allclose(coarse.points[-1], fine.points[-1])
    for place in rng.uniform([-10.0, -20.0], [40.0, 28.0], (100, 2)):
        assert coarse.height_at(*place) == pytest.approx(fine.height_at(*place), abs=0.02)


def test_the_slider_moves_obstacles_along_their_tours(demo: Demo) -> None:
    flight = shown(demo)[0]
    arena = flight.arena
    assert arena is not None
    view = flight_view(flight, 5.0, 90.0)
    moving = view["moving"]
    mesh = view["figure"]["data"][moving["trace"]]
    assert mesh["name"] == "moving obstacle"
    assert sum(moving["corners"]) == len(mesh["x"])
    first = 0
    for k, (count, tour) in enumerate(zip(moving["corners"], moving["tours"], strict=True)):
        number = arena.n_static + k
        for now in (0.0, 3.3, 11.0):
            # As the page's script does it: corners at the beginning, and how far the tour has led.
            t = now % tour["time"][-1]
            shift = [
                np.interp(t, tour["time"], [p[axis] for p in tour["place"]]) for axis in (0, 1)
            ]
            place = arena.centers_at(int(now * 1e6))[number]
            corners, _ = body_mesh(arena.obstacles, number, place)
            here = slice(first, first + count)
            assert np.allclose(np.array(mesh["x"])[here] + shift[0], corners[:, 0], atol=0.05)
            assert np.allclose(np.array(mesh["y"])[here] + shift[1], corners[:, 1], atol=0.05)
        first += count


def test_a_flight_without_an_arena(demo: Demo) -> None:
    run, _ = demo
    view = flight_view(SceneFlight(run.episodes[0], run.trajectories[0], None), 5.0, 0.0)
    assert view["moving"] is None
    go.Figure(view["figure"])


@pytest.mark.parametrize(
    ("fov_deg", "view"), [(0.0, [0.0, 0.0]), (90.0, [6.0, 0.785]), (360.0, [6.0, 0.0])]
)
def test_edges_of_the_field_of_view_where_there_are_any(
    demo: Demo, fov_deg: float, view: list[float]
) -> None:
    run, _ = demo
    flight = SceneFlight(run.episodes[0], run.trajectories[0], None)
    assert flight_view(flight, 5.0, fov_deg)["view"] == view

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from airl_mav.arena.geometry import Arena, Shape
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report import scene
from airl_mav.report.run_figures import coloured_pieces
from airl_mav.report.scene import (
    POINTS,
    SceneFlight,
    describe_arena,
    describe_flight,
    scene_json,
)
from airl_mav.report.scene_figure import Projection, scene_figure
from tests.support.run_demo import demo_arena, demo_episode, write_demo_run


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedRun, dict[int, Arena]]:
    folder, arenas = write_demo_run(
        tmp_path_factory.mktemp("scene") / "demo", episodes=3, profile="dynamic-obstacles"
    )
    return load(folder.path), arenas


def shown(run: LoadedRun, arenas: dict[int, Arena]) -> list[SceneFlight]:
    return [SceneFlight(e, run.trajectories[e.index], arenas[e.index]) for e in run.episodes]


def test_the_data_are_the_flights_and_their_arenas(
    demo: tuple[LoadedRun, dict[int, Arena]],
) -> None:
    run, arenas = demo
    text = scene_json(run, shown(run, arenas), run.episodes, 90.0)
    data = json.loads(text)
    assert [f["index"] for f in data["flights"]] == [0, 1, 2]
    assert len(data["arenas"]) == 3
    for flight, record in zip(data["flights"], run.episodes, strict=True):
        path = run.trajectories[record.index]
        places = np.array(flight["place"]).reshape(-1, 3)
        assert len(places) == len(flight["time"]) == len(flight["speed"]) <= POINTS
        # East, north, up, to a centimetre, at the same moment.
        at = np.array(flight["time"]) * 1e6 + record.started_us
        for axis, sign, column in ((1, 1, 0), (0, 1, 1), (2, -1, 2)):
            true = np.interp(at, path.time_us, sign * path.position[:, axis])
            assert np.abs(places[:, column] - true).max() < 0.1
        assert flight["goal"] == pytest.approx(record.goal[::-1], abs=0.01)
        arena = data["arenas"][flight["arena"]]
        assert len(arena["tours"]) == len(arenas[record.index].tours)
        assert len(arena["obstacles"]) == len(arenas[record.index].obstacles)
    assert not data["shared"]
    assert [f["index"] for f in data["all"]] == [0, 1, 2]


def test_nothing_can_end_the_script_element(
    demo: tuple[LoadedRun, dict[int, Arena]], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, arenas = demo
    evil = "</script><!--<script>"
    monkeypatch.setitem(scene.OUTCOME_LABELS, Outcome.BATTERY, evil)
    text = scene_json(run, shown(run, arenas), run.episodes, 0.0)
    assert "<" not in text
    assert json.loads(text)["outcomes"]["battery"]["words"] == evil


def test_headings_and_navigation() -> None:
    record, path, _ = demo_episode(0, demo_arena(1))
    half = math.radians(60.0)
    turned = np.tile([math.cos(half), 0.0, 0.0, math.sin(half)], (len(path), 1))
    path = Trajectory(path.time_us, path.position, path.velocity, turned, path.power_w)
    data = describe_flight(record, path, 10)
    assert data["heading"] == [120] * 10
    assert data["navigation"] == 5.0
    assert data["time"][0] == pytest.approx((path.time_us[0] - record.started_us) / 1e6)


def test_obstacles_keep_shape_size_and_place() -> None:
    arena = demo_arena(3, "dense-obstacles")
    data = describe_arena(arena)
    assert {thing["shape"] for thing in data["obstacles"]} == {s.name.lower() for s in Shape}
    o = arena.obstacles
    for i, thing in enumerate(data["obstacles"]):
        east, north, up = thing["center"]
        assert [north, east, -up] == pytest.approx(o.center[i].tolist(), abs=0.006)
        assert thing["half"] == pytest.approx(o.half_size[i].tolist(), abs=0.006)


def test_the_projection_is_along_one_direction_and_true_across_it() -> None:
    view = Projection(math.radians(28.0), math.radians(34.0))
    c, s = math.cos(view.looks_rad), math.sin(view.looks_rad)
    # Down in NED: the view looks down.
    along = np.array(
        [c * math.cos(view.above_rad), s * math.cos(view.above_rad), math.sin(view.above_rad)]
    )
    rng = np.random.default_rng(1)
    points = rng.normal(size=(50, 3)) * 10.0
    assert np.allclose(view.flat(points), view.flat(points + 7.0 * along))
    across = rng.normal(size=(50, 3))
    across -= np.outer(across @ along, along)
    lengths = np.linalg.norm(view.flat(points + across) - view.flat(points), axis=1)
    assert np.allclose(lengths, np.linalg.norm(across, axis=1))
    # North is up, east is right, high is up.
    flat = view.flat(
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    )
    assert flat[1, 1] > 0.0
    assert flat[2, 0] > 0.0
    assert flat[3, 1] == pytest.approx(math.cos(view.above_rad))


def test_a_path_is_cut_where_its_colour_changes() -> None:
    points = np.stack([np.arange(11.0), np.zeros(11)], axis=1)
    values = np.array([0.1] * 4 + [4.0] * 5 + [0.1])
    pieces, levels = coloured_pieces(points, values, 5.0)
    assert [len(piece) for piece in pieces] == [5, 6, 2]
    assert pieces[0][-1].tolist() == pieces[1][0].tolist()
    assert np.abs(levels - [0.1, 4.0, 0.1]).max() < 5.0 / 24.0


def test_a_picture_without_an_arena(
    demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path
) -> None:
    run, _ = demo
    picture = scene_figure(SceneFlight(run.episodes[0], run.trajectories[0], None), 5.0)
    assert picture.name == "flight-3d"
    assert picture.png.startswith(b"\x89PNG")

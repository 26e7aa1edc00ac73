"""Architecture search: definition, evaluation and figures of a sweep."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from rich.console import Console
from scipy import stats

from airl_mav.addons.sweep.command import SweepOptions, run
from airl_mav.addons.sweep.config import SweepConfig, load_sweep, size_of, training_of, trials
from airl_mav.addons.sweep.document import document_of
from airl_mav.addons.sweep.summary import (
    Computer,
    SweepFolder,
    declaration,
    estimated_ms,
    over_seeds,
    summarize,
    write_sweep,
)
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.core.machine import provenance
from airl_mav.experiments.campaign import load_campaign, open_campaign
from airl_mav.policy.actions import ActionSpec
from airl_mav.policy.card import OnnxRuntime
from airl_mav.policy.card_writing import NetworkSize, build_template, template_size
from airl_mav.policy.layouts import boxes
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import list_profiles
from airl_mav.report.document import write_document
from airl_mav.report.heatmap import Field, HeatMap, _ink_on, colours, draw_heat_map
from airl_mav.report.theme import new_figure, render_png
from airl_mav.training.config import NetworkSpec
from tests.support.policy_kit import parameters_of
from tests.support.sweep_kit import TINY, fake_results, write_sweep_file

MADE = provenance("airl sweep")

BARE = """description = "never timed"
cpu = "none"
watts = 1.0
price_usd = 1.0
source = "a test"
"""

# --- what a sweep is


def test_the_full_sweep_is_the_papers_grid() -> None:
    # Air Learning, section V: 15 networks in each of three environments, five seeds.
    config = load_sweep("full")
    assert [grid.name for grid in config.grids] == [
        "no-obstacles",
        "static-obstacles",
        "dynamic-obstacles",
    ]
    assert [grid.layers for grid in config.grids] == [(2, 3, 4, 5, 6)] * 2 + [(5, 6, 7, 8, 9)]
    assert all(grid.filters == (32, 48, 64) for grid in config.grids)
    every = trials(config)
    assert len(every) == len({trial.name for trial in every}) == 15 * 3 * 5
    # The first seed of all cells comes before the second of any.
    assert [trial.seed for trial in every] == sorted(trial.seed for trial in every)


def test_shipped_sweeps_load_and_the_papers_has_its_image() -> None:
    assert list_profiles("sweeps") == ["full", "paper", "quick", "tiny"]
    for name in list_profiles("sweeps"):
        assert load_sweep(name).description
    config = load_sweep("paper")
    best = next(t for t in trials(config) if t.network == "5x32" and "static" in t.arena)
    assert size_of(config, best) == NetworkSize(40_412_761, 1_505_055_712)
    training = training_of(config, best)
    assert training.environment.arena == "static-obstacles"
    assert (training.network.layers, training.network.filters, training.seed) == (5, 32, 1)


def test_a_trial_differs_from_the_sweeps_training_by_what_it_is(tmp_path: Path) -> None:
    config = load_sweep(f"{write_sweep_file(tmp_path)}")
    training = training_of(config, trials(config)[-1])
    assert training.seed == 2
    assert training.network == NetworkSpec(kind="template", layers=2, filters=4)
    plain = config.training.model_dump(exclude={"description", "seed", "network", "environment"})
    assert training.model_dump(exclude={"description", "seed", "network", "environment"}) == plain


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[training]", "[training]\nseed = 3", "training.seed: leave it out"),
        (
            "[training]",
            '[training]\nnetwork = { kind = "small" }',
            "training.network: leave it out",
        ),
        (
            "[training.environment]",
            '[training.environment]\narena = "crowded"',
            "training.environment.arena: leave it out",
        ),
        ("seeds = [1, 2]", "seeds = [1, 1]", "each number once"),
        ("seeds = [1, 2]", "seeds = []", "one or more numbers"),
        ("filters = [4]", "filters = [4, 4]", "each number once"),
        ("filters = [4]", "filters = [512]", "1 <= value <= 256"),
        ("episodes = 20", "episodes = 20\nseed = 499_990", "accepted: <= 500000"),
        ("steps = 1_000", "stpes = 1_000", "did you mean 'steps'?"),
    ],
)
def test_a_wrong_sweep_gets_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in TINY
    path = write_sweep_file(tmp_path, TINY.replace(old, new))
    with pytest.raises(UsageError, match=re.escape(message)):
        load_sweep(f"{path}")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"workers": 0}, "workers 0: accepted: 1 <= value <= 256"),
        ({"seeds": 0}, "seeds 0: accepted: 1 <= value <= 1000"),
        ({"episodes": 0}, "evaluation.episodes 0: accepted: 1 <= value"),
        ({"steps": 0}, "training.steps 0: accepted: 1 <= value"),
        ({"seed": 499_999}, "evaluation: seed . episodes = 500019: accepted: <= 500000"),
        ({"ray_gpus": 1.0}, "ray_gpus 1: accepted: with executor ray"),
        ({"ray_gpus": 9.0, "executor": "ray"}, "ray_gpus 9: accepted: 0 <= value <= 8"),
        ({"computer": "bare.toml"}, "no workload to estimate from"),
        ({"computer": "nowhere"}, "no computer profile 'nowhere'"),
        ({"sweep": "huge"}, "no sweep profile 'huge'; shipped: full, paper, quick, tiny"),
    ],
)
def test_a_wrong_option_gets_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bare.toml").write_text(BARE, encoding="utf-8")
    asked = {"sweep": "tiny", "out": tmp_path / "out", "dry_run": True} | changes
    with pytest.raises(UsageError, match=message):
        run(validated(SweepOptions, asked), Console(quiet=True))


def test_a_dry_run_says_all_and_leaves_nothing(tmp_path: Path) -> None:
    console = Console(width=120, record=True, file=None, quiet=False)
    with console.capture() as told:
        options = SweepOptions(
            sweep="full", out=tmp_path / "out", computer="ras-pi-4", dry_run=True
        )
        assert run(options, console) == 0
    text = told.get()
    assert "225, of which 0 have ended" in text
    assert "200,000 each, 45,000,000 in all" in text
    assert "9x64" in text and "t2, estimated" in text
    assert not (tmp_path / "out").exists()


# --- how large a network is


@pytest.mark.parametrize(
    ("layers", "filters", "height", "width"),
    [(5, 32, 154, 256), (4, 48, 154, 256), (8, 64, 154, 256), (2, 8, 24, 32), (1, 3, 12, 16)],
)
def test_parameters_in_closed_form_are_those_of_torch(
    layers: int, filters: int, height: int, width: int
) -> None:
    spec = NetworkSpec(kind="template", layers=layers, filters=filters)
    counted = parameters_of(spec, height, width)
    assert template_size(layers, filters, height, width, 25).parameters == counted


def test_the_sizes_are_those_that_the_paper_names() -> None:
    # 40.3 M and 161.77 M parameters (section VI.A); the latter belongs to 8x64.
    assert template_size(5, 32, 154, 256, 25).parameters == 40_412_761
    assert template_size(8, 64, 154, 256, 25).parameters == 161_771_033
    for name, work in load_computer("ras-pi-4").workloads.items():
        n = work.network
        assert n.layers is not None and n.filters is not None
        size = template_size(n.layers, n.filters, 154, 256, 25)
        assert (size.parameters, size.macs) == (n.parameters, n.macs), name


def test_a_template_made_without_torch_is_the_network_that_numpy_works_out() -> None:
    spec = ObservationSpec(height_px=6, width_px=8, horizontal_fov_deg=90.0, range_m=20.0)
    actions = ActionSpec(set="velocity")
    model = build_template(2, 3, spec, actions, np.random.default_rng(7))
    runtime = OnnxRuntime(model, spec, actions)
    rng = np.random.default_rng(3)
    seen: dict[str, Any] = {
        name: rng.integers(0, 256, (2, *box.shape), np.uint8)
        if box.dtype is np.uint8
        else rng.standard_normal((2, *box.shape), np.float32)
        for name, box in boxes(spec).items()
    }
    found = runtime.infer(seen)

    import onnx
    from onnx import numpy_helper

    held = {
        w.name: numpy_helper.to_array(w) for w in onnx.load_from_string(model).graph.initializer
    }
    assert sum(w.size for n, w in held.items() if n != "full_scale") == (
        template_size(2, 3, 6, 8, 2).parameters
    )
    for row in range(2):
        picture = seen["depth"][row].astype(np.float64) / 255.0
        for i in range(2):
            weights = held[f"conv{i}.weight"]
            padded = np.pad(picture, ((0, 0), (1, 1), (1, 1)))
            picture = np.stack(
                [
                    sum(
                        weights[f, c, dy, dx] * padded[c, dy : dy + 6, dx : dx + 8]
                        for c in range(len(padded))
                        for dy in range(3)
                        for dx in range(3)
                    )
                    for f in range(3)
                ]
            )
            picture = np.maximum(picture, 0.0)
        units = np.concatenate([picture.ravel(), seen["velocity"][row], seen["goal"][row]])
        for i in range(2):
            units = np.maximum(held[f"dense{i}.weight"] @ units, 0.0)
        np.testing.assert_allclose(found[row], held["score.weight"] @ units, rtol=1e-4, atol=1e-5)


# --- how it is judged


def test_the_interval_over_seeds_is_the_wider_of_students_and_wilsons(tmp_path: Path) -> None:
    config = load_sweep("tiny")
    wide = fake_results(config, trials(config)[:1] * 3, [100, 80, 60], episodes=100)
    found = over_seeds(wide)
    # Student's t after scipy's own test of one sample.
    low, high = stats.ttest_1samp([1.0, 0.8, 0.6], 0.0).confidence_interval(0.95)
    assert found.value == pytest.approx(0.8)
    assert found.low == pytest.approx(max(low, 0.0))
    assert found.high == pytest.approx(min(high, 1.0))
    assert found.n == 3

    alike = fake_results(config, trials(config)[:1] * 2, [90, 90], episodes=100)
    score = stats.binomtest(180, 200).proportion_ci(0.95, method="wilson")
    found = over_seeds(alike)
    assert (found.low, found.high) == pytest.approx((score.low, score.high))
    assert over_seeds([]).value is None


def test_the_best_of_equals_is_the_smaller_network(tmp_path: Path) -> None:
    config = load_sweep("quick")
    folder = SweepFolder(tmp_path, config)
    every = trials(config)
    # All alike, but for the smallest network, which is worse.
    counts = [100 if t.network == "2x32" else 290 for t in every]
    for result in fake_results(config, every, counts):
        folder.trial_path(result.trial).mkdir(parents=True)
        folder.finish(result, tmp_path / "none")
    sweep = summarize(folder, MADE)
    best = sweep.best("static-obstacles")
    assert best is not None
    known = [c for c in sweep.of("static-obstacles") if c.network != "2x32"]
    assert best.macs == min(cell.macs for cell in known)
    assert {cell.network for cell in sweep.rivals("static-obstacles")} == (
        {cell.network for cell in known} - {best.network}
    )
    assert sweep.ended == sweep.planned == 135


def test_estimated_latency_is_in_proportion_to_the_nearest_workload() -> None:
    pi = load_computer("ras-pi-4")
    network = pi.workloads["template-5x32"].network
    assert estimated_ms(pi, network.macs) == pytest.approx(396.0)
    assert estimated_ms(pi, network.macs // 100) == pytest.approx(3.96, rel=1e-6)


# --- what is kept


def test_a_result_is_read_as_it_was_written_and_no_other_is_taken(tmp_path: Path) -> None:
    config = load_sweep("tiny")
    folder = SweepFolder(tmp_path, config)
    first, second = trials(config)[:2]
    (result,) = fake_results(config, [first], [7])
    path = folder.trial_path(first)
    path.mkdir(parents=True)
    assert folder.result(first) is None
    folder.finish(result, path / "checkpoints")
    assert folder.result(first) == result
    # A result in another trial's place, of other flights, cut short.
    folder.trial_path(second).mkdir()
    text = (path / "result.json").read_text()
    (folder.trial_path(second) / "result.json").write_text(text)
    with pytest.raises(UsageError, match="of another trial or of other flights"):
        folder.result(second)
    (path / "result.json").write_text(text[: len(text) // 2])
    with pytest.raises(UsageError, match="JSON"):
        folder.result(first)


def test_a_sweep_goes_on_with_more_cells_and_seeds_but_not_with_another_training(
    tmp_path: Path,
) -> None:
    def begun(config: SweepConfig) -> dict[str, Any]:
        with open_campaign(tmp_path, declaration(config), command="airl sweep") as campaign:
            return campaign.made

    config = load_sweep("tiny")
    made = begun(config)
    assert begun(config) == made
    more = config.model_copy(update={"seeds": (1, 2, 3), "description": "other words"})
    assert begun(more) == made
    assert len(load_campaign(tmp_path).declaration.cells) == 6
    for name, changed in (
        ("training.steps = 1000, not 2000", {"training": {"steps": 2_000}}),
        ("evaluation.episodes = 20, not 5", {"evaluation": {"episodes": 5}}),
    ):
        data = config.model_dump(exclude_unset=True)
        for table, values in changed.items():
            data[table] |= values
        with pytest.raises(UsageError, match=f"holds a campaign with {name}; accepted"):
            begun(SweepConfig.model_validate(data))


# --- how it is shown


def test_figures_in_every_colour_are_legible() -> None:
    def luminance(colour: Any) -> float:
        linear = [
            c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)
        ]
        return float(np.dot([0.2126, 0.7152, 0.0722], linear))

    for share in np.linspace(0.0, 1.0, 101):
        field = colours()(share)
        a, b = sorted((luminance(field), luminance(_ink_on(field))))
        # WCAG 2.1, level AA for normal text.
        assert (b + 0.05) / (a + 0.05) >= 4.5, share


def test_a_heat_map_writes_what_it_was_given_where_it_belongs() -> None:
    heat = HeatMap(
        title="title",
        rows=(2, 3),
        row_title="layers",
        columns=(8, 16, 32),
        column_title="filters",
        fields={(2, 8): Field(10.0, "ten"), (3, 32): Field(90.0, "ninety", marked=True)},
        unit="%",
        limits=(0.0, 100.0),
    )
    figure = new_figure(*heat.size_in)
    ax = draw_heat_map(figure, heat)
    told = {text.get_text(): text.get_position() for text in ax.texts}
    assert told == {"ten": (0, 0), "ninety": (2, 1)}
    assert [t.get_text() for t in ax.get_xticklabels()] == ["8", "16", "32"]
    assert [t.get_text() for t in ax.get_yticklabels()] == ["2", "3"]
    assert render_png(figure).startswith(b"\x89PNG")


@pytest.mark.nightly
@pytest.mark.parametrize("computer", [None, "ras-pi-4"])
def test_the_page_holds_every_cell_and_names_the_best_and_the_papers(
    tmp_path: Path, computer: str | None
) -> None:
    config = load_sweep("full").model_copy(update={"seeds": (1, 2)})
    folder = SweepFolder(tmp_path, config)
    every = trials(config)[:-1]  # One has not ended.
    counts = [int(600 + 399 * math.sin(i) ** 2) for i in range(len(every))]
    for result in fake_results(config, every, counts, episodes=1000):
        folder.trial_path(result.trial).mkdir(parents=True)
        folder.finish(result, tmp_path / "none")
    asked = None if computer is None else Computer(computer, load_computer(computer))
    sweep = summarize(folder, MADE, asked)
    write_sweep(sweep)
    page = write_document(document_of(sweep), tmp_path).read_text(encoding="utf-8")
    data = json.loads((tmp_path / "sweep.json").read_text(encoding="utf-8"))
    assert (data["trials_ended"], data["trials_planned"]) == (89, 90)
    assert len(data["cells"]) == 45
    for arena, paper in (
        ("no-obstacles", "5x32, 91 %"),
        ("static-obstacles", "4x48, 84 %"),
        ("dynamic-obstacles", "7x32, 61 %"),
    ):
        best = data["best"][arena]
        means = {
            f"{cell['layers']}x{cell['filters']}": np.mean(
                [t["successes"] / t["episodes"] for t in cell["trials"]]
            )
            for cell in data["cells"]
            if cell["arena"] == arena
        }
        name = f"{best['layers']}x{best['filters']}"
        assert means[name] == pytest.approx(max(means.values()))
        assert f"the paper: {paper}" in page
        assert f"Best: {name} with {100 * means[name]:.1f} %" in page
    # Opens offline.
    assert not re.findall(r"(?:src|href)=\"(?!data:)[^\"]+\"", page)
    assert ("t2, estimated" in page) == (computer is not None)
    for file in ("sweep.md", "sweep-no-obstacles.png"):
        assert (tmp_path / file).stat().st_size > 1000

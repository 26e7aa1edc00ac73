"""`airl report RUN RUN`: differences between runs as figures, text and a page."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from airl_mav import Scenario, rehearse
from airl_mav.cli import report_command
from airl_mav.core.errors import UsageError
from airl_mav.flight.statistics import tango
from airl_mav.rehearsal.run_folder import LoadedRun, RunFolder
from airl_mav.report.comparison.comparison_model import Comparison
from airl_mav.report.comparison.figures import cumulated, flight_panels
from airl_mav.report.comparison.show import compare_folders, write_comparison
from airl_mav.report.comparison.tables import (
    facts_table,
    pair_sentences,
    runs_table,
    stages_table,
)
from airl_mav.report.run_figures import flight_pictures
from airl_mav.report.theme import line_style
from tests.report.test_report import Page
from tests.support.page_alone import page_alone
from tests.support.run_demo import demo_setup, write_demo_run

EPISODES = 24


def fly(out: Path, **options: Any) -> Path:
    given: dict[str, Any] = {"arena": "dense-obstacles", "episodes": EPISODES, "seed": 20}
    scenario = Scenario(level="gym", policy="greedy", **(given | options))
    return rehearse(scenario, out=out).path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same seeds fast and late, others of them, and the same in another arena."""
    root = tmp_path_factory.mktemp("runs")
    slow = {"computer": "ras-pi-4", "workload": "template-5x32"}
    return {
        "fast": fly(root / "fast"),
        "slow": fly(root / "slow", **slow),
        "later": fly(root / "later", seed=34, episodes=20),
        "elsewhere": fly(root / "elsewhere", arena="no-obstacles", episodes=4),
        "apart": fly(root / "apart", seed=500, episodes=3),
    }


@pytest.fixture(scope="module")
def loaded(runs: dict[str, Path]) -> tuple[Comparison, dict[str, LoadedRun]]:
    return compare_folders(list(runs.values()), [f"the flights of {name}" for name in runs])


@pytest.fixture(scope="module")
def compared(loaded: tuple[Comparison, dict[str, LoadedRun]]) -> Comparison:
    return loaded[0]


@pytest.fixture(scope="module")
def page(
    loaded: tuple[Comparison, dict[str, LoadedRun]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    return write_comparison(*loaded, tmp_path_factory.mktemp("page"))


def lines(path: Path) -> dict[int, dict[str, Any]]:
    """Return the episodes of a run by seed, as a reader without this package sees them."""
    episodes = map(json.loads, (path / "episodes.jsonl").read_text().splitlines())
    return {episode["seed"]: episode for episode in episodes}


def test_differences_are_those_of_the_files(runs: dict[str, Path], page: Path) -> None:
    data = json.loads((page.parent / "compare.json").read_text())
    assert data["schema"] == 3
    first, second = lines(runs["fast"]), lines(runs["slow"])
    found = data["contrasts"][0]["paired"]
    reached = [(first[s]["outcome"] == "success", second[s]["outcome"] == "success") for s in first]
    assert sum(found["agreement"].values()) == len(reached) == EPISODES
    assert found["agreement"]["only_reference"] == sum(a and not b for a, b in reached) > 0
    rates = np.mean(reached, axis=0)
    difference = found["success_rate"]["difference"]
    assert difference["value"] == pytest.approx(100.0 * (rates[1] - rates[0]))
    gained, lost = (
        sum(x and not y for x, y in each) for each in ([r[::-1] for r in reached], reached)
    )
    assert difference["low"] == pytest.approx(100.0 * (tango(gained, lost, EPISODES).low or 0.0))
    common = [s for s, ends in zip(first, reached, strict=True) if all(ends)]
    for key in ("flight_time_s", "distance_m", "energy_j"):
        a, b = (np.array([e[s]["quality"][key] for s in common]) for e in (first, second))
        assert found[key]["difference"]["value"] == pytest.approx(100.0 * np.median(b / a - 1.0))
        assert found[key]["difference"]["n"] == len(common)


def test_only_the_same_episode_makes_a_pair(compared: Comparison) -> None:
    slow, later, elsewhere, apart = compared.contrasts
    assert (slow.pairs, slow.unmatched) == (EPISODES, 0)
    # Seeds 34 to 43 of 20 to 43.
    assert (later.pairs, later.unmatched) == (10, 0)
    # The same seeds, other arenas and goals.
    assert (elsewhere.pairs, elsewhere.unmatched) == (0, 4)
    assert (apart.pairs, apart.unmatched) == (0, 0)
    said = pair_sentences(compared)
    assert "24 pairs" in said[0]
    assert "share no episode" in said[2]
    assert "4 flights" in said[2]
    assert "share no episode" in said[3]


def test_only_what_differs_is_told_side_by_side(runs: dict[str, Path]) -> None:
    compared = compare_folders([runs["fast"], runs["slow"]])[0]
    assert set(compared.different) >= {"computer", "decision latency t2"}
    assert not {"policy", "arena", "seeds", "level", "goal radius"} & set(compared.different)
    assert compared.same["seeds"] == "20 to 43"
    assert compared.same["hold t3"] == "0.5 s"
    view = facts_table(compared)
    assert [column.title for column in view.columns] == ["", *(r.heading for r in compared.runs)]
    for row in view.rows:
        assert len(set(row[1:])) > 1, row[0]
    many = compare_folders(list(runs.values()))[0]
    assert facts_table(many).columns[0].title == "run"


def test_names_tell_runs_apart(runs: dict[str, Path], tmp_path: Path) -> None:
    names = [s.name for s in compare_folders([runs["fast"], runs["slow"]])[0].runs]
    assert names == ["workstation", "ras-pi-4, 396 ms"]
    # Nothing but the seeds differs: folders.
    assert [s.name for s in compare_folders([runs["fast"], runs["later"]])[0].runs] == [
        "fast",
        "later",
    ]
    given = compare_folders([runs["fast"], runs["slow"]], ("desk", "drone"))[0]
    assert [c.entry.target for c in given.contrasts] == ["drone"]
    assert [run.heading for run in given.runs] == ["desk", "drone"]


def test_long_names_get_letters(compared: Comparison) -> None:
    assert [run.mark for run in compared.runs] == list("ABCDE")
    assert compared.runs[1].heading == f"B  {compared.runs[1].name}"


def test_latency_cells_are_what_numpy_says(runs: dict[str, Path], compared: Comparison) -> None:
    view = stages_table(compared.runs)
    (start,) = [i for i, row in enumerate(view.rows) if row[0] == "t2 infer"]
    row = dict(zip([c.title for c in view.columns], view.rows[start + 1], strict=True))
    with np.load(runs["slow"] / "latency.npz") as stamps:
        groups = sorted({name.partition("/")[0] for name in stamps.files})
        pairs = [(stamps[f"{g}/action_ready_us"], stamps[f"{g}/infer_start_us"]) for g in groups]
    raw = np.concatenate([(end - begin)[(end >= 0) & (begin >= 0)] for end, begin in pairs]) / 1e3
    assert row["run"] == "B"
    assert row["n"] == f"{len(raw):,}"
    assert row["mean"] == f"{raw.mean():.2f}"
    assert row["p90"] == f"{np.percentile(raw, 90, method='inverted_cdf'):.2f}"
    # Stages that the simulator combines are shown as one stage.
    titles = {row[0] for row in view.rows}
    assert "setpoint → motor" in titles
    assert not {"link", "control", "send"} & titles


def test_stages_of_a_rehearsal_and_of_the_twin_stand_together(
    runs: dict[str, Path], tmp_path: Path
) -> None:
    write_demo_run(tmp_path / "sitl", episodes=2)
    view = stages_table(compare_folders([runs["fast"], tmp_path / "sitl"])[0].runs)
    counts: dict[str, int] = {}
    stage = ""
    for row in view.rows:
        stage = row[0] or stage
        counts[stage] = counts.get(stage, 0) + 1
    assert counts["link"] == counts["control"] == 1
    assert counts["t2 infer"] == counts["setpoint → motor"] == counts["end to end"] == 2


def test_quality_of_each_run(runs: dict[str, Path], compared: Comparison) -> None:
    for row, path in zip(runs_table(compared.runs).rows, runs.values(), strict=True):
        flown = lines(path).values()
        good = [e["quality"] for e in flown if e["outcome"] == "success"]
        assert row[1] == f"{len(flown)}"
        assert row[2].startswith(f"{100.0 * len(good) / len(flown):.1f} [")
        assert row[6].startswith(f"{np.mean([q['computer_energy_j'] for q in good]) / 1e3:.2f}")


@pytest.mark.parametrize("n", [1, 7, 4000])
def test_a_drawn_distribution_passes_through_its_samples(n: int) -> None:
    samples = np.random.default_rng(n).integers(1, 10**6, n)
    at_ms, share = cumulated(samples)
    assert len(at_ms) <= 401
    assert share[0] == 0.0
    assert share[-1] == 100.0
    assert at_ms[-1] == samples.max() / 1e3
    for x, y in zip(at_ms[1:], share[1:], strict=True):
        assert 100.0 * np.mean(samples / 1e3 <= x) >= y - 1e-9


def test_looks_differ() -> None:
    assert len({line_style(i) for i in range(32)}) == 32


def test_panels_share_their_axes(loaded: tuple[Comparison, dict[str, LoadedRun]]) -> None:
    compared, runs = loaded
    pictures = flight_pictures("fan", flight_panels(compared.runs[:3], runs))
    ticks = [set(re.findall(r">(−?\d+)</text>", picture.svg)) for picture in pictures]
    assert ticks[0] == ticks[1] == ticks[2]
    assert {len(base64.b64decode(p.data_uri().partition(",")[2])) > 0 for p in pictures} == {True}


def test_the_page_is_whole_and_reaches_nothing_else(page: Path, compared: Comparison) -> None:
    text = page.read_text(encoding="utf-8")
    parsed = Page(text)
    images = [ref for ref in parsed.references if not ref.startswith("..") and ref[0] != "/"]
    assert all(ref.startswith("data:image/svg+xml;base64,") for ref in images)
    assert not parsed.tags & {"script", "link", "iframe", "object"}
    assert all(image["alt"] for image in parsed.images)
    # Four measures, two distributions, a fan each, energy.
    assert len(parsed.images) == 4 + 2 + len(compared.runs) + 1
    words = " ".join(parsed.words)
    for run_ in compared.runs:
        assert run_.name in words
    for name in ("differences", "latency", "trajectories", "energy"):
        with Image.open(page.parent / f"compare-{name}.png") as image:
            assert min(image.size) > 200
    assert not list(page.parent.glob("*.partial"))


@pytest.mark.nightly
def test_it_is_the_same_when_it_is_made_again(
    loaded: tuple[Comparison, dict[str, LoadedRun]], page: Path
) -> None:
    before = {p.name: p.read_bytes() for p in page.parent.iterdir()}
    write_comparison(*loaded, page.parent)
    assert {p.name: p.read_bytes() for p in page.parent.iterdir()} == before


# --- the command


def ask(*paths: Path, **options: Any) -> str:
    console = Console(record=True, width=100, file=io.StringIO())
    with page_alone():
        assert report_command.run(report_command.ReportOptions(runs=paths, **options), console) == 0
    return console.export_text()


def test_the_command_prints_and_writes(runs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    text = ask(runs["fast"], runs["slow"], out=out, names=("desk", "drone"))
    assert "drone against desk" in text
    assert "drone and desk: 24 pairs." in text
    assert "Deadlines and smoothness" in text
    assert (out / "compare.html").exists()
    # Write into the same folder again.
    ask(runs["fast"], runs["slow"], out=out, names=("desk", "drone"))


def test_a_table_of_policies_and_arenas_stands_for_its_runs(
    runs: dict[str, Path], tmp_path: Path
) -> None:
    root = tmp_path / "matrix"
    root.mkdir()
    for name in ("fast", "slow"):
        (root / name).symlink_to(runs[name])
    entries = [{"entry": {"name": name, "folder": name}} for name in ("fast", "slow")]
    held = {"schema": 3, "facts": {}, "runs": entries}
    (root / "matrix.json").write_text(json.dumps(held))
    assert "workstation" in ask(root, out=tmp_path / "out")
    (root / "matrix.json").write_text('{"schema": 3, "runs": 3}')
    with pytest.raises(UsageError, match=r"matrix\.json: facts: missing"):
        ask(root, runs["fast"], out=tmp_path / "other")


def test_what_cannot_be_compared_is_refused(runs: dict[str, Path], tmp_path: Path) -> None:
    fast, slow = runs["fast"], runs["slow"]
    with pytest.raises(UsageError, match="accepted: each run once"):
        ask(fast, fast, out=tmp_path / "out")
    with pytest.raises(UsageError, match="no run here"):
        ask(fast, tmp_path, out=tmp_path / "out")
    with pytest.raises(UsageError, match="names: 1 for 2 runs"):
        ask(fast, slow, names=("one",), out=tmp_path / "out")
    with pytest.raises(UsageError, match="--names 'a': accepted"):
        ask(fast, slow, names=("a", "a"), out=tmp_path / "out")
    with pytest.raises(UsageError, match="holds a run"):
        ask(fast, slow, out=fast)
    with pytest.raises(UsageError, match="accepted: with two runs or more"):
        ask(fast, names=("a",))
    RunFolder.create(tmp_path / "empty", "empty", {}, setup=demo_setup(), seeds=(1,))
    with pytest.raises(UsageError, match="no flight was finished"):
        ask(fast, tmp_path / "empty", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(UsageError, match="holds something else"):
        ask(fast, slow, out=tmp_path / "full")

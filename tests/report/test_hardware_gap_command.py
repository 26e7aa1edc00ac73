"""`airl hardware-gap`: flights, output, files, and resuming."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from PIL import Image

from airl_mav.cli.hardware_gap_command import OPTIONS
from airl_mav.core.errors import UsageError
from airl_mav.experiments import hardware_gap as hardware_gap_experiment
from airl_mav.experiments.campaign import EpisodeSaver
from airl_mav.experiments.hardware_gap import (
    DEFAULT_MITIGATED,
    DEFAULT_UNMITIGATED,
    TRAINING_LATENCY_SEED,
    declare_hardware_gap,
)
from airl_mav.flight.statistics import tango
from airl_mav.policy.registry import PolicyInfo
from airl_mav.profiles.loading import profiles_dir
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.report.comparison import show
from airl_mav.report.comparison.build import worst_seeds
from airl_mav.report.comparison.comparison_model import load_comparison, save_comparison
from airl_mav.report.comparison.hardware_gap_page import gaps_table, runs_table
from airl_mav.report.comparison.show import build_comparison, rebuild_comparison
from airl_mav.report.comparison.tables import contrast_table
from airl_mav.report.measures import ALL_MEASURES
from airl_mav.scenario.model import Scenario
from tests.support.command_line import airl, option_words

HARDWARE_GAP_FILE = "hardware-gap.json"
EPISODES = 24
RETRAINED = ("mitigated", "mitigated-compensated", "training", "mitigated-reference")
ALONE = "latency-alone"
NOT_RETRAINED = ("reference", "target", ALONE, "compensated", "compensated-pipelined")
ROLES = NOT_RETRAINED + RETRAINED


def make_policy(
    folder: Path, delay: dict[str, Any] | None, extra: tuple[float, float] = (0.0, 0.0)
) -> Path:
    """Make a policy that says it was trained that late: the unmitigated one under another name."""
    shutil.copytree(profiles_dir() / "policies" / DEFAULT_UNMITIGATED, folder)
    card = json.loads((folder / "card.json").read_text())
    card.pop("crc32", None)
    card["name"] = "mitigated"
    environment = card["training"]["config"]["environment"]
    environment["delay"] = delay
    environment["randomisation"]["extra_delay_ms"] = extra
    if delay is None:
        card["training"]["config"] = {}
    (folder / "card.json").write_text(json.dumps(card))
    return folder


@pytest.fixture(scope="module")
def mitigated(tmp_path_factory: pytest.TempPathFactory) -> str:
    delay = {"computer": "ras-pi-4", "workload": "template-5x32"}
    return str(make_policy(tmp_path_factory.mktemp("policies") / "m", delay))


def measure(mitigated: str, *, page: bool = False, **options: Any) -> tuple[int, str]:
    """Run the command in this process; return exit status and output.

    Pages take longer than flights: without `page` none is made.
    """
    words = option_words(**({"mitigated": mitigated, "episodes": EPISODES} | options))
    with (
        nullcontext()
        if page
        else patch.object(show, "write_document", lambda _, folder: folder / "hardware-gap.html")
    ):
        return airl("hardware-gap", *words, width=80)


@pytest.fixture(scope="module")
def whole(mitigated: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return the folder and output of an uninterrupted gap."""
    out = tmp_path_factory.mktemp("whole") / "gap"
    code, text = measure(mitigated, out=out, page=True)
    assert code == 0
    return out, text


def data_of(path: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((path / HARDWARE_GAP_FILE).read_text())
    return data


def lines(path: Path) -> dict[int, dict[str, Any]]:
    """Return the episodes of a run by seed, as a reader without this package sees them."""
    episodes = map(json.loads, (path / "episodes.jsonl").read_text().splitlines())
    return {episode["seed"]: episode for episode in episodes}


def gap_of(data: dict[str, Any], key: str) -> dict[str, Any]:
    arena = data["runs"][0]["entry"]["group"]
    groups = {run["entry"]["name"]: run["entry"]["group"] for run in data["runs"]}
    (found,) = [
        {**contrast["entry"], **contrast["paired"], **contrast}
        for contrast in data["contrasts"]
        if contrast["entry"]["key"] == key and groups[contrast["entry"]["target"]] == arena
    ]
    return dict(found)


def columns_of(data: dict[str, Any], group: str = "static-obstacles") -> list[dict[str, Any]]:
    """Return the runs of an arena."""
    return [
        {**run["quality"], **run["entry"], **run}
        for run in data["runs"]
        if run["entry"]["group"] == group
    ]


# --- what it flies


def test_the_columns_and_what_they_are_flown_on(whole: tuple[Path, str]) -> None:
    out, _ = whole
    columns = columns_of(data_of(out))
    assert [column["role"] for column in columns] == list(ROLES)
    # Columns have names, not letters.
    assert [column["mark"] for column in columns] == [role.replace("-", " ") for role in ROLES]
    runs = {c["role"]: json.loads((out / c["folder"] / "run.json").read_text()) for c in columns}
    policies = {role: info["setup"]["policy"]["name"] for role, info in runs.items()}
    names = dict.fromkeys(RETRAINED, "mitigated")
    names |= dict.fromkeys(NOT_RETRAINED, DEFAULT_UNMITIGATED)
    assert policies == names
    between = {role: info["setup"]["between_commands"] for role, info in runs.items()}
    assert between == dict.fromkeys(ROLES, "persist") | {
        "compensated": "persist, latency compensated",
        "compensated-pipelined": "persist, pipelined decisions, latency compensated",
        "mitigated-compensated": "persist, latency compensated",
    }
    means = {role: info["setup"]["injection"]["latency"]["mean_ms"] for role, info in runs.items()}
    assert means == dict.fromkeys(ROLES, 396.0) | {"reference": 11.0, "mitigated-reference": 11.0}
    watts = {role: info["setup"]["computer_watts"] for role, info in runs.items()}
    # The computer's power is the target's in the training conditions, too.
    undelayed = ("reference", "mitigated-reference")
    assert watts == dict.fromkeys(ROLES, 1.7) | dict.fromkeys((*undelayed, ALONE), 0.0)
    on_ground = [role for role, info in runs.items() if info["setup"]["computer_on_ground"]]
    assert on_ground == ["reference", ALONE, "mitigated-reference"]
    assert {tuple(info["seeds"]) for info in runs.values()} == {tuple(range(1, EPISODES + 1))}
    assert runs["training"]["config"]["latency_seed"] == TRAINING_LATENCY_SEED != 0


def drawn(folder: Path) -> dict[str, np.ndarray]:
    """Return the t2 of every decision [µs] by episode."""
    found = {}
    with np.load(folder / "latency.npz") as stamps:
        for index in sorted({name.partition("/")[0] for name in stamps.files}):
            start, end = stamps[f"{index}/infer_start_us"], stamps[f"{index}/action_ready_us"]
            ended = (start >= 0) & (end >= 0)
            found[index] = (end - start)[ended]
    return found


def test_the_training_conditions_are_other_draws_of_the_same_latency(
    whole: tuple[Path, str],
) -> None:
    out, _ = whole
    there, trained = (drawn(out / f"static-obstacles-{role}") for role in ("mitigated", "training"))
    same = [there[index][0] == trained[index][0] for index in there]
    assert np.mean(same) < 0.1
    pooled = [np.concatenate(list(part.values())) for part in (there, trained)]
    for values in pooled:
        assert values.mean() == pytest.approx(396e3, rel=0.02)
        assert values.std() == pytest.approx(19.8e3, rel=0.25)


def test_the_latency_alone_is_that_of_airl_evaluate(
    whole: tuple[Path, str], tmp_path: Path
) -> None:
    """Same seeds, same latencies, no mass and power: equal flights, not those of the target."""
    out, text = whole
    options = {"level": "gym", "episodes": EPISODES, "latency": "ras-pi-4/template-5x32"}
    words = option_words(**options | {"out": tmp_path / "evaluated"})
    assert airl("evaluate", DEFAULT_UNMITIGATED, *words)[0] == 0
    alone, target = (out / f"static-obstacles-{role}" for role in (ALONE, "target"))

    def flown(run: Path) -> list[tuple[Any, ...]]:
        return [(s, e["outcome"], e["quality"]) for s, e in lines(run).items()]

    assert flown(alone) == flown(tmp_path / "evaluated") != flown(target)
    there, here = drawn(target), drawn(alone)
    assert all(there[index][0] == here[index][0] for index in there)
    assert "With that latency alone, without mass and power, it flies a median" in " ".join(
        text.split()
    )


def test_t2_is_that_of_the_flights(whole: tuple[Path, str]) -> None:
    out, _ = whole
    for column in columns_of(data_of(out)):
        pooled = np.concatenate(list(drawn(out / column["folder"]).values()))
        assert column["stages"]["t2"]["n"] == len(pooled)
        assert column["stages"]["t2"]["mean"] == pytest.approx(pooled.mean())
        assert column["stages"]["t2"]["p50"] == np.sort(pooled)[(len(pooled) - 1) // 2]


# --- what it says


@pytest.mark.parametrize(
    ("key", "target", "reference"),
    [
        ("without-mitigation", "target", "reference"),
        ("latency-alone", "latency-alone", "reference"),
        ("compensated", "compensated", "reference"),
        ("compensated-pipelined", "compensated-pipelined", "reference"),
        ("with-mitigation", "mitigated", "reference"),
        ("both", "mitigated-compensated", "reference"),
        ("without-mitigation-trained", "target", "training"),
        ("with-mitigation-trained", "mitigated", "training"),
        ("mitigation-on-target", "mitigated", "target"),
        ("cost-on-reference", "mitigated-reference", "reference"),
    ],
)
def test_gaps_are_those_of_the_files(
    whole: tuple[Path, str], key: str, target: str, reference: str
) -> None:
    out, _ = whole
    found = gap_of(data_of(out), key)
    first, second = (lines(out / f"static-obstacles-{role}") for role in (reference, target))
    reached = [(first[s]["outcome"] == "success", second[s]["outcome"] == "success") for s in first]
    gained = sum(b and not a for a, b in reached)
    lost = sum(a and not b for a, b in reached)
    success = found["success_rate"]["difference"]
    expected = tango(gained, lost, EPISODES)
    assert success["value"] == pytest.approx(100.0 * (gained - lost) / EPISODES)
    assert expected.low is not None
    assert success["low"] == pytest.approx(100.0 * expected.low)
    common = [s for s, ends in zip(first, reached, strict=True) if all(ends)]
    assert len(common) > EPISODES // 3
    for metric in ("flight_time_s", "distance_m", "energy_j", "computer_energy_j"):
        values = np.array(
            [(first[s]["quality"][metric], second[s]["quality"][metric]) for s in common]
        )
        medians = np.median(values, axis=0)
        change = found[metric]
        assert [change["reference"], change["other"]] == pytest.approx(list(medians))
        if not medians[0]:  # of a computer on the ground
            assert change["difference"]["value"] is None
            continue
        assert change["difference"]["n"] == len(common)
        median = 100.0 * np.median(values[:, 1] / values[:, 0] - 1.0)
        assert change["difference"]["value"] == pytest.approx(median, abs=1e-9)


def test_the_gap_appears(whole: tuple[Path, str]) -> None:
    """Otherwise nothing of this file shows anything."""
    gap = gap_of(data_of(whole[0]), "without-mitigation")
    for metric, least in (("flight_time_s", 10.0), ("distance_m", 5.0), ("energy_j", 10.0)):
        assert gap[metric]["difference"]["low"] > least
    assert gap["t2_percent"] == pytest.approx(3500.0, rel=0.02)


def test_compensation_closes_most_of_the_gap(whole: tuple[Path, str]) -> None:
    data = data_of(whole[0])
    without, compensated = (gap_of(data, key) for key in ("without-mitigation", "compensated"))
    for metric in ("flight_time_s", "distance_m", "energy_j"):
        left = compensated[metric]["difference"]["value"]
        assert left < 0.5 * without[metric]["difference"]["value"]


def test_the_same_policy_has_the_same_gap_and_none_where_it_was_trained(
    whole: tuple[Path, str],
) -> None:
    """Use the default policy as the mitigated policy, so that the expected values are exact."""
    data = data_of(whole[0])
    without, with_ = (gap_of(data, key) for key in ("without-mitigation", "with-mitigation"))
    for metric in ("success_rate", "flight_time_s", "energy_j"):
        assert with_[metric] == without[metric]
    nothing = gap_of(data, "mitigation-on-target")
    assert nothing["flight_time_s"]["difference"]["value"] == 0.0
    assert gap_of(data, "cost-on-reference")["distance_m"]["difference"]["value"] == 0.0
    trained = gap_of(data, "with-mitigation-trained")["flight_time_s"]["difference"]
    assert trained["value"] != 0.0
    assert trained["low"] < 0.0 < trained["high"]


def test_the_paper_stands_beside_it(whole: tuple[Path, str]) -> None:
    out, text = whole
    data = data_of(out)
    tables = data["extra"]["published_tables"]
    assert tables == {"static-obstacles": "mitigation, Static Obstacles (VII.B)"}
    labels = {c["role"]: c["published"] and c["published"]["label"] for c in columns_of(data)}
    assert labels["target"] == "Ras-Pi 4, without mitigation"
    assert labels["mitigated-reference"] is None
    assert gap_of(data, "without-mitigation")["published"]["flight_time_percent"] == (
        pytest.approx(86.6, abs=0.05)
    )
    trained = gap_of(data, "without-mitigation-trained")["published"]
    assert trained["flight_time_percent"] == pytest.approx(37.73, abs=0.02)
    flat = " ".join(text.split())
    assert "(85 - 73) / 73" in flat
    assert "against the delay-trained policy" in flat


def test_the_answer_is_one_of_the_numbers(whole: tuple[Path, str]) -> None:
    out, text = whole
    data = data_of(out)
    (answer,) = data["answers"]
    assert " ".join(answer.split()) in " ".join(text.split())
    change = gap_of(data_of(out), "without-mitigation")["flight_time_s"]["difference"]
    assert f"On ras-pi-4 (t2 39{6}" in answer or "On ras-pi-4 (t2 39" in answer
    assert (
        f"{change['value']:.1f} % longer ({change['low']:+.1f} … {change['high']:+.1f})" in answer
    )
    rates = {c["role"]: 100.0 * c["success_rate"]["value"] for c in columns_of(data_of(out))}
    assert f"reaches {rates['target']:.1f} % of its goals, not {rates['reference']:.1f} %" in answer
    assert "With its latency compensated it flies " in answer
    assert "mitigated there flies" in answer
    assert "against the conditions of its own training" in answer


def test_everything_fits_into_80_columns(whole: tuple[Path, str]) -> None:
    tables = whole[1].partition("Each run by itself")[2].partition("gap  ")[0]
    assert max(len(line.rstrip()) for line in tables.splitlines()) <= 80
    assert "…" not in tables.partition("Each by itself")[0]  # No cell is cut.


def test_tables_and_figures_agree(whole: tuple[Path, str]) -> None:
    gap = load_comparison(whole[0], "hardware-gap")
    (arena,) = gap.groups
    table = runs_table(gap, arena)
    column = [column.title for column in table.columns].index("flight time\n[s]")
    rows = [row for row in table.rows if row[0] != "  paper"]
    assert [row[0] for row in rows] == [run.mark for run in gap.runs]
    for row, run in zip(rows, gap.runs, strict=True):
        assert run.quality.flight_time_s.value is not None
        shown = row[column].partition(" ")[0]
        assert float(shown) == pytest.approx(run.quality.flight_time_s.value, abs=5e-3)
    told = [(row[0], below[column]) for row, below in pairwise(table.rows) if below[0] == "  paper"]
    assert told == [
        ("reference", "24.08"),
        ("target", "44.93"),
        ("mitigated", "32.44"),
        ("training", "32.62"),
    ]
    first = gaps_table(gap, arena).rows[0]
    assert first[0] == "target\nagainst reference"
    difference = gap.contrasts[0].paired.flight_time_s.difference
    assert difference.value is not None
    assert first[2].startswith(f"{difference.value:+.1f} [")
    assert "+86.6" in gaps_table(gap, arena).rows[1]
    detail = contrast_table(gap, gap.contrasts[0], ALL_MEASURES)
    assert len(detail.columns) == 9
    assert {len(row) for row in detail.rows} == {9}


def test_the_file_is_the_whole_comparison(whole: tuple[Path, str], tmp_path: Path) -> None:
    """Compare the loaded file with a rebuild from the runs; saving it again is byte-identical."""
    read = load_comparison(whole[0], "hardware-gap")
    assert read == rebuild_comparison(whole[0])[0]
    save_comparison(read, tmp_path)
    assert (tmp_path / HARDWARE_GAP_FILE).read_bytes() == (
        whole[0] / HARDWARE_GAP_FILE
    ).read_bytes()


class Page(HTMLParser):
    """Text of a page, and the resources that it requests."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.asks: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(path.read_text(encoding="utf-8"))
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.asks += [value for key, value in attrs if key in ("src", "href") and value]
        if tag not in ("meta", "img", "link", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_opens_offline_and_its_pictures_lie_beside_it(whole: tuple[Path, str]) -> None:
    out, _ = whole
    page = Page(out / "hardware-gap.html")
    assert page.open == []
    assert page.asks
    assert all(ask.startswith("data:image/svg+xml;base64,") for ask in page.asks)
    said = ("Hardware gap", "Seeds that lost most", "86.6", "(85 - 73) / 73", "on the ground")
    for words in said:
        assert words in page.text
    for name in ("hardware-gap", "flights", "worst"):
        with Image.open(out / f"{name}-static-obstacles.png") as picture:
            picture.load()
            assert min(picture.size) > 400
            assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 20


def test_the_markdown_has_every_table(whole: tuple[Path, str]) -> None:
    text = (whole[0] / "hardware-gap.md").read_text()
    assert text.count("\n| --- |") == 12  # The runs, the gaps, nine in detail.
    for block in re.findall(r"(?:^\|.*\|\n)+", text, re.M):
        rows = [re.findall(r"(?<!\\)\|", line) for line in block.splitlines()]
        assert len({len(row) for row in rows}) == 1
    assert "TODO" not in text


def test_the_worst_seeds_failed_or_took_longest(whole: tuple[Path, str]) -> None:
    out, _ = whole
    worst = data_of(out)["extra"]["worst_seeds"]["static-obstacles"]
    assert len(worst) == len(set(worst)) == 6
    first, second = (lines(out / f"static-obstacles-{role}") for role in ("reference", "target"))
    assert all(first[seed]["outcome"] == "success" for seed in worst)
    ratio = {
        s: second[s]["quality"]["flight_time_s"] / first[s]["quality"]["flight_time_s"]
        for s in first
        if first[s]["outcome"] == second[s]["outcome"] == "success"
    }
    slow = [seed for seed in worst if seed in ratio]
    assert slow == sorted(ratio, key=lambda s: -ratio[s])[: len(slow)]
    failed = [seed for seed in worst if seed not in ratio]
    lost = sorted(s for s in second if second[s]["outcome"] != "success" == first[s]["outcome"])
    assert failed == [s for s in lost if first[s]["outcome"] == "success"][: len(failed)]


def test_worst_seeds_of_nothing() -> None:
    assert worst_seeds([], []) == []


# --- resuming


def test_the_same_out_shows_it_again(whole: tuple[Path, str], mitigated: str) -> None:
    out, text = whole
    before = data_of(out)
    code, again = measure(mitigated, out=out)
    assert code == 0
    assert again.count("(flown before)") == 9
    assert data_of(out) == before
    assert (
        again.partition("Each run by itself")[2].partition("gap  ")[0]
        == (text.partition("Each run by itself")[2].partition("gap  ")[0])
    )


def test_airl_report_shows_it_again(whole: tuple[Path, str]) -> None:
    out, text = whole
    before = (out / HARDWARE_GAP_FILE).read_bytes()
    with patch.object(show, "write_document", lambda _, folder: folder / "hardware-gap.html"):
        code, again = airl("report", str(out), width=80)
    assert code == 0
    assert (out / HARDWARE_GAP_FILE).read_bytes() == before
    assert again.strip() in text


@pytest.mark.nightly
def test_a_part_of_it_is_shown(whole: tuple[Path, str], tmp_path: Path, mitigated: str) -> None:
    """A gap that was stopped after its second column has one gap already."""
    real, flown = EpisodeSaver.add, []

    def interrupted(saver: EpisodeSaver, episode: FlownEpisode) -> None:
        real(saver, episode)
        flown.append(episode)
        if len(flown) == 2 * EPISODES:
            signal.raise_signal(signal.SIGINT)

    with patch.object(EpisodeSaver, "add", interrupted):
        code, text = measure(mitigated, out=tmp_path / "root")
    assert code == 130
    assert "resume with" in text
    data = data_of(tmp_path / "root")
    assert [gap["entry"]["key"] for gap in data["contrasts"]] == ["without-mitigation"]
    assert gap_of(data, "without-mitigation") == gap_of(data_of(whole[0]), "without-mitigation")
    code, _ = measure(mitigated, out=tmp_path / "root")
    assert code == 0
    assert data_of(tmp_path / "root") == data_of(whole[0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[", "JSON"),
        ('{"schema": 9}', "schema = 9"),
        ('{"schema": 3, "facts": {}}', "runs: missing"),
        ('{"schema": 3, "facts": {}, "runs": []}', "no run here"),
        pytest.param("[" * 100_000, "nested", id="nested"),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / HARDWARE_GAP_FILE).write_text(text)
    with pytest.raises(UsageError, match=re.escape(words)) as caught:
        rebuild_comparison(tmp_path)
    assert "\n" not in f"{caught.value}"


def test_no_gap_here(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no comparison here; accepted: the folder of a"):
        rebuild_comparison(tmp_path)


# --- options


def test_without_mitigation_and_in_two_arenas(tmp_path: Path) -> None:
    code, text = measure(
        "none", out=tmp_path, arena=("no-obstacles", "static-obstacles"), episodes=3
    )
    assert code == 0
    data = data_of(tmp_path)
    for arena, paper in (
        ("no-obstacles", "system evaluation, No Obstacles (VI.B)"),
        ("static-obstacles", "mitigation, Static Obstacles (VII.B)"),
    ):
        assert [c["role"] for c in columns_of(data, arena)] == list(NOT_RETRAINED)
        assert data["extra"]["published_tables"][arena] == paper
    assert len(data["answers"]) == 2
    assert " in no-obstacles " in data["answers"][0]
    assert "no-obstacles ─" in text
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == [
        f"{arena}-{role}"
        for arena in ("no-obstacles", "static-obstacles")
        for role in sorted(NOT_RETRAINED)
    ]


@pytest.mark.parametrize("latency", ["150ms", "file"])
def test_another_source_of_latency(tmp_path: Path, latency: str) -> None:
    if latency == "file":
        path = tmp_path / "measured.txt"
        path.write_text("140\n160\n150\n")
        latency = str(path)
    code, _ = measure("none", out=tmp_path / "out", latency=latency, episodes=3)
    assert code == 0
    data = data_of(tmp_path / "out")
    a, b, *_ = columns_of(data)
    # The reference is undelayed: no workload matches the measured latency.
    assert a["stages"]["t2"]["mean"] == 1e3
    assert b["stages"]["t2"]["mean"] == pytest.approx(150e3, rel=0.02)
    assert data["extra"]["published_tables"] == {}
    assert a["published"] is b["published"] is None
    assert data["facts"]["latency"] == latency
    # A latency without a computer is flown without mass and power.
    assert [c["role"] for c in columns_of(data)] == [r for r in NOT_RETRAINED if r != ALONE]
    assert {run["setup"]["computer_watts"] for run in data["runs"]} == {0.0}
    assert "The latency is flown alone" in data["facts"]["remarks"][0]


def test_a_named_computer_is_flown_whole_and_its_latency_alone(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert measure("none", out=out, latency="150ms", computer="ras-pi-4", episodes=2)[0] == 0
    columns = {c["role"]: c["setup"] for c in columns_of(data_of(tmp_path / "out"))}
    assert list(columns) == list(NOT_RETRAINED)
    assert columns["target"]["computer_watts"] == 1.7
    assert columns[ALONE]["computer_watts"] == 0.0
    assert columns[ALONE]["injection"] == columns["target"]["injection"]


def test_the_latency_of_an_estimate_is_not_flown_alone() -> None:
    roles, (remark,) = roles_of(policy="static-obstacles-fast", workload="estimate")
    assert ALONE not in roles
    assert "is an estimate: not flown alone" in remark


def test_defaults_are_those_of_the_package() -> None:
    command = OPTIONS()
    assert command.policy == DEFAULT_UNMITIGATED
    assert command.mitigated == DEFAULT_MITIGATED


def test_a_missing_mitigated_policy_is_one_clear_line() -> None:
    with (
        patch.object(hardware_gap_experiment, "find_policy", side_effect=_unknown),
        pytest.raises(
            UsageError, match=r"accepted: the folder of a policy .* not among the shipped"
        ),
    ):
        hardware_gap_experiment._mitigated(DEFAULT_MITIGATED)
    with pytest.raises(UsageError, match="no such policy"):
        hardware_gap_experiment._mitigated("somebody")
    assert hardware_gap_experiment._mitigated("none") is None


def _unknown(name: str, **_: object) -> PolicyInfo:
    raise UsageError(f"--policy {name!r}: no such policy; known: greedy")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"episodes": 0}, "--episodes 0"),
        ({"seed": -1}, "--seed -1"),
        (
            {"latency": "150ms", "workload": "template-5x32"},
            "--latency 150ms: accepted: without a workload",
        ),
        ({"latency": "late"}, "--latency late"),
        ({"workload": "template-1x1"}, "template-1x1"),
        ({"reference_workload": "template-1x1"}, "template-1x1"),
        ({"computer": "abacus"}, "abacus"),
        ({"reference": "abacus"}, "abacus"),
        ({"policy": "nobody"}, "nobody"),
        ({"mitigated": DEFAULT_UNMITIGATED}, "accepted: another policy, or none"),
        ({"arena": ("no-obstacles", "no-obstacles")}, "each arena once"),
        ({"arena": ()}, "--arena"),
        ({"arena": ("nowhere",)}, "nowhere"),
        ({"compensate": True}, "--compensate True: accepted: left out"),
    ],
)
def test_what_cannot_be_used(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    out = tmp_path / "out"
    asked: dict[str, Any] = {"mitigated": "none", "out": out} | options
    with pytest.raises(UsageError, match=re.escape(words)) as caught:
        measure(**asked)
    assert "\n" not in f"{caught.value}"
    assert not out.exists()


def roles_of(**asked: Any) -> tuple[list[str], tuple[str, ...]]:
    scenario = Scenario(**({"level": "gym", "computer": "ras-pi-4"} | asked))
    gap = declare_hardware_gap(scenario, mitigated="none")
    return [cell.role for cell in gap.cells], gap.remarks


def test_it_compensates_where_that_can_be(tmp_path: Path) -> None:
    assert roles_of()[0] == list(NOT_RETRAINED)
    assert roles_of(compensate=False) == (["reference", "target", ALONE], ())
    profile = (profiles_dir() / "vehicles" / "quad.toml").read_text()
    (tmp_path / "unknown.toml").write_text(profile.partition("[response]")[0])
    roles, (remark,) = roles_of(vehicle=str(tmp_path / "unknown.toml"))
    assert roles == ["reference", "target", ALONE]
    assert "response of vehicle" in remark
    roles, (remark,) = roles_of(watchdog={"hover_after_s": 0.06})
    assert roles == ["reference", "target", ALONE, "compensated"]
    assert "not pipelined" in remark


# --- how the conditions of a training are read


def training_of(folder: Path) -> tuple[list[Any], tuple[str, ...]]:
    given = {"policy": DEFAULT_UNMITIGATED, "computer": "ras-pi-4", "episodes": EPISODES}
    scenario = Scenario.model_validate(given | {"level": "gym"})
    gap = declare_hardware_gap(scenario, mitigated=str(folder))
    cells = [cell for cell in gap.cells if cell.role == "training"]
    return cells, gap.remarks


def test_training_without_delay_is_flown_without(tmp_path: Path) -> None:
    folder = make_policy(tmp_path / "m", {"computer": "workstation", "native_ms": 2.0})
    (cell,), _ = training_of(folder)
    assert cell.scenario.scenario.latency == "2ms"
    assert cell.scenario.scenario.workload is None
    assert cell.scenario.scenario.computer == "ras-pi-4"


def test_training_on_several_latencies_gives_a_column_for_each(tmp_path: Path) -> None:
    sources = ["lognormal:396ms,20ms", "150ms"]
    folder = make_policy(tmp_path / "m", {"latency": sources})
    cells, _ = training_of(folder)
    assert [cell.scenario.scenario.latency for cell in cells] == sources
    assert [cell.name for cell in cells] == [
        "static-obstacles-training",
        "static-obstacles-training-2",
    ]
    assert {cell.scenario.scenario.latency_seed for cell in cells} == {TRAINING_LATENCY_SEED}
    assert "150ms" in cells[1].title


def test_an_estimate_stays_one(tmp_path: Path) -> None:
    folder = make_policy(tmp_path / "m", {"computer": "ras-pi-4", "workload": "estimate"})
    (cell,), _ = training_of(folder)
    assert (cell.scenario.scenario.computer, cell.scenario.scenario.workload) == (
        "ras-pi-4",
        "estimate",
    )


def test_what_the_column_lacks_is_said(tmp_path: Path) -> None:
    delay = {"computer": "ras-pi-4", "workload": "template-5x32"}
    folder = make_policy(tmp_path / "m", delay, extra=(0.0, 50.0))
    cells, remarks = training_of(folder)
    assert len(cells) == 1
    assert "0 to 50 ms" in remarks[0]


def test_a_card_that_does_not_say_has_no_such_column(tmp_path: Path) -> None:
    cells, remarks = training_of(make_policy(tmp_path / "m", None))
    assert cells == []
    assert "does not say" in remarks[0]


def test_a_card_with_a_wrong_delay_is_one_line(tmp_path: Path) -> None:
    folder = make_policy(tmp_path / "m", {"computer": "ras-pi-4", "lateness": 3})
    with pytest.raises(UsageError, match=r"mitigated: environment\.delay: lateness"):
        training_of(folder)


# --- the words


def test_a_gap_without_its_target_says_nothing(whole: tuple[Path, str], tmp_path: Path) -> None:
    entries = [run.entry for run in load_comparison(whole[0], "hardware-gap").runs][:1]
    gap, runs = build_comparison(whole[0], "hardware-gap", {}, entries)
    assert gap.contrasts == ()
    assert gap.answers == ()
    page = show.write_comparison(gap, runs, tmp_path)
    assert "Hardware gap" not in page.with_suffix(".md").read_text(encoding="utf-8")


# --- as a person uses it


@pytest.mark.nightly
@pytest.mark.slow
def test_ctrl_c_and_again(whole: tuple[Path, str], mitigated: str, tmp_path: Path) -> None:
    """Stopped in the middle by a real signal, the same command ends with the same figures."""
    out = tmp_path / "gap"
    command = [
        sys.executable,
        "-m",
        "airl_mav.cli.main",
        "hardware-gap",
        *("--mitigated", mitigated, "--episodes", f"{EPISODES}", "--out", str(out)),
    ]
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root), "COLUMNS": "100"}
    process = subprocess.Popen(
        command,
        cwd=root,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        # A shell that runs the tests in the background has them, and so this, ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        # Early: a complete run takes only seconds, and this test may be starved.
        first = out / "static-obstacles-reference"
        deadline = time.monotonic() + 120.0
        while not first.exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        text, _ = process.communicate(timeout=120.0)
    finally:
        process.kill()
    assert process.returncode == 130
    line = " ".join(text.split())
    assert f"interrupted: finished flights are kept; resume with --out {out}" in line
    done = subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert data_of(out) == data_of(whole[0])
    assert (out / "hardware-gap.html").exists()

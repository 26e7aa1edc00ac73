"""Model page of a policy: the contents of its card in the format of model hubs."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from airl_mav.cli.sitl_command import weakness
from airl_mav.policy.card import MeasuredResult, read_card
from airl_mav.policy.card_writing import (
    MODEL_CARD_FILE,
    QUALITIES,
    add_result,
    model_card,
    write_card,
)
from airl_mav.profiles.loading import profiles_dir
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

yaml = pytest.importorskip("yaml", reason="needs the [docs] extra")

SHIPPED = sorted(path.parent for path in (profiles_dir() / "policies").glob("*/card.json"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of a shipped policy, without its page."""
    copied = shutil.copytree(profiles_dir() / "policies/no-obstacles", tmp_path / "mine")
    (copied / MODEL_CARD_FILE).unlink()
    return Path(copied)


@pytest.mark.parametrize("shipped", SHIPPED, ids=lambda path: path.name)
def test_the_shipped_pages_say_what_their_cards_say(shipped: Path) -> None:
    card = read_card(shipped)
    page = (shipped / MODEL_CARD_FILE).read_text(encoding="utf-8")
    assert page == model_card(card), "written by airl_mav.policy.card_writing.write_model_card"
    _, front, body = page.split("---\n", 2)
    told = yaml.safe_load(front)
    assert told["library_name"] == "airl-mav"
    assert {"reinforcement-learning", "airl/Navigation-v0", card.algorithm} <= set(told["tags"])
    (entry,) = told["model-index"]
    assert entry["name"] == card.name
    assert len(entry["results"]) == len(card.results)
    for found, result in zip(entry["results"], card.results, strict=True):
        assert result.arena in found["dataset"]["name"]
        values = {metric["type"]: metric["value"] for metric in found["metrics"]}
        # Without a success there are no times.
        measured = {field: getattr(result, field) for field, _, _ in QUALITIES}
        wanted = {field: value for field, value in measured.items() if value is not None}
        assert values == pytest.approx(wanted, abs=1e-4)
    assert f"{card.parameters:,} parameters" in body


def test_a_result_that_is_added_appears_on_the_page(folder: Path) -> None:
    result = MeasuredResult(
        arena='odd "arena": #1', level="lockstep", episodes=20, seed=5, success_rate=0.25
    )
    card = add_result(folder, result)
    page = (folder / MODEL_CARD_FILE).read_text(encoding="utf-8")
    assert page == model_card(card)
    names = [
        each["dataset"]["name"]
        for each in yaml.safe_load(page.split("---\n")[1])["model-index"][0]["results"]
    ]
    assert 'arena odd "arena": #1, level lockstep, seeds 5 to 24' in names
    assert "| 20 | 25.0% | - | - | - |" in page


def test_weak_arenas_are_on_the_page_and_warned_of(folder: Path) -> None:
    write_card(folder, read_card(folder).model_copy(update={"results": ()}))
    weak = MeasuredResult(arena="crowded", level="gym", episodes=200, seed=1, success_rate=0.62)
    add_result(folder, weak)
    late = {"arena": "rooms", "latency": "400ms", "success_rate": 0.1}
    add_result(folder, weak.model_copy(update=late))
    add_result(folder, weak.model_copy(update={"arena": "hall", "success_rate": 0.9}))
    page = (folder / MODEL_CARD_FILE).read_text(encoding="utf-8")
    assert page.endswith("\nDo not fly it in: crowded (62.0%).\n")
    asked = Scenario(policy=str(folder), arena="crowded")
    told = weakness(resolve(asked))
    assert "reaches 62% of the goals in crowded, by its card" in told
    assert "\n" not in told
    for arena in ("rooms", "hall", "park"):
        assert weakness(resolve(asked.model_copy(update={"arena": arena}))) == ""
    assert weakness(resolve(Scenario(policy="greedy", arena="crowded"))) == ""


def test_a_page_of_somebody_s_own_stays(folder: Path) -> None:
    (folder / MODEL_CARD_FILE).write_text("my own words")
    write_card(folder, read_card(folder))
    assert (folder / MODEL_CARD_FILE).read_text() == "my own words"


def test_a_policy_without_results_has_none_on_its_page(folder: Path) -> None:
    card = read_card(folder).model_copy(update={"results": (), "algorithm": "", "description": ""})
    page = model_card(card)
    assert "model-index" not in page
    assert "## Results" not in page
    assert yaml.safe_load(page.split("---\n")[1])["library_name"] == "airl-mav"


def test_a_page_says_that_a_camera_sees_all_round() -> None:
    card = read_card(profiles_dir() / "policies/no-obstacles")
    assert "| sees | depth image of 32x24 px, 90 deg wide" in model_card(card)
    around = {"projection": "cylindrical", "horizontal_fov_deg": 360.0}
    seen = card.observation.model_copy(update=around)
    page = model_card(card.model_copy(update={"observation": seen}))
    assert "| sees | cylindrical depth image of 32x24 px, 360 deg wide" in page

"""8-bit integers: smaller, calibrated on seeds of their own, and deciding as the floats do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx", reason="needs the [profile] extra")

from airl_mav.addons.int8.quantisation import (
    FIRST_SEED,
    FRAMES,
    export_int8,
    frames_of,
    relative_error,
)
from airl_mav.cli import main
from airl_mav.policy.card import ONNX_FILE, PolicyCard, load_card, open_model
from airl_mav.policy.registry import load_learned
from airl_mav.profiles.loading import profiles_dir

DEFAULT = profiles_dir() / "policies" / "static-obstacles"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PolicyCard]:
    folder = tmp_path_factory.mktemp("int8") / "mine"
    return folder, export_int8(DEFAULT, folder)


def test_the_file_is_smaller_and_its_card_says_how_it_was_made(
    exported: tuple[Path, PolicyCard],
) -> None:
    folder, card = exported
    assert load_card(folder) == card
    floats = load_card(DEFAULT)
    size = (folder / ONNX_FILE).stat().st_size
    assert 3 * size < (DEFAULT / ONNX_FILE).stat().st_size + 30_000
    assert card.name == "static-obstacles-int8"
    assert card.results == (), "those in floats are another network's"
    assert (card.observation, card.actions, card.parameters) == (
        floats.observation,
        floats.actions,
        floats.parameters,
    )
    made = card.quantisation
    assert made is not None
    assert (made.source_sha256, made.arena, made.frames) == (
        floats.sha256,
        "static-obstacles",
        FRAMES,
    )
    # Between the seeds for selecting the best weights (from 500,000 on) and for training.
    assert 500_000 + 100_000 < made.first_seed == FIRST_SEED
    assert floats.training.first_arena_seed is not None
    assert made.last_seed < floats.training.first_arena_seed


def test_it_decides_nearly_as_in_floats_on_flights_it_was_not_calibrated_with(
    exported: tuple[Path, PolicyCard],
) -> None:
    folder, card = exported
    made = card.quantisation
    assert made is not None
    assert made.agreement is not None
    assert 0.9 < made.agreement < 1.0
    frames, _, _ = frames_of(folder, flights=20)
    wanted = open_model(DEFAULT, load_card(DEFAULT)).infer(frames)
    found = open_model(folder, card).infer(frames)
    assert 0.0 < relative_error(found, wanted) < 0.1
    assert np.mean(found.argmax(axis=1) == wanted.argmax(axis=1)) > 0.9
    # Where they differ, the floats hardly prefer theirs.
    rows = np.arange(len(wanted))
    lost = wanted.max(axis=1) - wanted[rows, found.argmax(axis=1)]
    assert np.quantile(lost, 0.99) < 0.25 * wanted.std()
    assert load_learned(folder).name == "static-obstacles-int8"


def test_the_same_policy_gives_the_same_file(
    exported: tuple[Path, PolicyCard], tmp_path: Path
) -> None:
    assert export_int8(DEFAULT, tmp_path / "again") == exported[1]


def test_the_command_writes_one_of_continuous_actions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "small"
    with pytest.raises(SystemExit) as ended:
        main.main(["export", "dynamic-obstacles", "--int8", "--out", str(out)])
    assert ended.value.code == 0
    assert "8-bit integers: outputs off by" in " ".join(capsys.readouterr().out.split())
    card = load_card(out)
    assert card.name == "small"
    assert card.quantisation is not None
    assert card.quantisation.agreement is None
    assert card.quantisation.error < 0.1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["greedy"], "accepted: a learned policy; greedy has no network"),
        (["no-such"], "no such policy"),
        (["{int8}"], "accepted: a policy in floats"),
        (["static-obstacles", "--with-torch"], "not with --int8"),
        (["static-obstacles", "--out", str(DEFAULT)], "accepted: another folder"),
    ],
)
def test_what_cannot_be_quantised_is_one_line(
    words: list[str],
    said: str,
    exported: tuple[Path, PolicyCard],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [word.format(int8=exported[0]) for word in words]
    out = [] if "--out" in words else ["--out", str(tmp_path / "x")]
    with pytest.raises(SystemExit) as ended:
        main.main(["export", *words, "--int8", *out])
    assert ended.value.code == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "x").exists()

"""Seeds of the final evaluation are rejected by everything that learns, fits or publishes."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import honest_flights
import pytest

from airl_mav.addons.int8.quantisation import FIRST_SEED, FLIGHTS, frames_of
from airl_mav.addons.sweep.config import load_sweep
from airl_mav.core.errors import EXIT_USAGE, FieldError, UsageError
from airl_mav.envs.navigation_env import FIRST_TRAINING_SEED
from airl_mav.experiments.experiment import rehearse
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.training.config import HELD_OUT_SEED, SELECTION_SEED, check_seeds
from published import declared, record
from published.collect import collect
from tests.support.command_line import airl
from tests.support.processes import ROOT

WHY = "choose a lower one: seeds from 900000 on are held out for the final evaluation"


def test_the_ranges_of_seeds_do_not_overlap() -> None:
    assert SELECTION_SEED + 100_000 < FIRST_SEED
    assert FIRST_SEED + FLIGHTS <= HELD_OUT_SEED == 900_000 < FIRST_TRAINING_SEED


def test_the_last_of_several_seeds_counts() -> None:
    check_seeds(899_999)
    check_seeds(899_990, 10)
    with pytest.raises(FieldError) as refused:
        check_seeds(899_990, 11)
    assert refused.value.line("--seed") == f"--seed 899990: accepted: 0 to 899989; {WHY}"


def test_training_rejects_them(tmp_path: Path) -> None:
    line = f"--seed 900000: accepted: 0 to 899999; {WHY}"
    with pytest.raises(UsageError, match=re.escape(line)):
        airl("train", "static-obstacles", "--seed", "900000", "--out", str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    done = subprocess.run(
        [sys.executable, "-m", "airl_mav.cli.main", "train", "--seed", "900000"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == EXIT_USAGE
    assert done.stderr.strip().splitlines() == [f"error: {line}"]


def test_sweeps_reject_them(tmp_path: Path) -> None:
    text = (ROOT / "profiles/sweeps/tiny.toml").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("seeds = [1, 2]", "seeds = [1, 900_000]"))
    with pytest.raises(UsageError) as refused:
        load_sweep(str(path))
    assert str(refused.value) == f"{path}: seeds = 900000: accepted: 0 to 899999; {WHY}"


def test_the_calibration_of_integers_rejects_them() -> None:
    with pytest.raises(FieldError, match=f"seed 800000: accepted: 0 to 799999; {WHY}"):
        frames_of(ROOT / "profiles/policies/static-obstacles", flights=100_001)


def test_the_fit_of_the_estimation_error_rejects_them() -> None:
    script = ROOT / "scripts/fit-estimation-error"
    words = [sys.executable, str(script), "--seed", "899990", "--flights", "11"]
    done = subprocess.run(
        words, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (EXIT_USAGE, "")
    assert done.stderr == f"--seed 899990: accepted: 0 to 899989; {WHY}\n"


def test_the_table_of_honest_flights_rejects_them(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=rf"seed 900000: accepted: 0 to .*{WHY}"):
        honest_flights.main(["--seed", "900000", "--flights", "1", "--out", str(tmp_path)])


@pytest.mark.parametrize("option", ["--seed 900000", "--seed=900_000", "--arena-seed 900000"])
def test_declarations_of_results_reject_them(option: str, tmp_path: Path) -> None:
    path = tmp_path / "results.toml"
    path.write_text(
        f'[[result]]\nname = "x"\nwhat = "y"\ncommand = "airl evaluate {option}"\n'
        'kind = "run"\nminutes = 1\n'
    )
    name = re.split("[ =]", option)[0]
    with pytest.raises(UsageError) as refused:
        declared.read_declared(path)
    assert str(refused.value) == f"{path}: x: {name} = 900000: accepted: 0 to 899999; {WHY}"


def test_results_with_them_are_neither_written_nor_read(tmp_path: Path) -> None:
    result = json.loads((record.RESULTS / "static-obstacles-fast.json").read_text())
    del result["crc32"]
    result["runs"]["run"]["seed"] = 899_001  # 1,000 flights
    (tmp_path / "x.json").write_text(json.dumps(result))
    with pytest.raises(UsageError, match=rf"seed = 899001: accepted: 0 to 899000; {WHY}"):
        record.read_record("x", tmp_path)


@pytest.mark.parametrize(
    ("field", "seed", "greatest"), [("seed", 899_999, 899_998), ("arena_seed", 900_000, 899_999)]
)
def test_flights_with_them_are_not_collected(
    field: str, seed: int, greatest: int, tmp_path: Path
) -> None:
    asked = Scenario.model_validate(
        {"level": "gym", "policy": "greedy", "episodes": 2, field: seed}
    )
    rehearse(asked, out=tmp_path)
    result = {"name": "x", "what": "y", "command": "airl evaluate", "kind": "run", "minutes": 1}
    with pytest.raises(UsageError, match=rf"{field} {seed}: accepted: 0 to {greatest}; {WHY}"):
        collect(declared.Declared.model_validate(result), tmp_path, "f" * 16)


def test_evaluation_takes_any_seed() -> None:
    assert resolve(Scenario(level="gym", seed=900_000, episodes=2)).seeds[-1] == 900_001

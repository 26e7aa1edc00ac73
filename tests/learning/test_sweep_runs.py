"""Real sweeps: workers, parents and Ctrl-C come and go, the results stay the same."""

from __future__ import annotations

import json
import os
import signal
from contextlib import suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from airl_mav.addons.sweep.config import load_sweep, size_of, trials
from airl_mav.addons.sweep.summary import SweepFolder
from airl_mav.core.errors import EXIT_INTERRUPTED
from airl_mav.experiments import executors
from airl_mav.experiments.executors import open_executor
from airl_mav.policy.card import read_card
from airl_mav.policy.card_writing import NetworkSize
from tests.support.command_line import airl
from tests.support.processes import PATIENCE_S, Running, has_ended, running, wait_until
from tests.support.sweep_kit import TINY, write_sweep_file

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.slow,
    pytest.mark.xdist_group("sweep"),
    pytest.mark.timeout(400),
]

SEED, TRIALS = 6, 2
"""Training seed, and number of trainings (each size is trained once)."""

SMALL = (
    TINY.replace("seeds = [1, 2]", f"seeds = [{SEED}]")
    .replace("steps = 1_000", "steps = 2_000")
    .replace("every = 500", "every = 1_000")
)
"""Long enough to be killed in."""

COMMAND, PLACE = ("-m", "airl_mav.cli.main", "sweep"), "--out"


def sweep(folder: Path, *options: str) -> list[str]:
    """Return the words of a sweep of `SMALL` into `folder`/out."""
    path = write_sweep_file(folder, SMALL)
    return [*COMMAND, f"{path}", PLACE, f"{folder / 'out'}", *options]


def swept(folder: Path, *options: str) -> str:
    """Carry out a sweep in this process, its trainings too; return what it printed."""
    with patch.object(executors, "open_executor", partial(open_executor, in_process=True)):
        code, text = airl("sweep", *sweep(folder, *options)[len(COMMAND) :])
    assert code == 0, text
    return text


def outcome(folder: Path) -> dict[str, Any]:
    """Return all results of a sweep, and digests of their policies, without wall times."""
    data = json.loads((folder / "out" / "sweep.json").read_text(encoding="utf-8"))
    found = {}
    for cell in data["cells"]:
        for result in cell["trials"]:
            del result["trained"]["seconds"]
            trial = result["trial"]
            name = f"{trial['arena']}-{trial['layers']}x{trial['filters']}-seed{trial['seed']}"
            policy = folder / "out" / name / "policy"
            # The weights, to the last bit: the card binds the file by its digest.
            found[name] = result | {"sha256": read_card(policy).sha256}
    return found


def workers_of(parent: Running) -> list[int]:
    """Return the processes that multiprocessing has started for a command."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        with suppress(OSError, IndexError, ValueError):
            ppid = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if ppid == parent.pid and b"spawn_main" in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
    return found


def checkpointed(folder: Path, before: frozenset[str] = frozenset()) -> frozenset[str]:
    """Return the newest checkpoints of trainings that have not ended, less those of before."""
    found = set()
    for latest in folder.glob("out/*/checkpoints/latest"):
        # The file disappears when the training ends.
        with suppress(OSError):
            if not (latest.parents[1] / "result.json").exists():
                found.add(f"{latest.parents[1].name} {latest.read_text(encoding='utf-8')}")
    return frozenset(found) - before


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "said").write_text(swept(folder), encoding="utf-8")
    return folder


@pytest.mark.nightly
def test_a_sweep_trains_judges_and_tells_all(undisturbed: Path) -> None:
    config = load_sweep(f"{undisturbed / 'small.toml'}")
    results = outcome(undisturbed)
    assert list(results) == [t.name for t in sorted(trials(config))]
    assert len(results) == TRIALS
    said = (undisturbed / "said").read_text(encoding="utf-8")
    assert f"seed {SEED}  success" in said
    assert f"{TRIALS}/{TRIALS}  no-obstacles" in said and "Best: " in said
    for trial in trials(config):
        result = results[trial.name]
        assert sum(result["outcomes"].values()) == result["episodes"] == 20
        policy = undisturbed / "out" / trial.name / "policy"
        card = read_card(policy)
        assert NetworkSize(card.parameters, card.macs) == size_of(config, trial)
        assert card.training.seed == trial.seed
        # Files needed only for resuming are deleted.
        assert not (policy.parent / "checkpoints").exists()


def test_a_network_is_judged_as_airl_evaluate_judges_it(undisturbed: Path) -> None:
    name, result = max(outcome(undisturbed).items(), key=lambda item: item[1]["successes"])
    words = ["--arena", "no-obstacles", "--episodes", "20", "--seed", "1"]
    policy, out = undisturbed / "out" / name / "policy", undisturbed / "judged"
    assert airl("evaluate", str(policy), *words, "--out", str(out))[0] == 0
    lines = (undisturbed / "judged" / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    flown = [json.loads(line) for line in lines]
    good = [each["quality"] for each in flown if each["outcome"] == "success"]
    assert len(good) == result["successes"]
    for key in ("flight_time_s", "distance_m", "energy_j"):
        if good:
            mean = sum(each[key] for each in good) / len(good)
            # Its own path and energy come from the recorded trajectory.
            assert mean == pytest.approx(result[key], rel=0.02), key
        else:
            assert result[key] is None


def test_started_again_it_shows_what_it_has_and_trains_nothing(undisturbed: Path) -> None:
    before = outcome(undisturbed)
    said = swept(undisturbed, "--computer", "ras-pi-4")
    assert f"{TRIALS} of {TRIALS} ended" in said
    assert "t2, estimated" in said
    assert f"seed {SEED}  success" not in said
    assert outcome(undisturbed) == before


@pytest.mark.nightly
def test_interrupted_and_killed_it_goes_on_as_if_nothing_had_happened(
    tmp_path: Path, undisturbed: Path
) -> None:
    words = sweep(tmp_path, "--workers", "2")
    with running(words, tmp_path) as process:
        wait_until(lambda: checkpointed(tmp_path), "a checkpoint")
        os.kill(workers_of(process)[0], signal.SIGKILL)
        process.wait_for_text("a worker was lost by SIGKILL")
        process.interrupt()
        assert process.wait() == EXIT_INTERRUPTED, process.text()
        assert f"resume with --out {tmp_path / 'out'}" in process.text()
    before = checkpointed(tmp_path)
    words = sweep(tmp_path, "--workers", "1")
    with running(words, tmp_path) as process:
        wait_until(lambda: checkpointed(tmp_path, before), "another checkpoint")
        workers = workers_of(process)
        process.process.send_signal(signal.SIGKILL)
        process.wait()
        # Files written before the kill are complete.
        config = load_sweep(f"{tmp_path / 'small.toml'}")
        held = SweepFolder(tmp_path / "out", config).results(trials(config))
        assert len(held) < TRIALS
        for pid in workers:
            wait_until(partial(has_ended, pid), "an orphan to end", 30.0)
    with running(words, tmp_path) as process:
        assert process.wait(PATIENCE_S * 2) == 0, process.text()
    assert outcome(tmp_path) == outcome(undisturbed)


@pytest.mark.nightly
def test_two_at_once_are_refused(tmp_path: Path) -> None:
    with running(sweep(tmp_path, "--workers", "1"), tmp_path) as first:
        wait_until(lambda: (tmp_path / "out" / "sweep.json").exists(), "the first")
        # Stopped, so that it cannot end while the second waits for its processes.
        first.process.send_signal(signal.SIGSTOP)
        try:
            with running(sweep(tmp_path), tmp_path) as second:
                assert second.wait() == 2, second.text()
                assert "another run flies into it" in second.text()
        finally:
            first.process.send_signal(signal.SIGCONT)
        assert first.process.poll() is None


@pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed: airl-mav[ray]")
def test_ray_comes_to_the_same_results(tmp_path: Path, undisturbed: Path) -> None:
    words = sweep(tmp_path, "--executor", "ray", "--workers", "2")
    with running(words, tmp_path) as process:
        assert process.wait(PATIENCE_S * 2) == 0, process.text()
    assert outcome(tmp_path) == outcome(undisturbed)


@pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed: airl-mav[ray]")
def test_a_killed_task_of_ray_begins_again(
    tmp_path: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Inherited only by the workers of this Ray instance.
    mark = f"AIRL_SWEEP_TEST={tmp_path}"
    monkeypatch.setenv(*mark.split("="))
    with running(sweep(tmp_path, "--executor", "ray", "--workers", "1"), tmp_path) as process:
        wait_until(lambda: checkpointed(tmp_path), "a checkpoint")
        for entry in Path("/proc").iterdir():
            with suppress(OSError):
                if (entry / "cmdline").read_bytes().startswith(b"ray::_carry_out"):  # noqa: SIM102
                    if mark.encode() in (entry / "environ").read_bytes():
                        os.kill(int(entry.name), signal.SIGKILL)
        assert process.wait(PATIENCE_S * 2) == 0, process.text()
        assert "a worker was lost by" in process.text()
    assert outcome(tmp_path) == outcome(undisturbed)

"""Policies that fail: one line at load, else a failed flight that is the same at all levels."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

pytest.importorskip("onnx", reason="needs the [train] extra")

from airl_mav.cli.options import carry_out
from airl_mav.core import child_process
from airl_mav.core.errors import UsageError
from airl_mav.experiments import gym_flier
from airl_mav.experiments.experiment import load_run
from airl_mav.policy import card as cards
from airl_mav.policy import registry
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support import hostile_policies
from tests.support.processes import wait_until

LEVELS = ["gym", "lockstep", pytest.param("sitl", marks=pytest.mark.nightly)]
GIB = 1 << 30


@pytest.fixture(autouse=True)
def no_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the records of passed trials apart."""
    monkeypatch.setattr(cards, "writable_folder", lambda name: tmp_path)


AT_LOAD = {
    "nan": "its output is not a number",
    "huge": "its inference fails: .*Failed to allocate memory",
    "wide": r"outputs action .*; accepted: action tensor\(float\) \(n, 25\)",
    "rows": r"output action \(4, 25\); accepted: \(2, 25\)",
    "raises": "its inference fails: .*indices element out of data bounds",
    "endless": r"its inference takes more than 1 s",
    "slow": r"its inference takes more than 1 s",
}


@pytest.mark.parametrize("name", AT_LOAD)
def test_a_policy_that_always_fails_is_refused_at_load(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cards, "TRIAL_S", 1.0 if name in ("endless", "slow") else 20.0)
    folder = hostile_policies.write(tmp_path, name)
    for _ in range(2):  # A failure is not recorded as a passed trial.
        with pytest.raises(UsageError, match=rf"policy\.onnx: {AT_LOAD[name]}") as refused:
            registry.find_policy(str(folder))
        assert "\n" not in str(refused.value)


def test_a_passed_trial_is_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = hostile_policies.write(tmp_path, "sound")
    registry.load_policy(str(folder), 0.5)
    monkeypatch.setattr(cards, "run_limited", None)
    registry.load_policy(str(folder), 0.5)
    registry.load_policy("static-obstacles", 0.5)  # Of this package: no trial.
    other = hostile_policies.write(tmp_path / "other", "nan")
    with pytest.raises(TypeError):
        registry.load_policy(str(other), 0.5)


@pytest.mark.parametrize(
    ("function", "ending"),
    [("abort", "ended by SIGABRT"), ("devour", "ended by exit status 1 with 512 MiB of memory")],
)
def test_a_crash_of_a_trial_is_one_line(function: str, ending: str) -> None:
    name = f"{hostile_policies.__name__}:{function}"
    with pytest.raises(ValueError, match=ending):
        child_process.run_limited(name, b"", GIB // 2, 20.0)


def test_ctrl_c_ends_a_trial(tmp_path: Path) -> None:
    folder = hostile_policies.write(tmp_path, "endless")
    words = [sys.executable, "-m", "airl_mav.cli.main", "evaluate", str(folder), "--level", "gym"]
    words += ["--out", str(tmp_path / "run")]
    # A job in the background of a script ignores SIGINT.
    restored = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(words, stderr=subprocess.PIPE, preexec_fn=restored) as airl:
        process = psutil.Process(airl.pid)
        wait_until(lambda: bool(process.children()), "the trial", 60.0)
        time.sleep(1.0)
        airl.send_signal(signal.SIGINT)
        assert airl.communicate(timeout=10.0)[1] == b""
        assert airl.returncode == 130


FAILURES = {
    "nan later": "ValueError: the network's output is not a number",
    "raises later": "indices element out of data bounds",
    "endless later": r"TimeoutError: no output in [0-9.]+ s per observation",
}


def fly(folder: Path, level: str, out: Path, *words: str) -> Any:
    """Fly two episodes; return the exit code and the run."""
    given = [str(folder), "--level", level, "--episodes", "2", "--out", str(out), *words]
    given += ["--no-validity", "--speed", "1"] if level == "sitl" else []
    code = carry_out("airl evaluate", "airl_mav.cli.evaluate_command", given)
    return code, load_run(out)


@pytest.mark.parametrize("name", FAILURES)
@pytest.mark.parametrize("level", LEVELS)
def test_a_policy_that_fails_in_flight_ends_it_alike_at_all_levels(
    name: str, level: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cards, "INFERENCE_S", 0.5)
    code, run = fly(hostile_policies.write(tmp_path, name), level, tmp_path / "run")
    assert code == 0
    for episode in run.episodes:
        assert episode.outcome.value == "aborted"
        assert episode.reason.startswith("policy failed: ")
        assert re.search(FAILURES[name], episode.reason)
        assert "\n" not in episode.reason


PYTHON = """
from airl_mav.policy.actions import Action

class Raiser:
    def act(self, observation):
        if abs(observation.velocity).max() > 0.1:
            raise RuntimeError("out of\\nideas")
        return Action(1.0, 0.0, 0.0)
"""


@pytest.mark.parametrize("level", LEVELS)
def test_a_python_policy_that_raises_ends_the_flight(level: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(PYTHON)
    code, run = fly(Path(f"{tmp_path / 'mine.py'}:Raiser"), level, tmp_path / "run")
    assert code == 0
    for episode in run.episodes:
        assert episode.outcome.value == "aborted"
        assert episode.reason == "policy failed: RuntimeError: out of ideas"


def test_a_failure_does_not_change_the_flights_beside_it(tmp_path: Path) -> None:
    commands, failed = {}, {}
    for name in ("sound", "nan later"):
        scenario = Scenario(policy=str(hostile_policies.write(tmp_path, name)), level="gym")
        resolved = resolve(scenario)
        navigation, pilots = gym_flier.navigation_of(resolved, 4), gym_flier.pilots_of(resolved)
        navigation.begin(range(4), range(1, 5))
        for slot in range(4):
            pilots.begin(slot, slot + 1)
        seen = navigation.see()
        seen.velocity[:] = [[0.0], [0.0], [0.5], [0.0]]
        commands[name] = pilots.decide(seen, np.array([True, True, True, False]))
        failed[name] = pilots.failed
    assert failed["sound"] == {}
    assert failed["nan later"] == {2: f"policy failed: {FAILURES['nan later']}"}
    np.testing.assert_array_equal(commands["nan later"][:2], commands["sound"][:2])

"""The same latency file flown at every level: each decision has the latency of the trace."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav import rehearse
from airl_mav.core.constants import TICK_US
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.scenario.model import LevelName, Scenario
from tests.support.flown_here import flown_here
from tests.support.ports import choose_ports
from tests.support.processes import ROOT, SITL_WITHOUT_REPORT

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("latency-levels")]

POLICY, ARENA, EPISODES, SEED = "no-obstacles", "no-obstacles", 2, 700

TRACE_MS = [40.0 + 3.0 * k for k in range(101)]
"""Ramp: each value identifies its index, and consecutive values stay consecutive."""


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("latency") / "ramp.txt"
    file.write_text("".join(f"{value}\n" for value in TRACE_MS))
    return file


def fly(level: LevelName, trace: Path, out: Path, draw: int = 0) -> LoadedRun:
    scenario = Scenario(
        policy=POLICY,
        arena=ARENA,
        episodes=EPISODES,
        seed=SEED,
        level=level,
        latency=str(trace),
        latency_seed=draw,
        workers=1,
    )
    with flown_here():
        rehearse(scenario, out=out)
    return load(out)


@pytest.fixture(scope="module")
def twin(trace: Path, tmp_path_factory: pytest.TempPathFactory) -> LoadedRun:
    return fly("gym", trace, tmp_path_factory.mktemp("gym") / "run")


@pytest.fixture(scope="module")
def lockstep(trace: Path, tmp_path_factory: pytest.TempPathFactory) -> LoadedRun:
    return fly("lockstep", trace, tmp_path_factory.mktemp("lockstep") / "run")


def t2_us(run: LoadedRun, index: int) -> NDArray[np.int64]:
    stamps = run.latency[index]
    lasted: NDArray[np.int64] = stamps["action_ready_us"] - stamps["infer_start_us"]
    return lasted


def expected_us(first_us: float, n: int) -> NDArray[np.float64]:
    """Return the trace from its value nearest to the first decision's on, round and round."""
    values = 1e3 * np.array(TRACE_MS)
    start = int(np.abs(values - first_us).argmin())
    return values[(start + np.arange(n)) % len(values)]


@pytest.mark.parametrize("level", ["twin", pytest.param("lockstep", marks=pytest.mark.nightly)])
def test_the_trace_is_replayed_in_its_order(level: str, request: pytest.FixtureRequest) -> None:
    run = request.getfixturevalue(level)
    starts = set()
    for index in range(EPISODES):
        taken = t2_us(run, index)
        assert len(taken) > 5
        assert np.abs(taken - expected_us(taken[0], len(taken))).max() <= TICK_US
        starts.add(int(taken[0]))
    assert len(starts) == EPISODES  # each episode begins somewhere else


def test_the_same_episode_is_as_late_at_every_level(twin: LoadedRun, lockstep: LoadedRun) -> None:
    for index in range(EPISODES):
        first, second = t2_us(twin, index), t2_us(lockstep, index)
        n = min(len(first), len(second))
        assert np.abs(first[:n] - second[:n]).max() <= TICK_US


def test_another_latency_seed_changes_the_latency_alone(
    twin: LoadedRun, trace: Path, tmp_path: Path
) -> None:
    other = fly("gym", trace, tmp_path / "run", draw=1)
    for index in range(EPISODES):
        assert t2_us(other, index)[0] != t2_us(twin, index)[0]
        first, second = twin.trajectories[index], other.trajectories[index]
        assert np.array_equal(first.position[0], second.position[0])
        assert twin.episodes[index].goal == other.episodes[index].goal


@pytest.mark.nightly  # In real time, in one process: test_latency_injection.py.
def test_two_processes_are_as_late_in_simulated_time(trace: Path, tmp_path: Path) -> None:
    """airl-sitl at four times the speed: a decision takes its trace's time, or a little more."""
    out = tmp_path / "run"
    words = [
        *(sys.executable, *SITL_WITHOUT_REPORT, *choose_ports().options()),
        *("--policy", POLICY, "--arena", ARENA, "--episodes", "1", "--seed", f"{SEED}"),
        *("--latency", str(trace), "--speed", "4", "--out", str(out)),
    ]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    run = load(out)
    taken = t2_us(run, 0)
    assert len(taken) > 5
    told = expected_us(1e3 * TRACE_MS[draw_of(SEED)], len(taken))
    # Sleeping ends late on a busy machine, never early; where the host gave up time, the
    # simulator's clock has seen less of it.
    assert (taken >= told - 1 - run.episodes[0].slipped_us).all()


def draw_of(seed: int) -> int:
    """Return where an episode's replay begins."""
    return int(np.random.default_rng(seed).integers(len(TRACE_MS)))

"""`from airl_mav import ...`: the Python API gives what the commands give, and prints nothing."""

from __future__ import annotations

import shutil
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import airl_mav
from airl_mav import Run, Scenario, evaluate, latency_sweep, load_run, rehearse
from airl_mav.core.errors import UsageError
from airl_mav.experiments.campaign import EpisodeSaver
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.rehearsal import RehearsalError
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.report import run_report
from airl_mav.report.comparison import show
from tests.support.campaign_kit import same_runs
from tests.support.command_line import airl, option_words
from tests.support.page_alone import page_alone

GYM: dict[str, Any] = {"policy": "greedy", "arena": "no-obstacles", "seed": 20}


EARLIER_RUN = Path(__file__).parents[1] / "support" / "earlier_run"
"""`airl evaluate greedy --arena no-obstacles --episodes 1 --seed 3` of an earlier version."""


def asked(**changes: Any) -> Scenario:
    return Scenario(**({"level": "gym", "episodes": 6} | GYM | changes))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    scenario = asked(computer="ras-pi-4", workload="template-5x32")
    return rehearse(scenario, out=tmp_path_factory.mktemp("api") / "run")


def test_all_public_names_are_there() -> None:
    assert set(airl_mav.__all__) <= set(dir(airl_mav))
    assert all(callable(getattr(airl_mav, name)) for name in airl_mav.__all__)
    with pytest.raises(AttributeError, match="no attribute 'fly'"):
        _ = airl_mav.fly


def test_a_run_says_all_that_was_flown(flown: Run) -> None:
    assert flown.complete
    assert [(e.index, e.seed) for e in flown.episodes] == [(i, 20 + i) for i in range(6)]
    assert flown.info.config["policy"] == "greedy"
    reached = np.mean([e.outcome == "success" for e in flown.episodes])
    assert flown.quality.success_rate.value == pytest.approx(reached)
    # t2 in microseconds: the paper's network on its Raspberry Pi takes 396 ms.
    assert flown.latency["t2"].mean() == pytest.approx(396_000, rel=0.02)
    stamps = flown.stamps
    each = [s["action_ready_us"] - s["infer_start_us"] for s in stamps.values()]
    ended = [s["action_ready_us"] >= 0 for s in stamps.values()]
    by_hand = np.concatenate([t2[done] for t2, done in zip(each, ended, strict=True)])
    assert sorted(flown.latency["t2"]) == sorted(by_hand)
    assert sorted(flown.trajectories) == list(range(6))
    path = flown.trajectories[0]
    assert isinstance(path, Trajectory)
    assert path.position.shape == (len(path.time_us), 3)
    assert path.time_us[-1] == flown.episodes[0].ended_us


def test_a_run_is_read_again(flown: Run, tmp_path: Path) -> None:
    again = load_run(str(flown.path))
    assert again.episodes == flown.episodes
    with pytest.raises(UsageError, match="no run here"):
        load_run(tmp_path)


def test_its_report_is_a_page(
    flown: Run, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_report, "MAX_PICTURED", 0)
    with page_alone():
        page = flown.report()
    assert page == flown.path / "report.html"
    assert page.read_text(encoding="utf-8").rstrip().endswith("</html>")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "level",
    ["gym", pytest.param("lockstep", marks=pytest.mark.nightly)],  # test_evaluate_lockstep.py
)
def test_it_flies_what_the_command_flies_and_is_silent(
    level: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    scenario = asked(level=level, episodes=1, workers=1)
    run = rehearse(scenario, out=tmp_path / "api")
    assert capfd.readouterr() == ("", "")
    words = option_words(level=level, arena="no-obstacles", episodes=1, seed=20, workers=1)
    code, text = airl("evaluate", "greedy", *words, "--out", str(tmp_path / "command"))
    assert code == 0
    assert same_runs(load_run(tmp_path / "command")._loaded, run._loaded)
    # Flights of the other levels carry no fingerprint.
    assert (run.sha256 is not None) == (level == "lockstep")
    if level == "lockstep":
        assert f"sha256 of the flights  {run.sha256}" in text
        assert {"t1", "t2", "t3", "link", "control", "end_to_end"} <= set(run.latency)
        assert set(run.latency["t2"]) == {1_000}


def test_with_progress_it_draws_on_standard_error_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rehearse(asked(episodes=1), out=tmp_path / "run", progress=True)
    rehearse(asked(episodes=1), out=tmp_path / "run", progress=True)
    out, err = capfd.readouterr()
    assert out == ""
    assert "1 of 1 episodes are there" in err


def test_ctrl_c_is_raised_and_the_same_folder_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = rehearse(asked(), out=tmp_path / "whole")
    real, seen = EpisodeSaver.add, []

    def interrupted(saver: EpisodeSaver, episode: FlownEpisode) -> None:
        real(saver, episode)
        seen.append(episode)
        if len(seen) == 2:
            signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patched:
        patched.setattr(EpisodeSaver, "add", interrupted)
        with pytest.raises(KeyboardInterrupt):
            rehearse(asked(slots=1), out=tmp_path / "run")
    assert signal.getsignal(signal.SIGINT) is before
    held = load_run(tmp_path / "run")
    assert not held.complete
    assert held.episodes == whole.episodes[:2]
    run = rehearse(asked(), out=tmp_path / "run")
    assert same_runs(run._loaded, whole._loaded)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy": "telepathy"}, "policy 'telepathy'"),
        ({"level": "gym", "speed": 2.0}, "speed 2: accepted: at level lockstep or sitl"),
        ({"hold_s": 0.01}, "hold_s 0.01"),
        ({"latency": "soon"}, "soon"),
    ],
)
def test_what_cannot_be_flown_is_one_line(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=message) as error:
        rehearse(asked(**changes), out=tmp_path / "run")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


def test_another_run_is_not_mixed_in(flown: Run) -> None:
    with pytest.raises(UsageError, match="holds a run with computer"):
        rehearse(asked(), out=flown.path)


@pytest.mark.nightly
def test_it_flies_in_a_thread(tmp_path: Path) -> None:
    """Python delivers no signals in a thread, as in a notebook's executor or a server."""
    found: dict[str, Any] = {}

    def work() -> None:
        for level in ("gym", "lockstep"):
            try:
                found[level] = rehearse(asked(level=level, episodes=1), out=tmp_path / level)
            except BaseException as error:
                found[level] = error

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    for level in ("gym", "lockstep"):
        assert isinstance(found[level], Run), found[level]
        assert found[level].complete


def test_a_run_that_was_broken_off_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from airl_mav.experiments import campaign
    from tests.support.worker_jobs import PaperFlier

    monkeypatch.setitem(campaign.FLIERS, "gym", lambda _: PaperFlier({}, deadly=20))
    with pytest.raises(RehearsalError, match="seed 20: lost 3 workers, the last one by SIGKILL"):
        rehearse(asked(episodes=1, workers=2), out=tmp_path / "run")


def test_a_run_of_an_earlier_version_is_read_but_not_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_report, "MAX_PICTURED", 0)
    out = tmp_path / "run"
    shutil.copytree(EARLIER_RUN, out)
    run = load_run(out)
    assert run.complete
    assert [(e.seed, e.outcome) for e in run.episodes] == [(3, "success")]
    assert set(run.latency["t2"]) == {1_000}
    code, text = airl("report", str(out), width=100)
    assert code == 0
    assert "1 goal reached" in text
    with pytest.raises(UsageError, match=r"holds a run with .*accepted: a new folder"):
        rehearse(asked(seed=3, episodes=1), out=out)
    for file in EARLIER_RUN.iterdir():
        assert (out / file.name).read_bytes() == file.read_bytes()
    # It flew what the same release of PX4 flies now, bit by bit, on the power of its day: a hover
    # took 434 W, not 186.
    again = rehearse(asked(seed=3, episodes=1, px4_release="1.16"), out=tmp_path / "again")
    now, then = again.trajectories[0], run.trajectories[0]
    for name in ("time_us", "position", "velocity", "quaternion"):
        assert np.array_equal(getattr(now, name), getattr(then, name)), name
    assert then.power_w.mean() > 2.0 * now.power_w.mean() > 300.0


def test_policies_in_arenas(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arenas = ("no-obstacles", "static-obstacles")
    with page_alone():
        found = evaluate(asked(episodes=2), ("greedy",), arenas, out=tmp_path / "table")
    assert capfd.readouterr() == ("", "")
    assert list(found.runs) == [f"greedy-{arena}" for arena in arenas]
    assert found.page.exists()
    assert [run.quality.success_rate.n for run in found.comparison.runs] == [2, 2]
    alone = rehearse(asked(episodes=2), out=tmp_path / "alone")
    assert same_runs(found.runs["greedy-no-obstacles"]._loaded, alone._loaded)


def test_the_latency_curve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "curve"
    words = option_words(
        latencies=("native", "150ms", "400ms"),
        arena="no-obstacles",
        episodes=3,
        seed=20,
        out=out,
    )
    with page_alone():
        code, text = airl("latency-sweep", "greedy", *words)
    assert code == 0
    for name in ("latency-sweep.json", "latency-sweep.html", "latency-sweep.md"):
        assert (out / name).stat().st_size > 1000
    assert str(out / "latency-sweep.html") in text
    # Python returns the same figures without new flights; a longer curve resumes.
    monkeypatch.setattr(show, "write_document", lambda _, folder: folder / "none.html")
    found = latency_sweep(
        asked(episodes=3), ("native", "150ms", "400ms", "950ms"), ("greedy",), out=out
    )
    assert list(found.runs) == [f"greedy-{name}" for name in ("native", "150ms", "400ms", "950ms")]
    means = [run.latency["t2"].mean() / 1e3 for run in found.runs.values()]
    assert means == pytest.approx([1.0, 150.0, 400.0, 950.0], abs=1.0)
    contrasts = found.comparison.contrasts
    assert {(c.entry.reference, c.entry.target) for c in contrasts} >= {
        ("greedy-native", f"greedy-{latency}") for latency in ("150ms", "400ms", "950ms")
    }
    assert {contrast.pairs for contrast in contrasts} == {3}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--latencies", "native"), "--latencies native: accepted: two or more"),
        (("--latencies", "native", "native"), "accepted: two or more, each once"),
        (("--latencies", "native", "late"), "--latency late"),
        (("--policies", "nobody"), "nobody"),
        (("--episodes", "0"), "--episodes 0"),
    ],
)
def test_a_curve_that_cannot_be_flown(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    if words[0] == "--policies":
        words = words[1:]
    with pytest.raises(UsageError, match=message):
        airl("latency-sweep", *words, "--out", str(tmp_path / "curve"))
    assert not (tmp_path / "curve").exists()

"""Code of results: fingerprint, resume of other code, comparison of runs of different code."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from airl_mav.addons.fault_matrix import matrix
from airl_mav.core import machine
from airl_mav.core.errors import UsageError
from airl_mav.core.machine import check_code, code_now, code_of, flown_with, mixed_code
from airl_mav.experiments.campaign import load_campaign, open_campaign
from airl_mav.experiments.executors import ProcessExecutor
from airl_mav.rehearsal.run_folder import EPISODES_FILE, RUN_FILE, load, open_folder
from airl_mav.report.comparison.show import compare_folders, judge_comparison
from airl_mav.report.run_tables import setup_rows
from airl_mav.report.run_verdict import verdict_of
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.training.config import TrainingConfig
from airl_mav.training.training_folder import CONFIG_FILE, TrainingFolder
from tests.support import worker_jobs
from tests.support.campaign_kit import cells, declared
from tests.support.run_demo import write_demo_run

OTHER = {"numpy": "0.1"}
MADE: dict[str, Any] = {"versions": machine.package_versions(), "git": machine.git_state()}
OLD = {**MADE, "versions": {**MADE["versions"], **OTHER}}
ANOTHER_COMMIT = {**MADE, "git": {"commit": "0123456789abcdef", "changed": False}}


def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change a JSON file by hand; without its CRC it is read unchecked."""
    data = json.loads(path.read_text())
    change(data)
    data.pop("crc32", None)
    path.write_text(json.dumps(data) + "\n")


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    generated = "__pycache__/mavlink/dialect.py"
    for name in ("core/a.py", "core/a.toml", "report/page.py", "_profiles/quad.toml", generated):
        file = tmp_path / "airl_mav" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(name)
    for name in ("companion/b.py",):
        file = tmp_path / name
        file.parent.mkdir(parents=True)
        file.write_text(name)
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "decides"),
    [
        ("airl_mav/core/a.py", True),
        ("airl_mav/core/a.toml", True),
        ("companion/b.py", True),
        ("airl_mav/_profiles/quad.toml", False),
        ("airl_mav/report/page.py", False),
        ("airl_mav/__pycache__/mavlink/dialect.py", False),
    ],
)
def test_the_digest_covers_what_decides_flights(checkout: Path, name: str, decides: bool) -> None:
    before = machine.sources_digest.__wrapped__()
    (checkout / name).write_text("changed")
    assert (machine.sources_digest.__wrapped__() != before) is decides


def test_the_fingerprint_depends_on_packages_that_fly() -> None:
    def with_version(name: str) -> str:
        return code_of({**MADE, "versions": {**MADE["versions"], name: "0"}})

    assert code_of(MADE) == code_now()
    assert with_version("numpy") != code_now()
    assert with_version(machine.SOURCES) != code_now()
    assert with_version("matplotlib") == code_now()
    assert code_of({**MADE, "git": None}) == code_now().partition("@")[0]


def test_another_commit_of_the_same_code_is_reported() -> None:
    lines: list[str] = []
    check_code("x", ANOTHER_COMMIT, mixed=False, say=lines.append)
    (line,) = lines
    assert "@0123456789" in line and code_now() in line


def test_other_code_of_a_single_flight_is_refused() -> None:
    check_code("x", MADE, [code_now()], mixed=False)
    for other in ("0123456789ab@0123456789", None):
        with pytest.raises(UsageError, match="--mixed-code"):
            check_code("x", MADE, [code_now(), other], mixed=False)


@pytest.mark.parametrize("made", [{}, {"versions": 7, "git": 7}, {"versions": {"numpy": []}}])
def test_a_damaged_provenance_is_unknown_code(made: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=r"^x: flown with code .*--mixed-code$"):
        check_code("x", made, mixed=False)


def scenario(**changes: Any) -> Scenario:
    return Scenario(level="gym", policy="greedy", arena="no-obstacles", seed=7, **changes)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a run of two planned flights, of which one was flown, by other code."""
    folder, _ = open_folder(tmp_path / "run", "demo", resolve(scenario(episodes=2)))
    write_demo_run(tmp_path / "demo", 1)
    line = json.loads((tmp_path / "demo" / EPISODES_FILE).read_text())
    line |= {"code": code_of(OLD), "latency_crc32": None, "trajectory_crc32": None}
    line.pop("crc32")
    (folder.path / EPISODES_FILE).write_text(json.dumps(line) + "\n")
    edit(folder.path / RUN_FILE, lambda data: data.update(OLD))
    return folder.path


def test_a_run_of_other_code_is_resumed_on_request_only(run: Path) -> None:
    with pytest.raises(UsageError) as refused:
        open_folder(run, "demo", resolve(scenario(episodes=2)))
    line = str(refused.value)
    assert code_of(OLD) in line and code_now() in line and "\n" not in line
    assert "numpy 0.1, not " in line
    assert line.endswith("accepted: a new folder, the same code, or --mixed-code")
    lines: list[str] = []
    asked = resolve(scenario(episodes=2, mixed_code=True))
    _, done = open_folder(run, "demo", asked, lines.append)
    assert len(done) == 1
    assert "several versions of the code" in lines[0]


def test_an_edited_commit_does_not_pass_without_a_word(run: Path) -> None:
    edit(run / RUN_FILE, lambda data: data.update(ANOTHER_COMMIT))
    (run / EPISODES_FILE).unlink()
    lines: list[str] = []
    open_folder(run, "demo", resolve(scenario(episodes=2)), lines.append)
    assert len(lines) == 1
    assert "another commit" in lines[0]


def test_a_report_and_a_verdict_name_all_versions(tmp_path: Path) -> None:
    write_demo_run(tmp_path / "run", 2)
    run = load(tmp_path / "run")
    one, two = run.episodes
    assert mixed_code([one.code, two.code]) == ()
    mixed = replace(run, episodes=(one, replace(two, code=code_of(OLD))))
    sentence = f"Flown with 2 versions of the code: {code_now()} (1 flights), {code_of(OLD)}"
    assert sentence in verdict_of(mixed).lines[-1]
    assert dict(setup_rows(run))["flown with"] == code_now()
    assert code_of(OLD) in dict(setup_rows(mixed))["flown with"]
    assert flown_with([None]) == ""


def test_a_comparison_of_runs_of_different_code_says_so(tmp_path: Path) -> None:
    paths = [tmp_path / "a", tmp_path / "b"]
    for path in paths:
        write_demo_run(path, 1)
    edit(paths[1] / EPISODES_FILE, lambda line: line.update(code=code_of(OLD)))
    comparison, loaded = compare_folders(paths)
    assert "flown with" in comparison.different
    assert "2 versions of the code" in judge_comparison(comparison, loaded).lines[-1]


def test_a_campaign_of_other_code_is_resumed_on_request_only(tmp_path: Path) -> None:
    asked = declared(cells())
    with open_campaign(tmp_path, asked, command="a test"):
        pass
    edit(tmp_path / "campaign.json", lambda data: data["made"].update(OLD))
    with (
        pytest.raises(UsageError, match="--mixed-code"),
        open_campaign(tmp_path, asked, command="a test"),
    ):
        pass
    with open_campaign(tmp_path, asked, command="a test", mixed=True):
        assert load_campaign(tmp_path).made["versions"] == OLD["versions"]


def test_a_training_of_other_code_is_resumed_on_request_only(tmp_path: Path) -> None:
    config = TrainingConfig(description="a test")
    TrainingFolder.begin(tmp_path, config, "a test", resume=False)
    edit(tmp_path / CONFIG_FILE, lambda data: data.update(OLD))
    with pytest.raises(UsageError, match="--mixed-code"):
        TrainingFolder.begin(tmp_path, config, "a test", resume=True)
    for _ in range(2):
        folder = TrainingFolder.begin(tmp_path, config, "a test", resume=True, mixed=True)
        assert folder.about()["resumed_with"] == [code_now()]


def test_a_fault_matrix_of_other_code_is_resumed_on_request_only(tmp_path: Path) -> None:
    file = tmp_path / "faults.json"
    matrix.save(matrix.Matrix(OLD, "a vehicle", ()), file)
    with pytest.raises(UsageError, match="--mixed-code"):
        matrix.resumed(file, MADE, "a vehicle", mixed=False)
    assert matrix.resumed(file, MADE, "a vehicle", mixed=True).made == OLD


def test_a_worker_with_other_code_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("airl_mav.experiments.executors.package_versions", lambda: OLD["versions"])
    with ProcessExecutor(1) as executor, pytest.raises(UsageError) as refused:
        list(executor.run(range(2), worker_jobs.pairs))
    line = str(refused.value)
    assert "has other code: numpy " in line
    assert "not 0.1; accepted: the same versions" in line

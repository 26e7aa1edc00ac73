"""`airl view` rejects a wrong run, prints its address, and only then compiles and draws."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from airl_mav.addons.view.replayed_flight import ReplayedFlight, ReplayedRun
from airl_mav.cli.main import main
from airl_mav.flight.episode_record import EpisodeRecord
from tests.support.processes import ROOT
from tests.support.run_demo import write_demo_run

pytest.importorskip("viser")

TOLD = """
import sys
from airl_mav.core.progress import new_console
from airl_mav.addons.view import command

class Told:
    encoding = "utf-8"
    def write(self, text):
        if "http://127.0.0.1:" in text:
            heavy = {"matplotlib", "numba", "scipy", "airl_mav.arena.generate"} & set(sys.modules)
            assert not heavy, heavy
            print("told")
            raise KeyboardInterrupt
    def flush(self):
        pass

console = new_console()
console.file = Told()
sys.exit(command.run(command.ViewOptions(run=sys.argv[1]), console))
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    written, _ = write_demo_run(tmp_path_factory.mktemp("start") / "run", episodes=2)
    return written.path


@pytest.fixture
def folder(flown: Path, tmp_path: Path) -> Path:
    """A run folder that a test may damage."""
    return Path(shutil.copytree(flown, tmp_path / "run"))


def test_the_address_is_told_before_anything_compiles(flown: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", TOLD, str(flown)],
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, "told\n"), done.stderr


def no_run(folder: Path) -> None:
    (folder / "run.json").unlink()


def no_flight(folder: Path) -> None:
    (folder / "episodes.jsonl").write_text("")


def a_torn_archive(folder: Path) -> None:
    path = folder / "trajectories.npz"
    path.write_bytes(path.read_bytes()[:100])


def a_changed_line(folder: Path) -> None:
    path = folder / "episodes.jsonl"
    path.write_text(path.read_text().replace('"seed":', '"seed":1', 1))


def another_arena(folder: Path, name: str) -> None:
    """Let the flights name another arena."""
    path = folder / "episodes.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    for line in lines:
        del line["crc32"]  # Without it a line is read unchecked.
        line["arena"] = name
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))


def no_arena(folder: Path) -> None:
    another_arena(folder, str(folder / "gone.toml"))


def an_arena_of_foreign_code(folder: Path) -> None:
    profile = folder / "foreign.toml"
    shipped = (ROOT / "profiles/arenas/static-obstacles.toml").read_text()
    profile.write_text(f'generator = "{folder}/foreign.py:make"\n{shipped}')
    another_arena(folder, str(profile))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (no_run, "no run here: run.json"),
        (no_flight, "no flight is recorded"),
        (a_torn_archive, "trajectories.npz: arrays of episode 0"),
        (a_changed_line, "episodes.jsonl:1: damaged"),
        (no_arena, "gone.toml"),
        (an_arena_of_foreign_code, "accepted: with --trust"),
    ],
)
def test_a_wrong_run_is_one_line_and_nothing_is_served(
    folder: Path,
    damage: Callable[[Path], None],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    damage(folder)
    refused(folder, said, monkeypatch, capsys)


def test_a_flight_that_is_not_there_is_one_line_and_nothing_is_served(
    flown: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(flown, "FLIGHT 7: accepted: 0 to 1", monkeypatch, capsys, "7")


def refused(
    folder: Path,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *words: str,
) -> None:
    def serve(_port: int) -> None:
        raise AssertionError("it is served")

    monkeypatch.setattr("airl_mav.addons.view.view_server.LocalServer", serve)
    with pytest.raises(SystemExit) as end:
        main(["view", str(folder), *words])
    out, err = capsys.readouterr()
    assert (end.value.code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert said in err


def test_the_flight_is_shown_before_its_arena_and_before_anyone_looks(
    flown: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from airl_mav.addons.view.replay_page import ReplayPage
    from airl_mav.addons.view.view_server import LocalServer

    run = ReplayedRun(flown)
    server = LocalServer(0)
    make, flying = run.flight, {}

    def node(name: str) -> Any:
        return server.scene.get_handle_by_name(f"/flight/{name}")

    def flight(record: EpisodeRecord) -> ReplayedFlight:
        flying.update({name: node(name) for name in ("vehicle", "trail/0")})
        assert all(flying.values())
        assert node("arena/walls") is None
        return make(record)

    monkeypatch.setattr(run, "flight", flight)
    try:
        page = ReplayPage(server, run)
        assert {name: node(name) for name in flying} == flying, "they are not built again"
        assert node("arena/walls") is not None
        assert node("arena/obstacle/0") is not None
        assert page._shown.picture is not None
        assert f"seed {run.records[0].seed}" in page._panel._title.content
    finally:
        server.stop()

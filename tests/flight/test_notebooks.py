"""The notebooks of examples/, executed by a Jupyter kernel as they stand."""

from __future__ import annotations

import ast
import base64
import json
import re
from pathlib import Path
from typing import Any

import pytest

from airl_mav import Scenario, load_run, rehearse
from airl_mav.addons.notebook.notebook import run_html
from airl_mav.rehearsal.run_folder import load
from tests.support.processes import ROOT

NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


@pytest.mark.nightly
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_the_cells_of_a_notebook_run_one_after_the_other(
    path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    known: dict[str, Any] = {}
    shown: list[str] = []
    for cell in (each for each in cells if each["cell_type"] == "code"):
        assert not cell["outputs"] and cell["execution_count"] is None
        program = ast.parse("".join(cell["source"]))
        last = program.body.pop() if isinstance(program.body[-1], ast.Expr) else None
        exec(compile(program, path.name, "exec"), known)  # noqa: S102 (this project's own)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), path.name, "eval"), known)  # noqa: S307 (as above)
            shown += [value._repr_html_()] if hasattr(value, "_repr_html_") else []
    check(shown, capsys.readouterr().out)


@pytest.mark.nightly  # A kernel takes longer to start than its cells; in every run: above.
@pytest.mark.timeout(300)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs_as_it_stands(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    # Keep the kernel's files apart from this machine's user.
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=240, resources=resources).execute()
    shown = [
        output.data["text/html"]
        for cell in code
        for output in cell.outputs
        if output.output_type == "execute_result" and "text/html" in output.data
    ]
    printed = "".join(
        output.text for cell in code for output in cell.get("outputs", ()) if "text" in output
    )
    check(shown, printed)


def check(shown: list[str], printed: str) -> None:
    assert len(shown) == 3
    for html in shown:
        check_picture(html)
    runs, curve = shown[:2], shown[2]
    assert all("of 12 goals reached" in html for html in runs)
    assert "flight time" in curve
    assert "400ms" in curve
    assert re.search(r"t2: 39\d ms", printed), "the paper's Raspberry Pi: 396 ms"


def check_picture(html: str) -> None:
    (picture,) = re.findall(r'<img src="data:image/png;base64,([^"]+)" alt="[^"]+', html)
    assert base64.b64decode(picture).startswith(b"\x89PNG")


@pytest.mark.parametrize("episodes", [1, 4])
def test_a_run_shows_itself(episodes: int, tmp_path: Path) -> None:
    asked: dict[str, Any] = {"policy": "greedy", "arena": "no-obstacles", "level": "gym"}
    run = rehearse(Scenario(episodes=episodes, seed=20, **asked), out=tmp_path / "run")
    before = sorted(tmp_path.rglob("*"))
    html = run._repr_html_() or ""
    assert sorted(tmp_path.rglob("*")) == before, "to show it writes nothing"
    check_picture(html)
    rate = run.quality.success_rate
    assert rate.value is not None
    assert f"{round(rate.value * episodes)} of {episodes} goals reached" in html
    assert run.quality.flight_time_s.value is not None
    assert f"{run.quality.flight_time_s.value:.1f} s" in html
    assert str(run.path) in html


def test_a_run_without_flights_or_profiles_shows_itself(tmp_path: Path) -> None:
    asked: dict[str, Any] = {"policy": "greedy", "level": "gym", "episodes": 1}
    arena = tmp_path / "mine.toml"
    shipped = ROOT / "profiles" / "arenas" / "no-obstacles.toml"
    arena.write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
    run = rehearse(Scenario(arena=str(arena), **asked), out=tmp_path / "run")
    arena.unlink()
    check_picture(load_run(run.path)._repr_html_() or "")
    (tmp_path / "run" / "episodes.jsonl").write_bytes(b"")
    html = run_html(load(run.path))
    assert "no flight was finished" in html
    assert "<img" not in html

"""The notebooks of examples/, executed by a Jupyter kernel as they stand."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import pytest

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
            shown += [] if value is None else [repr(value)]
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
        output.data["text/plain"]
        for cell in code
        for output in cell.outputs
        if output.output_type == "execute_result"
    ]
    printed = "".join(
        output.text for cell in code for output in cell.get("outputs", ()) if "text" in output
    )
    check(shown, printed)


def check(shown: list[str], printed: str) -> None:
    assert len(shown) == 3
    assert all("low=" in text for text in shown), "with intervals"
    assert "400ms" in shown[2]
    assert re.search(r"t2: 39\d ms", printed), "the paper's Raspberry Pi: 396 ms"

"""Console output: brackets and colons in paths and names are printed verbatim."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from rich.table import Table

from airl_mav.core.progress import new_console

ROOT = Path(__file__).parents[2]


def test_brackets_and_colons_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("[bold]heading", title="[red]title")
    table.add_row("runs/[a]/:smile:")
    console = new_console()
    console.print("runs/[bold]/[/x]:smile:")
    console.print(table)
    printed = capsys.readouterr().out
    for text in ("runs/[bold]/[/x]:smile:", "[bold]heading", "[red]title", "runs/[a]/:smile:"):
        assert text in printed


def test_it_writes_where_it_was_told(capsys: pytest.CaptureFixture[str]) -> None:
    new_console(stderr=True).print("wrong")
    new_console(quiet=True).print("silent")
    assert capsys.readouterr() == ("", "wrong\n")


def test_no_command_makes_a_console_of_its_own() -> None:
    """Rich's own reads brackets in a path as a style, and leaves them out."""
    made = re.compile(r"(?<![\w.])Console\(")
    sources = [*(ROOT / "airl_mav").rglob("*.py"), *(ROOT / "scripts").rglob("*.py")]
    elsewhere = {
        str(path.relative_to(ROOT))
        for path in sources
        if made.search(path.read_text(encoding="utf-8"))
    }
    assert not elsewhere

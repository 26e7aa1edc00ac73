"""Modules that run as a program define everything before their entry point."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_entry_point_is_the_last_statement_of_its_module() -> None:
    """A class below `sys.exit(main())` does not exist while the program runs."""
    programs = 0
    for package in ("airl_mav", "companion", "firmware_sim", "scripts"):
        for path in (ROOT / package).rglob("*.py"):
            before = ast.parse(path.read_text(encoding="utf-8")).body[:-1]
            entries = [part for part in before if _is_entry(part)]
            assert not entries, f"{path}:{entries[0].lineno}: move it to the end"
            programs += '__name__ == "__main__"' in path.read_text(encoding="utf-8")
    assert programs > 5


def _is_entry(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.If) and "__main__" in ast.unparse(statement.test)

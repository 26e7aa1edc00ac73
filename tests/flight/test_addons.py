"""The core works without add-ons: each folder of an `addons` is removed in turn."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import pytest

from airl_mav.cli.main import SUBCOMMANDS
from airl_mav.core.addons import PACKAGES
from tests.support.processes import ROOT

ADDONS = sorted(
    f"{package}.addons.{each.parent.name}"
    for package in PACKAGES
    for each in (ROOT / package / "addons").glob("*/__init__.py")
)

MODULES = """
import importlib, pkgutil, airl_mav, companion, firmware_sim
for package in (airl_mav, companion, firmware_sim):
    for each in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not each.name.startswith((package.__name__ + ".addons.", "companion.addons.cameras.")):
            importlib.import_module(each.name)
"""


CUSTOMIZE = """
import importlib.util, sys
from pathlib import Path
class Finder:
    @staticmethod
    def find_spec(name, path=None, target=None):
        folder = Path({kept!r}) / name
        if name.endswith(".addons") and folder.is_dir():
            init = folder / "__init__.py"
            return importlib.util.spec_from_file_location(
                name, init, submodule_search_locations=[str(folder)]
            )
sys.meta_path.insert(0, Finder)
"""
"""Replaces the folders of the add-ons before anything is imported."""

FOUND = """
from airl_mav.core.addons import PACKAGES, names
print(*(f"{package}.addons.{name}" for package in PACKAGES for name in names(package)))
"""


def remove(folder: Path, removed: Sequence[str]) -> dict[str, str]:
    """Return an environment for Python in which some add-ons do not exist."""
    kept = folder / "addons"
    for package in PACKAGES:
        source = ROOT / package / "addons"
        (kept / f"{package}.addons").mkdir(parents=True)
        (kept / f"{package}.addons" / "__init__.py").symlink_to(source / "__init__.py")
        for name in (each.parent.name for each in source.glob("*/__init__.py")):
            if f"{package}.addons.{name}" not in removed:
                (kept / f"{package}.addons" / name).symlink_to(source / name)
    (folder / "sitecustomize.py").write_text(CUSTOMIZE.format(kept=str(kept)))
    return {**os.environ, "PYTHONPATH": str(folder)}


def python(folder: Path, environment: dict[str, str], *words: str) -> str:
    """Run Python; return its output."""
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def fly_without(folder: Path, removed: Sequence[str], *, whole: bool = True) -> None:
    """List the commands and fly, without some add-ons; if `whole`, import all and report too."""
    run = partial(python, folder, remove(folder, removed))
    found = run("-c", FOUND).split()
    assert found == [name for name in ADDONS if name not in removed]
    listed = run("-m", "airl_mav.cli.main", "--help")
    assert all(f"\n  {name} " in listed for name in SUBCOMMANDS)
    words = ("static-obstacles-fast", "--level", "lockstep", "--episodes", "1", "--out", "run")
    assert "success" in run("-m", "airl_mav.cli.main", "evaluate", *words)
    if not whole:
        return
    run("-c", MODULES)
    assert "success" in run("-m", "airl_mav.cli.main", "report", "run")
    assert (folder / "run" / "report.html").exists()


def test_the_core_imports_no_addon() -> None:
    found = []
    for package in PACKAGES:
        for file in (ROOT / package).rglob("*.py"):
            if "addons" not in file.relative_to(ROOT).parts:
                found += [
                    f"{file.relative_to(ROOT)}:{node.lineno}"
                    for node in imports_at_run_time(ast.parse(file.read_text()))
                    if isinstance(node, ast.ImportFrom)
                    and (node.module or "").split(".")[1:2] == ["addons"]
                ]
    assert not found


def imports_at_run_time(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a tree, without blocks for type checkers."""
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            yield node
            yield from imports_at_run_time(node)


def test_the_documentation_lists_all_addons() -> None:
    page = (ROOT / "docs" / "reference" / "addons.md").read_text().splitlines()
    assert [line.removeprefix("::: ") for line in page if line.startswith("::: ")] == ADDONS


def test_there_are_addons() -> None:
    assert "airl_mav.addons.identification" in ADDONS


def test_the_core_flies_without_addons(tmp_path: Path) -> None:
    fly_without(tmp_path, ADDONS, whole=False)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ADDONS)
def test_the_core_flies_without_one(name: str, tmp_path: Path) -> None:
    fly_without(tmp_path, [name])

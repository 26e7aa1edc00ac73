"""First start: compilation is a separate, visible step, resumed after Ctrl-C, silent when done."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from airl_mav.core import kernels
from airl_mav.core.first_start import (
    LABEL,
    LOADING,
    CompileJob,
    CompilePlan,
    compile_first,
    compile_shown,
    shown_by,
)
from airl_mav.core.progress import RichProgress

MODULE = """
import os
from airl_mav.core.kernels import kernel

@kernel
def left(x: float) -> float:
    return x + 1.0

@kernel
def right(x: float) -> float:
    return 2.0 * x

@kernel
def both(x: float) -> float:
    return left(x) + right(x)

def use_left() -> None:
    left(1.0)

def use_right() -> None:
    if os.path.exists("fail"):
        raise RuntimeError("no right")
    right(1.0)

def use_both() -> None:
    both(1.0)
"""

PLAN = CompilePlan(
    "small",
    "only",
    (CompileJob("small:use_left", {}, 1), CompileJob("small:use_right", {}, 1)),
    CompileJob("small:use_both", {}, 1),
)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give an empty cache, and a folder with three kernels as the working directory."""
    (tmp_path / "small.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    # Child processes do not import from the working directory.
    path = (str(tmp_path), str(Path(kernels.__file__).parents[2]))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def shown(stops: Iterator[bool] | None = None, *, terminal: bool = False) -> str:
    """Return what the step prints; it is stopped at the first True."""
    console = Console(file=io.StringIO(), force_terminal=terminal, width=120)
    with RichProgress(console) as progress:
        compile_first([PLAN], progress, lambda: stops is not None and next(stops), workers=1)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def compiled(cache: Path) -> set[str]:
    return {file.name.partition("-")[0] for file in cache.rglob("*.nbc")}


def until(cache: Path, name: str) -> Iterator[bool]:
    while True:
        yield name in compiled(cache)


@pytest.mark.nightly
def test_a_step_is_shown_and_the_next_start_prints_nothing(cache: Path) -> None:
    first = shown().splitlines()
    assert first[0] == LOADING
    assert first[1] == f"{LABEL}: 0 of 3, {first[1].rpartition(', ')[2]}"
    assert first[-1].startswith("kernels compiled in ")
    assert compiled(cache) == {"small.left", "small.right", "small.both"}
    before = {file: file.stat().st_mtime_ns for file in cache.rglob("*")}
    assert shown() == ""
    assert {file: file.stat().st_mtime_ns for file in cache.rglob("*")} == before


@pytest.mark.nightly
def test_a_terminal_gets_a_bar(cache: Path) -> None:
    text = shown(terminal=True)
    assert LABEL in text
    assert "/3" in text
    assert f"{LABEL}:" not in text


@pytest.mark.nightly
def test_an_interrupted_step_resumes(cache: Path) -> None:
    shown(until(cache, "small.left"))
    assert compiled(cache) == {"small.left"}
    assert not list(cache.glob("*.json"))
    (done,) = cache.rglob("small.left*.nbc")
    written = done.stat().st_mtime_ns
    shown()
    assert compiled(cache) == {"small.left", "small.right", "small.both"}
    assert done.stat().st_mtime_ns == written


@pytest.mark.nightly
def test_a_changed_source_is_compiled_again_and_a_full_cache_is_loaded(cache: Path) -> None:
    shown()
    (record,) = cache.glob("*.json")
    record.unlink()
    assert shown() == f"{LOADING}\n"  # Everything is found in the cache.
    files = json.loads(record.read_bytes())["files"]
    source = Path("small.py").resolve()
    assert str(source) in files
    source.write_text(MODULE.replace("2.0", "3.0"))
    os.utime(source, ns=(1, 1))
    assert "kernels compiled in" in shown()


def test_a_failed_job_is_reported_and_leaves_the_rest_to_the_flight(cache: Path) -> None:
    Path("fail").touch()
    assert "kernels are not compiled ahead: exit status 1: RuntimeError: no right" in shown()
    assert not list(cache.glob("*.json"))


def test_a_command_shows_what_compiles_before_it_begins(cache: Path) -> None:
    console = Console(file=io.StringIO(), width=120)
    compile_shown([PLAN])
    assert not compiled(cache)
    with shown_by(lambda: RichProgress(console)):
        compile_shown([PLAN])
    assert isinstance(console.file, io.StringIO)
    assert "kernels compiled in" in console.file.getvalue()

"""Compiled code is never stale, and an edit compiles again only what depends on it."""

from __future__ import annotations

import importlib
import os
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from numba import TypingError
from numpy.typing import NDArray

from airl_mav import camera, envs
from airl_mav.addons.colour.picture import Work
from airl_mav.core import compiling, kernels
from tests.support.processes import run_alone

FILES = {
    "airl_mav/__init__.py": "",
    "airl_mav/core/__init__.py": "",
    "airl_mav/size.py": "SIZE = 2.0\n",
    "airl_mav/twice.py": """
from airl_mav import (
    size,
)
from airl_mav.core.kernels import kernel

@kernel
def twice(x):
    return size.SIZE * x
""",
    "airl_mav/four.py": """
from airl_mav.core.kernels import kernel
from airl_mav.twice import twice

@kernel
def four(x):
    return twice(twice(x))
""",
    "airl_mav/alone.py": """
from airl_mav.core.kernels import kernel

@kernel
def alone(x):
    return x + 1.0
""",
}

PROGRAM = """
from airl_mav.alone import alone
from airl_mav.four import four
print(four(3.0), alone(3.0), *(k.__name__ for k in (alone, four) if k.stats.cache_misses))
"""


@pytest.mark.nightly
def test_an_edit_compiles_again_what_depends_on_it_and_no_more(tmp_path: Path) -> None:
    for name, text in FILES.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    for module in (compiling, kernels):
        shutil.copy(str(module.__file__), tmp_path / "airl_mav/core")

    def run() -> list[str]:
        ran = run_alone(PROGRAM, tmp_path)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout.split()

    assert run() == ["12.0", "4.0", "alone", "four"]
    assert run() == ["12.0", "4.0"]
    # A constant, two imports away from the kernel that it is compiled into.
    (tmp_path / "airl_mav/size.py").write_text("SIZE = 3.0\n", encoding="utf-8")
    assert run() == ["27.0", "4.0", "four"]


HEARD = """
from airl_mav.core.compiling import heard_compiling
from airl_mav.core.kernels import kernel
import held

with heard_compiling(lambda begins: print(begins, end=" ")):
    held.outer(1.0)
print("done")
"""


def test_who_waits_is_told_of_compiling_and_of_none_from_the_cache(tmp_path: Path) -> None:
    (tmp_path / "held.py").write_text(
        "from airl_mav.core.kernels import kernel\n\n"
        "@kernel\ndef inner(x: float) -> float:\n    return x + 1.0\n\n"
        "@kernel\ndef outer(x: float) -> float:\n    return 2.0 * inner(x)\n"
    )
    root = str(Path(kernels.__file__).parents[2])
    told = []
    for _ in range(2):
        ran = subprocess.run(
            [sys.executable, "-c", HEARD],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": f"{root}{os.pathsep}{tmp_path}"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stderr
        told.append(ran.stdout.split())
    # The inner one is part of the outer one's compiling.
    assert told == [["True", "False", "done"], ["done"]]


def parts_of(hint: Any) -> set[Any]:
    """Return all types that a value of a type is made of."""
    inner = (*get_args(hint), *get_type_hints(hint if isinstance(hint, type) else object).values())
    return {hint, getattr(hint, "__origin__", hint)}.union(*map(parts_of, inner))


def test_no_kernel_that_borrows_arrays_returns_one() -> None:
    """The caller would release an array whose references are not counted."""
    assert np.ndarray in parts_of(tuple[int, Work])
    borrowing = {
        each
        for package in (camera, envs)
        for found in pkgutil.iter_modules(package.__path__, f"{package.__name__}.")
        for each in vars(importlib.import_module(found.name)).values()
        if getattr(each, "targetoptions", {}).get("_nrt") is False
    }
    assert len(borrowing) > 20
    for each in borrowing:
        returned = get_type_hints(each.py_func)["return"]
        assert np.ndarray not in parts_of(returned), each.__name__


def test_numba_refuses_a_borrowing_kernel_an_array_of_its_own() -> None:
    @kernels.borrowing_kernel
    def makes(n: int) -> float:
        return float(np.ones(n).sum())

    @kernels.borrowing_kernel
    def returns(row: NDArray[np.float64]) -> NDArray[np.float64]:
        return row[1:]

    message = "Only accept returning of array passed"
    with pytest.raises(TypingError, match=message):
        makes(3)
    with pytest.raises(TypingError, match=message):
        returns(np.ones(3))


SAVES = """
import sys
import numpy as np
from airl_mav.core import kernels
from twofold import twofold

values = [1, 1.0, 1j, np.float32(1.0)]
save = kernels._Cache.save_overload

def save_with_the_others(*arguments):
    print("ready", flush=True)
    sys.stdin.readline()
    save(*arguments)

kernels._Cache.save_overload = save_with_the_others
for each in sys.argv[1:] or range(4):
    print(twofold(values[int(each)]), *twofold.stats.cache_misses)
"""


@pytest.mark.nightly
def test_processes_that_save_a_kernel_for_several_types_keep_all(tmp_path: Path) -> None:
    (tmp_path / "twofold.py").write_text(
        "from airl_mav.core.kernels import kernel\n\n@kernel\ndef twofold(x):\n    return x + x\n"
    )
    root = str(Path(kernels.__file__).parents[2])

    def start(*which: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", SAVES, *which],
            env={**os.environ, "PYTHONPATH": f"{root}{os.pathsep}{tmp_path}"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    together = [start(str(k)) for k in range(4)]
    for each in together:
        assert each.stdout is not None
        assert each.stdout.readline() == "ready\n"
    for each in together:
        assert each.stdin is not None
        each.stdin.write("\n")
        each.stdin.flush()
    for each in together:
        each.communicate(timeout=60)
        assert each.returncode == 0
    # They are found under their own types.
    with start() as alone:
        found, _ = alone.communicate(timeout=60)
    assert found.split("\n")[:-1] == ["2", "2.0", "2j", "2.0"]

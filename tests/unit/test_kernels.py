"""Compiled code is never stale, and an edit compiles again only what depends on it."""

from __future__ import annotations

import shutil
from pathlib import Path

from airl_mav.core import cache, kernels
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


def test_an_edit_compiles_again_what_depends_on_it_and_no_more(tmp_path: Path) -> None:
    for name, text in FILES.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    for module in (cache, kernels):
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

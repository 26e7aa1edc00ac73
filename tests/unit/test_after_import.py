"""Our code runs once another package is imported, in whichever order, and imports it not."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

import pytest

from airl_mav.core.addons import after_import
from tests.support.processes import run_alone


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the path with the packages `theirs` and `ours_of_theirs`."""
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/__init__.py").write_text("import theirs.part\nWHOLE = True\n")
    (tmp_path / "theirs/part.py").write_text("")
    (tmp_path / "ours_of_theirs.py").write_text("import theirs\nSAW = theirs.WHOLE\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    for name in ("theirs", "theirs.part", "ours_of_theirs"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


@pytest.mark.usefixtures("folder")
def test_it_waits_for_the_package_and_leaves_nothing_behind() -> None:
    before = list(sys.meta_path)
    after_import("theirs", "ours_of_theirs")
    assert "theirs" not in sys.modules
    assert importlib.util.find_spec("theirs") is not None, "looking for it is not importing it"
    assert "ours_of_theirs" not in sys.modules
    part = importlib.import_module("theirs.part")
    assert part.__spec__ is not None
    assert sys.modules["ours_of_theirs"].SAW is True
    assert sys.meta_path == before


@pytest.mark.usefixtures("folder")
def test_a_package_that_is_there_is_not_waited_for() -> None:
    importlib.import_module("theirs")
    before = list(sys.meta_path)
    after_import("theirs", "ours_of_theirs")
    assert "ours_of_theirs" in sys.modules
    assert sys.meta_path == before


def test_a_package_that_is_not_installed_is_as_absent_as_before(folder: Path) -> None:
    after_import("nowhere_to_be_found", "ours_of_theirs")
    with pytest.raises(ModuleNotFoundError, match="nowhere_to_be_found"):
        importlib.import_module("nowhere_to_be_found")


@pytest.mark.parametrize(
    "order",
    [
        "import airl_mav, companion; assert 'gymnasium' not in sys.modules; import gymnasium",
        "import gymnasium; import airl_mav",
    ],
)
def test_gymnasium_knows_the_environment_in_whichever_order(order: str, tmp_path: Path) -> None:
    program = f"""
import sys
{order}
spec = gymnasium.spec("airl/Navigation-v0")
print(spec.entry_point, spec.vector_entry_point)
assert "numba" not in sys.modules
"""
    done = run_alone(program, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [
        "airl_mav.envs.navigation_env:NavigationEnv",
        "airl_mav.envs.vector:NavigationVectorEnv",
    ]

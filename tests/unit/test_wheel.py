"""The wheel alone flies: everything that is needed is inside, nothing else is."""

from __future__ import annotations

import configparser
import importlib
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.ports import choose_ports
from tests.support.processes import ROOT, running

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("rehearsal"), pytest.mark.timeout(400)]


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel and unpack it into an empty folder."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation"]
    built = subprocess.run(
        [*command, "--wheel-dir", str(folder / "dist"), str(ROOT)],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = (folder / "dist").glob("*.whl")
    assert wheel.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_everything_needed_is_inside(unpacked: Path) -> None:
    inside = files(unpacked)
    profiles = {
        f"airl_mav/_profiles/{path.relative_to(ROOT / 'profiles').as_posix()}"
        for path in (ROOT / "profiles").rglob("*.toml")
    }
    assert profiles
    assert profiles <= inside
    assert "airl_mav/_profiles/px4/1.17/parameters.csv" in inside
    assert "airl_mav/report/templates/report.html.j2" in inside
    for package in ("airl_mav", "companion", "firmware_sim"):
        sources = {
            path.relative_to(ROOT).as_posix()
            for path in (ROOT / package).rglob("*.py")
            if "__pycache__" not in path.parts
        }
        assert sources
        assert sources <= inside


def test_nothing_else_is_inside(unpacked: Path) -> None:
    tops = {name.partition("/")[0] for name in files(unpacked)}
    (metadata,) = (top for top in tops if top.endswith(".dist-info"))
    assert tops == {"airl_mav", "companion", "firmware_sim", metadata}
    suffixes = {Path(name).suffix for name in files(unpacked) if not name.startswith(metadata)}
    known = {".py", ".toml", ".csv", ".xml", ".j2", ".js", ".md", ".onnx", ".json", ".typed"}
    assert suffixes <= known


def test_entry_points_exist(unpacked: Path) -> None:
    (path,) = unpacked.glob("*.dist-info/entry_points.txt")
    parser = configparser.ConfigParser()
    parser.read(path, encoding="utf-8")
    scripts = dict(parser["console_scripts"])
    assert set(scripts) >= {"airl-sitl", "airl-firmware", "airl-companion", "airl"}
    for target in scripts.values():
        module, _, function = target.partition(":")
        assert callable(getattr(importlib.import_module(module), function))


def test_the_base_install_is_light(unpacked: Path) -> None:
    (path,) = unpacked.glob("*.dist-info/METADATA")
    lines = path.read_text(encoding="utf-8").splitlines()
    required = [line for line in lines if line.startswith("Requires-Dist:")]
    base = " ".join(line for line in required if "extra ==" not in line)
    for needed in ("mavsdk", "numba", "numpy", "pydantic", "pyzmq", "rich", "tyro"):
        assert needed in base
    for heavy in ("pybullet", "torch", "matplotlib", "pymavlink", "filterpy", "scipy"):
        assert heavy not in base
        assert any(heavy in line for line in required)


@pytest.mark.nightly
def test_it_flies_from_anywhere(unpacked: Path, tmp_path: Path) -> None:
    """Only the wheel on the path, another working folder, the shipped profiles."""
    words = ["-m", "airl_mav.cli.sitl_command", "--episodes", "1", "--speed", "3", "--no-validity"]
    with running([*words, *choose_ports().options()], tmp_path, path=unpacked) as process:
        # A fresh install compiles its kernels.
        assert process.wait(300.0) == 0, process.text()
    (run,) = (tmp_path / "runs").iterdir()
    (line,) = (run / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(line)["outcome"] == "success"
    assert json.loads((run / "run.json").read_text(encoding="utf-8"))["git"] is None
    assert (run / "report.html").exists()


def test_its_profiles_come_from_the_wheel(unpacked: Path, tmp_path: Path) -> None:
    where = "from airl_mav.profiles.loading import profiles_dir; print(profiles_dir())"
    with running(["-c", where], tmp_path, path=unpacked) as process:
        assert process.wait() == 0
    assert process.text().strip() == str(unpacked / "airl_mav" / "_profiles")

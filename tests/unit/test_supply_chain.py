"""Locks, pinned CI actions and licences."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib.metadata import Distribution, PackagePath, distributions
from pathlib import Path
from typing import Any

import licences
import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from airl_mav.profiles.loading import read_toml

ROOT = Path(__file__).parents[2]
ENTRY = re.compile(
    r"^([\w.-]+)==(\S+)(?: ; (.*?))? \\\n((?:    --hash=sha256:[0-9a-f]{64}.*\n)+)", re.M
)
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
UNLOCKED = "torch"


def entries(name: str) -> Sequence[tuple[str, str, Marker | None]]:
    """Return name, version and marker of each package of a lock."""
    text = (ROOT / "requirements" / f"{name}.txt").read_text()
    found = [
        (canonicalize_name(a), b, Marker(c) if c else None) for a, b, c, _ in ENTRY.findall(text)
    ]
    # Whatever is no entry is a comment: no package is without hashes.
    assert all(line.startswith("#") for line in ENTRY.sub("", text).splitlines())
    return found


def direct(extra: str, python: str) -> Iterator[str]:
    """Yield the packages that an extra needs, with those of the extras that it names."""
    project = read_toml(ROOT / "pyproject.toml")["project"]
    where = {"python_version": python, "python_full_version": f"{python}.0", "extra": ""}
    lists = project["dependencies"] + project["optional-dependencies"][extra]
    for requirement in map(Requirement, lists):
        if requirement.marker is not None and not requirement.marker.evaluate(where):
            continue
        if requirement.name == "airl-mav":
            for inner in requirement.extras:
                yield from direct(inner, python)
        else:
            yield canonicalize_name(requirement.name)


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize(("lock", "extras"), [("sim", ["sim"]), ("all", ["sim", "train", "dev"])])
def test_a_lock_has_one_version_of_every_dependency(
    lock: str, extras: list[str], python: str
) -> None:
    where = {"python_version": python, "python_full_version": f"{python}.9"}
    names = [name for name, _, marker in entries(lock) if marker is None or marker.evaluate(where)]
    assert len(set(names)) == len(names)
    needed = {name for extra in extras for name in direct(extra, python)} - {UNLOCKED}
    assert needed <= set(names)
    assert UNLOCKED not in names


@pytest.mark.parametrize("lock", ["build", "release", "sim", "all"])
def test_a_lock_has_the_constrained_versions(lock: str) -> None:
    pins: dict[str, set[str]] = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            name, _, version = line.partition(" ;")[0].partition("==")
            pins.setdefault(canonicalize_name(name), set()).add(version.strip())
    found = entries(lock)
    assert found
    for name, version, _ in found:
        assert version in pins.get(name, {version}), f"{name}: run scripts/lock"


def test_actions_of_ci_are_pinned_by_commit() -> None:
    found = 0
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        for line in path.read_text().splitlines():
            if "uses:" in line:
                assert re.search(r"uses: [\w/-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+$", line), line
                found += 1
    assert found >= 10


class Metadata(dict[str, str]):
    """Metadata of a package, by the names of its JSON form too."""

    @property
    def json(self) -> dict[str, str]:
        return self

    def __missing__(self, name: str) -> str:
        return self[name.lower()]


class Package(Distribution):
    """Installed package with a licence and files."""

    def __init__(self, licence: str, *files: str) -> None:
        self.licence, self.paths = licence, files

    @property
    def metadata(self) -> Any:
        return Metadata({"name": "thing", "license_expression": self.licence})

    @property
    def files(self) -> list[PackagePath]:
        return [PackagePath(path) for path in self.paths]

    def read_text(self, filename: str) -> None:
        """Return nothing: metadata and files are given."""

    def locate_file(self, path: Any) -> Any:
        """Return the path itself."""
        return path


@pytest.mark.parametrize(
    ("package", "notice", "problem"),
    [
        (Package("MIT"), "", ""),
        (Package("GPL-3.0-only"), "", "thing: licence 'GPL-3.0-only'"),
        (Package(""), "", "thing: licence ''"),
        (Package("MIT", "thing.libs/libx264-1.so"), "", "thing: contains x264 (GPL)"),
        (Package("MIT", "thing.libs/libx264-1.so"), "thing brings libx264", ""),
        (Package("MIT", "thing.libs/libx264-1.so"), "another brings libx264", "contains x264"),
    ],
)
def test_a_licence_that_needs_a_review(package: Package, notice: str, problem: str) -> None:
    found = licences.problems_of([package], notice)
    assert bool(found) == bool(problem)
    assert problem in "".join(found)


def test_no_installed_package_needs_a_review() -> None:
    assert licences.problems_of(distributions(), (ROOT / "NOTICE").read_text()) == []

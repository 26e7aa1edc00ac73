"""Parts that users put in: by file, by module, by the name that an installed package gives them."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from airl_mav.cli import list_command
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import validated
from airl_mav.core.plugins import DOORS, POLICIES, load_part, names_code
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.policy.registry import find_policy, load_policy
from airl_mav.profiles.loading import profiles_dir
from airl_mav.scenario.model import Scenario, anchored
from airl_mav.training.config import TrainingConfig

POLICY = '''
class Hover:
    """Stays where it is."""

    def act(self, observation):
        return observation
'''


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The present folder has a package `their_parts`, which is not on the path."""
    folder = tmp_path / "their_parts"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "policy.py").write_text(POLICY)
    (folder / "broken.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    # As a console script has it.
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each])
    for name in ("their_parts", "their_parts.policy"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return folder


@pytest.fixture
def installed(package: Path) -> str:
    """The package is installed, and announces its policy as `their-hover`."""
    about = package.parent / "their_parts-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-parts\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        f"[{POLICIES.group}]\ntheir-hover = their_parts.policy:Hover\n"
    )
    sys.path.append(str(package.parent))
    return "their-hover"


def test_a_policy_by_its_module_is_found_in_the_present_folder(package: Path) -> None:
    known = find_policy("their_parts.policy:Hover")
    assert (known.name, known.description) == ("Hover", "Stays where it is.")
    assert known.sha256 == hashlib.sha256((package / "policy.py").read_bytes()).hexdigest()
    policy: Any = load_policy(known, 0.5)
    assert policy.act("seen") == "seen"
    # It means the same wherever it is flown again; a file's path is made absolute for that.
    assert anchored(Scenario(policy="their_parts.policy:Hover")).policy == known.program


def test_a_policy_by_the_name_that_its_package_announces(installed: str) -> None:
    known = find_policy(installed)
    assert (known.name, known.program) == ("their-hover", "their_parts.policy:Hover")
    assert known.sha256 == find_policy("their_parts.policy:Hover").sha256
    assert type(load_policy(installed, 0.5)) is load_part(POLICIES, "their_parts.policy:Hover")
    console = Console(width=120, file=StringIO())
    assert list_command.run(list_command.ListOptions(kind="policies"), console) == 0
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "their-hover" in printed
    assert "installed: their_parts.policy:Hover" in printed
    with pytest.raises(UsageError, match=r"known: greedy, .*their-hover \(or a path"):
        find_policy("their-hovver")


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("their_parts.absent:Hover", "ModuleNotFoundError: No module named 'their_parts.absent'"),
        ("nowhere_at_all:Hover", "ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("their_parts.broken:Hover", "ZeroDivisionError: division by zero"),
        ("their_parts.policy:Absent", "accepted: a class with a method act; their_parts.policy"),
        ("their_parts:policy", "accepted: a class with a method act; their_parts has none"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(name: str, words: str) -> None:
    with pytest.raises(FieldError, match=words) as caught:
        find_policy(name)
    assert str(caught.value).startswith(f"policy {name!r}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("mine.py:Hover", True),
        ("folder/mine.py:Hover", True),
        ("pkg.part:Hover", True),
        ("pkg:Hover", True),
        ("static-obstacles", False),
        ("runs/mine/policy", False),
        ("C:/policies/mine", False),
        ("my-pkg:Hover", False),
    ],
)
def test_names_of_code(name: str, code: bool) -> None:
    assert names_code(name) is code


def test_files_of_one_name_in_two_folders_are_two_modules(tmp_path: Path) -> None:
    for i in (1, 2):
        (tmp_path / f"{i}").mkdir()
        (tmp_path / f"{i}/part.py").write_text(f"{POLICY}    number = {i}\n")
    made = [load_part(POLICIES, f"{tmp_path / str(i)}/part.py:Hover") for i in (1, 2)]
    assert [each.number for each in made] == [1, 2]
    assert [getattr(sys.modules[each.__module__], "Hover") for each in made] == made  # noqa: B009


def test_reading_a_file_that_names_code_runs_none(package: Path) -> None:
    """Only what flies or trains runs it: a scenario or training file can be looked at."""
    (package / "policy.py").write_text("raise SystemExit('run')\n")
    own = "their_parts.policy:Mine"
    assert spec_of(None, {"reward": own}).reward == own
    config = TrainingConfig(description="", network={"kind": own, "options": {"width": 3}})
    assert config.network.own
    assert Scenario(policy=own).policy == own
    assert "their_parts" not in sys.modules


def test_a_card_names_no_code(package: Path) -> None:
    """Reading and flying a received policy folder imports nothing."""
    (package / "policy.py").write_text("raise SystemExit('run')\n")
    folder = package.parent / "sent"
    shutil.copytree(profiles_dir() / "policies/no-obstacles", folder)
    plain = json.loads((folder / "card.json").read_text())
    del plain["crc32"]
    for table, field in (("actions", "set"), ("observation", "layout")):
        evil = plain | {table: plain[table] | {field: "their_parts.policy:Evil"}}
        (folder / "card.json").write_text(json.dumps(evil))
        with pytest.raises(UsageError, match=rf"{table}\.{field} = 'their_parts.policy:Evil'"):
            find_policy(str(folder))
    # The training configuration is only recorded, never loaded.
    plain["training"]["config"]["environment"]["reward"] = "their_parts.policy:Evil"
    (folder / "card.json").write_text(json.dumps(plain))
    load_policy(str(folder), 0.5)
    assert "their_parts" not in sys.modules


@pytest.mark.parametrize(
    ("network", "words"),
    [
        ({"kind": "large"}, "network.kind 'large': accepted: 'small', 'appendix', 'template', FI"),
        ({"dense": [64]}, "dense: kind 'small' has no such field"),
        ({"kind": "pkg:Mine", "strides": [1, 1, 1, 1]}, "strides: kind 'pkg:Mine' has no such"),
        ({"kind": "pkg:Mine", "layers": 2}, "layers: kind 'pkg:Mine' has no such field"),
        ({"kind": "pkg:Mine", "dense": [0]}, r"network.dense.* 0: accepted"),
    ],
)
def test_wrong_networks(network: dict[str, Any], words: str) -> None:
    with pytest.raises(FieldError, match=words):
        validated(TrainingConfig, {"description": "", "network": network})


def test_every_door_has_its_own_group() -> None:
    groups = [door.group for door in DOORS]
    assert len(set(groups)) == len(groups)
    assert all(group.startswith("airl_mav.") for group in groups)
    assert EnvironmentSpec().reward == "shaped"

"""A policy that a user writes as a class in a file of his own."""

from pathlib import Path
from typing import Any

import pytest

from airl_mav.core.errors import UsageError
from airl_mav.policy.registry import find_policy, load_policy

PROGRAM = '''
from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Follow:
    """Counts.

    And nothing else.
    """

    seen: list[int] = field(default_factory=list)

    def act(self, observation):
        self.seen.append(len(self.seen))
        return observation


class Mute:
    pass


if __name__ == "__main__":
    raise SystemExit("this is an import")
'''


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(PROGRAM, encoding="utf-8")
    return path


def test_it_is_found_and_made_anew_for_each_flight(file: Path) -> None:
    known = find_policy(f"{file}:Follow")
    assert (known.name, known.description, known.card) == ("Follow", "Counts.", None)
    made: list[Any] = [load_policy(known, 0.5), load_policy(known, 0.5)]
    first, second = made
    first.act("observation")
    assert (first.seen, second.seen) == ([0], [])


def test_another_file_is_another_policy(file: Path) -> None:
    before = find_policy(f"{file}:Follow").sha256
    file.write_text(PROGRAM + "# changed\n", encoding="utf-8")
    assert find_policy(f"{file}:Follow").sha256 != before


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("absent.py:Follow", "no such file"),
        ("mine.py:Absent", "accepted: a class with a method act; .*mine.py has none of this name"),
        ("mine.py:Mute", "accepted: a class with a method act; .*mine.py has none of this name"),
        ("broken.py:Follow", "ZeroDivisionError: division by zero"),
        ("unfinished.py:Follow", "SyntaxError"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(file: Path, name: str, words: str) -> None:
    (file.parent / "broken.py").write_text("1 / 0\n", encoding="utf-8")
    (file.parent / "unfinished.py").write_text("class Follow(\n", encoding="utf-8")
    with pytest.raises(UsageError, match=words) as caught:
        find_policy(f"{file.parent / name}")
    assert "\n" not in str(caught.value)


def test_a_network_of_it_is_not_to_be_had(file: Path) -> None:
    with pytest.raises(UsageError, match="runtime"):
        load_policy(f"{file}:Follow", 0.5, runtime="torch")

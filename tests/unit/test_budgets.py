"""Budgets of size and prose: checked, lowered and never raised."""

from __future__ import annotations

from pathlib import Path

import pytest
from check_budgets import PACKAGES, PAGES, Table, check, excess, measure, read_budgets
from plain_english import read_prose

MODULE = '''"""Ray caster for depth images."""

import math
from os import (
    path,
    sep,
)

# Half of a turn.
HALF = math.pi
"""What is told of a turn."""
'''


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """Return a folder with the packages and pages, and budgets that fit."""
    for package in PACKAGES:
        (tmp_path / package / "__pycache__").mkdir(parents=True)
        (tmp_path / package / "camera.py").write_text(MODULE)
        (tmp_path / package / "__pycache__" / "generated.py").write_text("import os\n" * 50)
    (tmp_path / "docs").mkdir()
    for page in PAGES:
        file = tmp_path / page / "page.md" if page == "docs" else tmp_path / page
        file.write_text("# Rays\n\nThe ray caster returns depth images.\n")
    assert checked(tmp_path, lower=True) == 0
    return tmp_path


def checked(house: Path, *, lower: bool = False) -> int:
    return check(measure(house), house / "budgets.toml", lower=lower)


def budgets(house: Path) -> Table:
    return read_budgets(house / "budgets.toml")


def test_sizes_and_prose_of_a_package(house: Path) -> None:
    measured = measure(house)
    assert measured["companion"] == {
        "lines": 11,
        "modules": 1,
        "import_lines": 5,
        # Each occurs once in 5 + 6 words of docs and 4 words of a comment.
        "relatives_per_1000_words": 66.7,
        "banned_per_1000_words": 66.7,
        "clause_percent": 50.0,
        "words_per_sentence": 5.0,
    }
    assert measured["product"] == {"lines": 33, "modules": 3, "import_lines": 15}
    assert measured["docs"]["words_per_sentence"] == 6.0


def test_what_fits_passes_in_silence(house: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert checked(house) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("file", "text", "lines"),
    [
        ("companion/pilot.py", "X = 1\n", ["companion.lines: 12", "companion.modules: 2"]),
        (
            "companion/frame_source.py",
            MODULE.replace("math\n", "math, os\nimport re\n"),
            ["import_lines"],
        ),
        ("docs/index.md", "Fly to what is told.", ["docs.relatives", "docs.banned"]),
        ("README.md", "The ray caster returns sharp depth images.", ["README.md.words_per"]),
    ],
)
def test_each_excess_is_one_line(
    house: Path, file: str, text: str, lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (house / file).write_text(text)
    before = budgets(house)
    assert checked(house) == 1
    printed = capsys.readouterr().out
    assert all(line in printed for line in lines)
    assert all(" measured, " in line and " allowed: " in line for line in printed.splitlines())
    assert checked(house, lower=True) == 1, "--lower raises nothing"
    assert all(
        value <= before[section][name]
        for section, values in budgets(house).items()
        for name, value in values.items()
    )


def test_lower_writes_what_is_below_and_keeps_the_rest(house: Path) -> None:
    (house / "companion" / "camera.py").write_text('"""Ray caster for depth images."""\n')
    (house / "firmware_sim" / "camera.py").write_text(MODULE + "X = 1\n")
    assert checked(house, lower=True) == 1
    after = budgets(house)
    assert after["companion"]["lines"] == 1
    assert after["companion"]["clause_percent"] == 0.0
    assert after["firmware_sim"]["lines"] == 11
    assert after["product"]["lines"] == 24


def test_what_has_no_budget_fails_until_it_gets_one() -> None:
    (line,) = excess({"companion": {"lines": 3}}, {})
    assert line.startswith("companion.lines: 3 measured, no budget")


def test_calls_per_tick_have_two_percent_of_margin() -> None:
    allowed: Table = {"calls_per_tick": {"hover": 50.0}}
    assert excess({"calls_per_tick": {"hover": 51.0}}, allowed) == []
    (line,) = excess({"calls_per_tick": {"hover": 51.1}}, allowed)
    assert "benchmarks/bench_calls.py" in line


def test_comments_count_and_hashes_in_strings_do_not(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text('X = "# it is told to nobody"  # The mass is in kilograms.\n')
    assert read_prose(module).sentences == ["The mass is in kilograms."]

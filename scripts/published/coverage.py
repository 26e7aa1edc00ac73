"""Figures of the pages that do not come from results/*.json: `results/not-covered.toml`."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from pydantic import Field

from airl_mav.core.fields import ProfileModel, validated
from published.pages import MARKED, pages
from published.record import RESULTS, ROOT

NOT_COVERED_FILE = RESULTS / "not-covered.toml"

TABLE = re.compile(r"(?:^ *\|.*\n)+", re.M)
FIGURE = re.compile(r"\**[-+−]?\d[\d,.]*\**\b")
"""Start of a cell that contains a figure."""

FEWEST_FIGURES = 2
"""Minimum number of cells with figures, without the first column, in a table of figures."""


class NotCovered(ProfileModel):
    """Table or sentence whose figures no result contains."""

    page: str = Field(description="path from the root")
    text: str = Field(description="the table's first line, or words of the sentence, as they stand")
    why: str = Field(description="reason, or the missing source")


def not_covered() -> tuple[NotCovered, ...]:
    """Return the check-list. Raises UsageError."""
    data = tomllib.loads(NOT_COVERED_FILE.read_text(encoding="utf-8"))
    return tuple(validated(NotCovered, each, NOT_COVERED_FILE) for each in data["figure"])


def off_the_pages() -> set[str]:
    """Return the names of the results that no page shows, as listed."""
    data = tomllib.loads(NOT_COVERED_FILE.read_text(encoding="utf-8"))
    return {*data["off_the_pages"]}


def plain(text: str) -> str:
    """Return a page without its blocks and line breaks: the text written by hand."""
    return " ".join(MARKED.sub("", text).split())


def tables_by_hand() -> Iterator[tuple[str, str]]:
    """Yield page and first line of each table of figures outside the blocks."""
    for page in pages():
        for match in TABLE.finditer(MARKED.sub("", page.read_text(encoding="utf-8"))):
            head, _, *rows = match[0].strip().split("\n")
            cells = [cell.strip() for row in rows for cell in row.strip().strip("|").split("|")[1:]]
            if sum(FIGURE.match(cell) is not None for cell in cells) >= FEWEST_FIGURES:
                yield str(page.relative_to(ROOT)), head.strip()


def unknown_tables() -> list[str]:
    """Return the tables of figures absent from results and check-list."""
    listed = {(each.page, each.text) for each in not_covered()}
    return [f"{page}: {head}" for page, head in tables_by_hand() if (page, head) not in listed]


def listed_in_vain() -> list[str]:
    """Return the entries of the check-list that no page contains."""
    gone = []
    for each in not_covered():
        path = ROOT / each.page
        if not path.is_file() or " ".join(each.text.split()) not in plain(
            Path(path).read_text(encoding="utf-8")
        ):
            gone.append(f"{each.page}: {each.text}")
    return gone

"""Blocks of the pages: their results and renderers, declared by the modules tables_*."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from published.record import Record
from published.text import table

Records = Mapping[str, Record]
Render = Callable[[Records], str]

DEFAULT = "static-obstacles"
"""Default policy, and its training arena."""


@dataclass(frozen=True)
class Block:
    """Content between two marks of a page."""

    records: tuple[str, ...]
    """Names of the results in the block."""
    render: Render
    """Function from the results to Markdown."""


BLOCKS: dict[str, Block] = {}
"""Blocks by name in the marks of a page."""


def block(name: str, *records: str) -> Callable[[Render], Render]:
    """Declare the function that writes a block."""

    def declare(render: Render) -> Render:
        BLOCKS[name] = Block(records, render)
        return render

    return declare


def block_of(name: str, records: Records) -> Block | None:
    """Return a block of the pages; `printed-NAME` shows a result stored as a table."""
    if name in BLOCKS:
        return BLOCKS[name]
    result = name.removeprefix("printed-")
    if result == name or result not in records or records[result].printed is None:
        return None
    return Block((result,), _printed(result))


def _printed(name: str) -> Render:
    def render(records: Records) -> str:
        printed = records[name].printed
        assert printed is not None
        rows = [[*row] for row in printed.rows]
        return table(printed.columns, rows)

    return render

"""A ladder in the terminal."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from airl_mav.report.ladder.build import Ladder
from airl_mav.report.ladder.tables import (
    comparison_tables,
    decisions_table,
    fact_rows,
    levels_table,
    start_table,
)
from airl_mav.report.ladder.words import differences_in_words
from airl_mav.report.terminal import print_table


def print_ladder(ladder: Ladder, console: Console, page: Path) -> None:
    """Print what was flown, the tables, what else differs, and where the page lies."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column(overflow="fold")
    for term, text in fact_rows(ladder):
        facts.add_row(term, Text(text))
    console.print()
    console.print(facts)
    views = [
        levels_table(ladder),
        *comparison_tables(ladder),
        decisions_table(ladder),
        start_table(ladder),
    ]
    for view in views:
        console.print()
        print_table(view, console, wrap=True)
    console.print()
    for line in differences_in_words(ladder):
        console.print(Text(line))
    console.print()
    console.print(Text.assemble(("ladder  ", "dim"), str(page)), soft_wrap=True)

"""A comparison in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from airl_mav.report.compare.build import Compared, Side, keyed, lettered
from airl_mav.report.compare.tables import (
    latency_table,
    pairing_tables,
    pairs_in_words,
    quality_table,
)
from airl_mav.report.tables import NONE
from airl_mav.report.terminal import print_table


def print_comparison(compared: Compared, console: Console, page: Path) -> None:
    """Print what differs, the tables, and where the page lies."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column(overflow="fold")
    for term, text in compared.same.items():
        facts.add_row(term, Text(text))
    console.print()
    console.print(facts)
    short = lettered(compared)
    for side in keyed(compared).sides:
        _print_side(side, compared.different, console)
    for view in [quality_table(short), *pairing_tables(short)]:
        console.print()
        print_table(view, console, wrap=True)
    console.print()
    for line in pairs_in_words(short):
        console.print(Text(line))
    console.print()
    print_table(latency_table(short), console)
    console.print()
    console.print(Text.assemble(("comparison  ", "dim"), str(page)), soft_wrap=True)


def _print_side(side: Side, terms: Sequence[str], console: Console) -> None:
    """Print what differs of one run: all in one table would be wider than a terminal."""
    console.print()
    console.print(Text(side.name, style="bold"))
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column(overflow="fold")
    for term in terms:
        facts.add_row(f"   {term}", Text(side.facts.get(term, NONE)))
    console.print(facts)

"""A hardware gap in the terminal."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from airl_mav.report.gap.build import ArenaGap, GapStudy
from airl_mav.report.gap.file import write_gap
from airl_mav.report.gap.markdown import TABLES_FILE, write_markdown
from airl_mav.report.gap.page import build_page
from airl_mav.report.gap.tables import (
    columns_table,
    energy_note,
    fact_rows,
    gaps_table,
    legend_rows,
)
from airl_mav.report.gap.words import answers
from airl_mav.report.terminal import print_table


def show_gap(study: GapStudy, console: Console) -> None:
    """Write the files of a gap into its folder, and print it."""
    sentences = answers(study)
    write_gap(study, sentences)
    write_markdown(study, sentences)
    print_gap(study, sentences, console, build_page(study, sentences))


def print_gap(study: GapStudy, sentences: list[str], console: Console, page: Path) -> None:
    """Print what was flown, the tables, the answer, and where the page lies."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column(overflow="fold")
    for term, text in fact_rows(study):
        facts.add_row(term, Text(text))
    console.print()
    console.print(facts)
    for arena in study.arenas:
        _print_arena(arena, console)
    console.print()
    for sentence in sentences:
        console.print(Text(sentence, style="bold"))
    console.print()
    console.print(Text.assemble(("tables  ", "dim"), str(study.path / TABLES_FILE)), soft_wrap=True)
    console.print(Text.assemble(("gap     ", "dim"), str(page)), soft_wrap=True)


def _print_arena(arena: ArenaGap, console: Console) -> None:
    console.print()
    console.rule(Text(Path(arena.arena).stem, style="bold"), align="left", style="dim")
    console.print()
    legend = Table.grid(padding=(0, 2))
    legend.add_column(style="bold", no_wrap=True)
    legend.add_column(overflow="fold")
    for letter, text in legend_rows(arena):
        legend.add_row(letter, Text(text))
    console.print(legend)
    console.print()
    print_table(columns_table(arena, intervals="none"), console, wrap=True)
    console.print(Text(energy_note(arena), style="dim"))
    if arena.gaps:
        console.print()
        print_table(gaps_table(arena, narrow=True), console, wrap=True)

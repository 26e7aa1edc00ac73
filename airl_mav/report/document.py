"""Reports of headings, tables and pictures: an offline HTML page, Markdown, or terminal output."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from airl_mav.core import constants, errors, files
from airl_mav.flight import judge, statistics
from airl_mav.latency.stages import MIN_SAMPLES, Summary

if TYPE_CHECKING:
    from jinja2 import Environment

    from airl_mav.flight.episode_record import EpisodeRecord
    from airl_mav.report.theme import FigureImage

REPORT_FILE = "report.html"
"""File name of a run's page in its folder."""

SHEET_COLUMNS = 3

Facts = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Headline:
    """Key figure at the top of a page or a section."""

    title: str
    value: str
    unit: str
    detail: str


@dataclass(frozen=True)
class Section:
    """Contents below one heading."""

    title: str
    level: int = 2
    """Level of the heading; level 3 belongs to the preceding level 2."""
    headlines: tuple[Headline, ...] = ()
    """Key figures; only on the page."""
    sentences: tuple[str, ...] = ()
    facts: Facts = ()
    tables: tuple[TableView, ...] = ()
    draw: Callable[[], Sequence[FigureImage]] | None = None
    """Function that draws the pictures; called only for output with pictures."""
    sheet: str = ""
    """File name of a PNG with all pictures; empty = one PNG per picture."""
    columns: int | None = None
    """Number of pictures in a row, 1 = full width; None = 2 for four pictures, else 3."""
    note: str = ""
    """Explanation of the pictures, or of the tables without pictures; one paragraph per line."""
    in_terminal: bool = True
    template: str = "section.html.j2"
    """File in `templates`; its variables are `section`, `pictures` and, for a run, `page`."""
    data: Any = None
    """Further input of the template."""


def tables_section(*views: TableView | None, **fields: Any) -> tuple[Section, ...]:
    """Return a section titled as its first table, with its other fields; empty without tables."""
    tables = tuple(view for view in views if view is not None)
    return (Section(tables[0].title, tables=tables, **fields),) if tables else ()


@dataclass(frozen=True)
class RunLink:
    """Link to a run's folder and report."""

    name: str
    folder: str
    """Path relative to the document's folder."""
    report: str | None
    """Path of the run's report; None without one."""


@dataclass(frozen=True)
class Document:
    """Contents of a page."""

    name: str
    """File name of the page and its Markdown, without suffix."""
    title: str
    kicker: str
    sections: tuple[Section, ...]
    lead: str = ""
    answers: tuple[str, ...] = ()
    """Results in full sentences."""
    status: str = ""
    """Status of a verdict, which sets the colour of the box around the answers."""
    headlines: tuple[Headline, ...] = ()
    facts: Facts = ()
    facts_title: str = "What flew"
    remarks: tuple[str, ...] = ()
    runs: tuple[RunLink, ...] = ()
    provenance: Facts = ()
    configurations: tuple[tuple[str, str], ...] = ()
    """Name and full configuration of runs."""
    footer: str = ""


def estimate_headline(
    title: str,
    estimate: statistics.Estimate,
    unit: str,
    *,
    digits: int,
    sign: str = "",
    more: Sequence[str] = (),
) -> Headline:
    """Return an estimate as a headline with its interval and n."""
    if estimate.value is None:
        return Headline(title, NONE, "", f"n = {estimate.n:,}")
    details = [interval_of(estimate, digits, sign), f"n = {estimate.n:,}", *more]
    value = f"{estimate.value:{sign}.{digits}f}"
    return Headline(title, value, unit, ", ".join(text for text in details if text))


def run_link(name: str, run: Path, folder: Path) -> RunLink:
    """Return the link to a run relative to a document's folder."""
    there = Path(os.path.relpath(run, folder)).as_posix()
    report = f"{there}/{REPORT_FILE}" if (run / REPORT_FILE).exists() else None
    return RunLink(name, there, report)


@cache
def environment() -> Environment:
    """Return the template engine, with escaping and an error for undefined names."""
    # Imported here and below: tables and verdicts are printed before these slow imports.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("airl_mav.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["stacked"] = stacked
    made.globals["outcome_labels"] = OUTCOME_LABELS
    made.globals["outcome_keys"] = {
        label: outcome.value for outcome, label in OUTCOME_LABELS.items()
    }
    return made


def provenance_facts(
    machine: Mapping[str, Any], git: Mapping[str, Any] | None, versions: Mapping[str, str]
) -> Facts:
    """Return machine, commit and versions as facts."""
    facts = dict(machine)
    if memory := facts.pop("memory_bytes", None):
        facts["memory"] = f"{memory / 1e9:.1f} GB"
    rows = [(name.replace("_", " "), f"{value}") for name, value in facts.items()]
    if git is not None:
        changed = " (with changes)" if git.get("changed") else ""
        rows.append(("commit", f"{git.get('commit')}{changed}"))
    return (*rows, *sorted(versions.items()))


def draw_section(section: Section, folder: Path) -> tuple[Section, tuple[FigureImage, ...]]:
    """Draw a section's pictures and write their PNG files; return the section and the pictures."""
    from airl_mav.report.theme import montage

    pictures = () if section.draw is None else tuple(section.draw())
    if section.sheet and pictures:
        columns = section.columns or (2 if len(pictures) == 4 else SHEET_COLUMNS)
        files.replace_file(folder / section.sheet, montage(pictures, columns))
    else:
        for picture in pictures:
            files.replace_file(folder / f"{picture.name}.png", picture.png)
    return section, pictures


def write_document(document: Document, folder: Path) -> Path:
    """Write page, Markdown and PNG files, each atomically; return the page's path."""
    with errors.usage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        drawn = [draw_section(section, folder) for section in document.sections]
        files.replace_file(folder / f"{document.name}.md", markdown(document).encode())
        template = environment().get_template("document.html.j2")
        path = folder / f"{document.name}.html"
        files.replace_file(path, template.render(document=document, sections=drawn).encode())
    return path


def markdown(document: Document) -> str:
    """Return a document without pictures as Markdown."""

    def listed(facts: Facts) -> str:
        return "\n".join(f"- {escape_markdown(k)}: {escape_markdown(v)}" for k, v in facts)

    parts = [f"# {escape_markdown(document.title)}", escape_markdown(document.lead)]
    parts += [escape_markdown(answer) for answer in document.answers]
    parts.append(listed(document.facts))
    for section in document.sections:
        said = (section.sentences, section.facts, section.tables)
        if not any(said) and section.level > 2:
            continue
        if section.title not in [view.title for view in section.tables]:
            parts.append(f"{'#' * (section.level - 1)} {escape_markdown(section.title)}")
        parts.append("\n".join(f"- {escape_markdown(line)}" for line in section.sentences))
        parts.append(listed(section.facts))
        parts += [markdown_table(view) for view in section.tables]
        if section.draw is None:
            parts.append(escape_markdown(section.note))
    return "\n\n".join(part for part in parts if part) + "\n"


def print_verdict(lines: Sequence[str], console: Console) -> None:
    """Print the lines of a verdict in bold."""
    for line in lines:
        console.print(Text(line, style="bold"), soft_wrap=True)


def print_document(document: Document, console: Console) -> None:
    """Print answers, facts and tables."""
    if document.answers:
        print_verdict(((document.lead,) if document.lead else ()) + document.answers, console)
        console.print()
    print_facts(document.facts, console)
    shown = [section for section in document.sections if section.in_terminal]
    several = sum(section.level == 2 for section in shown) > 1
    for section in shown:
        if section.level == 2 and several and not section.tables and not section.sentences:
            console.print()
            console.rule(Text(section.title, style="bold"), align="left", style="dim")
        if section.facts:
            print_facts(section.facts, console, style="bold")
        for view in section.tables:
            if view.in_terminal != "not":
                console.print()
                print_table(view, console, wrap=True)
        if section.note and section.draw is None:
            console.print(Text(section.note, style="dim"))
        if section.sentences:
            console.print()
            for sentence in section.sentences:
                console.print(Text(sentence))


def print_place(name: str, place: Path | str, console: Console) -> None:
    """Print the path of a page, or the command that draws it, as the last line."""
    console.print()
    console.print(Text.assemble((f"{name}  ", "dim"), str(place)), soft_wrap=True)


NONE = "–"
"""Cell text for a missing value."""
TOO_FEW_CELL = "too few"
TOO_FEW_NOTE = (
    f"{TOO_FEW_CELL}: a p90 needs {MIN_SAMPLES[90.0]} samples, a p99 {MIN_SAMPLES[99.0]}."
)

OUTCOME_LABELS = {
    judge.Outcome.SUCCESS: "goal reached",
    judge.Outcome.COLLISION: "collision",
    judge.Outcome.TIMEOUT: "time limit",
    judge.Outcome.BATTERY: "battery empty",
    judge.Outcome.ABORTED: "aborted",
}

STYLES = {
    OUTCOME_LABELS[judge.Outcome.SUCCESS]: "green",
    OUTCOME_LABELS[judge.Outcome.COLLISION]: "red",
    OUTCOME_LABELS[judge.Outcome.TIMEOUT]: "yellow",
    OUTCOME_LABELS[judge.Outcome.BATTERY]: "magenta",
    OUTCOME_LABELS[judge.Outcome.ABORTED]: "dim",
    TOO_FEW_CELL: "dim",
    NONE: "dim",
}
"""Style of a cell in the terminal by its text."""

_INTERVAL = re.compile(r" (\[[^\[\]]*\])")


@dataclass(frozen=True)
class Column:
    """Column of a table."""

    title: str
    unit: str = ""
    number: bool = True
    """True to align right with tabular digits."""
    page_only: bool = False
    """True to omit the column in the narrow terminal."""


@dataclass(frozen=True)
class TableView:
    """Table of text cells."""

    key: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()
    stacked: bool = False
    """True to print intervals in brackets below their values on a page, to save width."""
    in_terminal: Literal["whole", "stacked", "without intervals", "not"] = "whole"
    links: Sequence[int] = ()
    """Flight of each row, for links."""


def ms(value_us: float | None, digits: int = 2) -> str:
    """Return a duration [µs] as milliseconds."""
    return NONE if value_us is None else f"{value_us / constants.US_PER_MS:,.{digits}f}"


def percentile_cell(value_us: float | None, n: int) -> str:
    """Return a percentile [µs] as milliseconds, or "too few" samples."""
    return TOO_FEW_CELL if value_us is None and n else ms(value_us)


def columns_of(header: str) -> tuple[Column, ...]:
    """Parse columns from "title [unit] | ..."; prefix "<" marks text, "*" marks `page_only`."""
    columns = []
    for title in header.split(" | "):
        name, _, unit = title.lstrip("*<").removesuffix("]").partition(" [")
        columns.append(Column(name, unit, "<" not in title[:2], title.startswith("*")))
    return tuple(columns)


DURATION_COLUMNS = columns_of("n | mean | p50 | p90 | p99 | max")


def duration_cells(s: Summary) -> tuple[str, ...]:
    """Return the cells of durations [µs]: number, mean, percentiles and maximum [ms]."""
    tail = (percentile_cell(s.p90, s.n), percentile_cell(s.p99, s.n))
    return (f"{s.n:,}", ms(s.mean), ms(s.p50), *tail, ms(s.max))


def stacked(cell: str) -> str:
    """Return a cell with its interval on a separate line."""
    return _INTERVAL.sub(r"\n\1", cell)


def escape_markdown(text: str) -> str:
    """Return text with Markdown's special characters escaped."""
    return "".join(f"\\{c}" if c in "\\|*_`[]<>" else c for c in text)


def markdown_table(view: TableView) -> str:
    """Return a table with its title and notes as Markdown."""
    titles = [f"{c.title} [{c.unit}]" if c.unit else c.title for c in view.columns]
    rule = ["---:" if column.number else "---" for column in view.columns]
    cells = [[escape_markdown(cell.replace("\n", ", ")) for cell in row] for row in view.rows]
    lines = [f"| {' | '.join(row)} |" for row in (titles, rule, *cells)]
    return "\n\n".join([f"## {view.title}", "\n".join(lines), *map(escape_markdown, view.notes)])


def print_table(view: TableView, console: Console, *, wrap: bool = False) -> None:
    """Print a table and its notes; with `wrap`, long cells are wrapped instead of cut."""
    if view.in_terminal == "not":
        return
    console.print(rich_table(view, wrap=wrap))
    for note in view.notes:
        console.print(Text(note, style="dim"))


def rich_table(view: TableView, *, wrap: bool = False) -> Table:
    """Return a table for the terminal, without `page_only` columns."""
    table = Table(
        title=view.title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    shown = [i for i, column in enumerate(view.columns) if not column.page_only]
    for i in shown:
        column = view.columns[i]
        title = f"{column.title} [{column.unit}]" if column.unit else column.title
        side: Literal["left", "right"] = "right" if column.number else "left"
        # Folding also breaks words longer than the column, so no text is lost.
        overflow: Literal["fold", "ellipsis"] = "fold" if wrap else "ellipsis"
        table.add_column(Text(title), justify=side, no_wrap=not wrap, overflow=overflow)
    for row in view.rows:
        cells = [row[i] for i in shown]
        if view.in_terminal == "stacked":
            cells = [stacked(cell) for cell in cells]
        elif view.in_terminal == "without intervals":
            cells = [_INTERVAL.sub("", cell) for cell in cells]
        table.add_row(*(Text(cell, style=STYLES.get(cell, "")) for cell in cells))
    return table


def print_facts(rows: Iterable[tuple[str, str]], console: Console, *, style: str = "dim") -> None:
    """Print terms and their texts."""
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style=style, no_wrap=True)
    facts.add_column(overflow="fold")
    for term, text in rows:
        facts.add_row(term, Text(text))
    console.print()
    console.print(facts)


def count_flights(episodes: Sequence[EpisodeRecord]) -> str:
    """Return the number of valid flights by outcome, and of invalid flights, on one line."""
    valid = [episode.outcome for episode in episodes if not episode.invalid]
    counts = [(valid.count(outcome), label) for outcome, label in OUTCOME_LABELS.items()]
    counts.append((len(episodes) - len(valid), "flown but invalid"))
    return ", ".join(f"{count:,} {label}" for count, label in counts if count)


SCHEMA = 1

TABLE_FILE = "table.json"


def write_table(
    view: TableView, folder: Path, made: Mapping[str, Any], policies: Sequence[str] = ()
) -> Path:
    """Write a table to a folder atomically; return the file's path."""
    columns = tuple(f"{c.title}, {c.unit}" if c.unit else c.title for c in view.columns)
    data = {"title": view.title, "columns": columns, "rows": view.rows, "notes": view.notes}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / TABLE_FILE
    files.write_json(path, {"schema": SCHEMA, **data, "policies": policies, "made": made})
    return path


def with_interval(estimate: statistics.Estimate, digits: int = 1, sign: str = "") -> str:
    """Return an estimate with its 95 % interval in brackets; `sign` is "+" for differences."""
    if estimate.value is None:
        return NONE
    form = f"{sign}.{digits}f"
    text = f"{estimate.value:{form}}"
    if estimate.low is not None and estimate.high is not None:
        text += f" [{estimate.low:{form}}, {estimate.high:{form}}]"
    return text


def interval_of(estimate: statistics.Estimate, digits: int, sign: str = "") -> str:
    """Return only the 95 % interval; empty without one."""
    if estimate.low is None or estimate.high is None:
        return ""
    form = f"{sign}.{digits}f"
    return f"{estimate.low:{form}} … {estimate.high:{form}}"

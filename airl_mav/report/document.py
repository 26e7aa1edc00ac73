"""Reports of headings, tables and pictures: an offline HTML page, Markdown, or terminal output."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.flight.statistics import Estimate
from airl_mav.report import table
from airl_mav.report.measures import interval_of

if TYPE_CHECKING:
    from jinja2 import Environment

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
    tables: tuple[table.TableView, ...] = ()
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


def tables_section(*views: table.TableView | None, **fields: Any) -> tuple[Section, ...]:
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
    estimate: Estimate,
    unit: str,
    *,
    digits: int,
    sign: str = "",
    more: Sequence[str] = (),
) -> Headline:
    """Return an estimate as a headline with its interval and n."""
    if estimate.value is None:
        return Headline(title, table.NONE, "", f"n = {estimate.n:,}")
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
    made.filters["stacked"] = table.stacked
    made.globals["outcome_labels"] = table.OUTCOME_LABELS
    made.globals["outcome_keys"] = {
        label: outcome.value for outcome, label in table.OUTCOME_LABELS.items()
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
        replace_file(folder / section.sheet, montage(pictures, columns))
    else:
        for picture in pictures:
            replace_file(folder / f"{picture.name}.png", picture.png)
    return section, pictures


def write_document(document: Document, folder: Path) -> Path:
    """Write page, Markdown and PNG files, each atomically; return the page's path."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        drawn = [draw_section(section, folder) for section in document.sections]
        replace_file(folder / f"{document.name}.md", markdown(document).encode())
        template = environment().get_template("document.html.j2")
        path = folder / f"{document.name}.html"
        replace_file(path, template.render(document=document, sections=drawn).encode())
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}") from None
    return path


def markdown(document: Document) -> str:
    """Return a document without pictures as Markdown."""

    def listed(facts: Facts) -> str:
        return "\n".join(
            f"- {table.escape_markdown(k)}: {table.escape_markdown(v)}" for k, v in facts
        )

    parts = [f"# {table.escape_markdown(document.title)}", table.escape_markdown(document.lead)]
    parts += [table.escape_markdown(answer) for answer in document.answers]
    parts.append(listed(document.facts))
    for section in document.sections:
        said = (section.sentences, section.facts, section.tables)
        if not any(said) and section.level > 2:
            continue
        if section.title not in [view.title for view in section.tables]:
            parts.append(f"{'#' * (section.level - 1)} {table.escape_markdown(section.title)}")
        parts.append("\n".join(f"- {table.escape_markdown(line)}" for line in section.sentences))
        parts.append(listed(section.facts))
        parts += [table.markdown_table(view) for view in section.tables]
        if section.draw is None:
            parts.append(table.escape_markdown(section.note))
    return "\n\n".join(part for part in parts if part) + "\n"


def print_verdict(lines: Sequence[str], console: Console) -> None:
    """Print the lines of a verdict in bold."""
    for line in lines:
        console.print(Text(line, style="bold"))


def print_document(document: Document, console: Console) -> None:
    """Print answers, facts and tables."""
    if document.answers:
        print_verdict(((document.lead,) if document.lead else ()) + document.answers, console)
        console.print()
    table.print_facts(document.facts, console)
    shown = [section for section in document.sections if section.in_terminal]
    several = sum(section.level == 2 for section in shown) > 1
    for section in shown:
        if section.level == 2 and several and not section.tables and not section.sentences:
            console.print()
            console.rule(Text(section.title, style="bold"), align="left", style="dim")
        if section.facts:
            table.print_facts(section.facts, console, style="bold")
        for view in section.tables:
            if view.in_terminal != "not":
                console.print()
                table.print_table(view, console, wrap=True)
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

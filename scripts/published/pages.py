"""Pages and cards, written from the results.

A page marks the generated parts:

    <!-- results: evidence -->
    ...
    <!-- end of results -->

The block `provenance` lists the command, date and commit of all other blocks of its page. On a
page without that block, each table has them below it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.policy.card import MeasuredResult, read_card
from airl_mav.policy.card_writing import write_card
from published import (
    tables_hardware_gap,
    tables_levels,
    tables_lies,
    tables_policies,
    tables_response,
)
from published.blocks import Block, block_of
from published.declared import read_declared
from published.record import ROOT, FlownRun, Record
from published.text import made_line, made_table, source_line

END = "<!-- end of results -->"
MARKED = re.compile(
    r"^(?P<indent> *)<!-- results: (?P<name>[a-z0-9-]+) -->\n.*?^ *" + END + "$", re.M | re.S
)
ALONE = re.compile(r"^ *<!-- (?:results:|end of results)", re.M)

PROVENANCE = "provenance"
"""Name of the block with the provenance of the other blocks of the page."""

POLICIES = ROOT / "profiles" / "policies"

TABLES = (tables_hardware_gap, tables_levels, tables_lies, tables_policies, tables_response)
"""Modules whose import declares their blocks."""


def pages() -> list[Path]:
    """Return the pages that may have marks."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def rendered(text: str, records: dict[str, Record], page: object) -> str:
    """Return a page with its blocks written from the results.

    Raises:
        UsageError: A block lacks its declaration or a result; a mark has no end.
    """

    def write(match: re.Match[str]) -> str:
        name = match["name"]
        content = summary if name == PROVENANCE else _content(blocks[name], records, not summary)
        return f"<!-- results: {name} -->\n\n{content}\n\n{END}"

    marks = _marks(text)
    if len(ALONE.findall(text)) != 2 * len(marks):
        raise UsageError(f"{page}: a mark of results without its end, or in another form")
    blocks = {name: _found(name, records, page) for name in marks if name != PROVENANCE}
    names = dict.fromkeys(record for each in blocks.values() for record in each.records)
    summary = made_table([records[name] for name in names]) if PROVENANCE in marks else ""
    return MARKED.sub(write, text)


def _marks(text: str) -> list[str]:
    return [match["name"] for match in MARKED.finditer(text)]


def _found(name: str, records: dict[str, Record], page: object) -> Block:
    found = block_of(name, records)
    if found is None:
        raise UsageError(f"{page}: results: {name}: no such block")
    for record in found.records:
        if record not in records:
            raise UsageError(f"{page}: results: {name}: no results/{record}.json")
    return found


def _content(found: Block, records: dict[str, Record], full: bool) -> str:
    """Return a block's table, with its full provenance or only the names of its results."""
    line = made_line if full else source_line
    lines = [line(records[each]) for each in found.records]
    return "\n\n".join([found.render(records), ("<br>\n" if full else ", ").join(lines)])


def shown(records: dict[str, Record]) -> set[str]:
    """Return the names of the results on pages and cards."""
    names = {name for page in pages() for name in _marks(page.read_text("utf-8"))}
    blocks = [block_of(name, records) for name in names]
    on_cards = {entry.name for entry in read_declared().values() if entry.cards}
    return on_cards | {record for each in blocks if each is not None for record in each.records}


# --- cards


def card_results(records: dict[str, Record]) -> dict[str, tuple[MeasuredResult, ...]]:
    """Return the results for the cards, by policy: flights under its rules, in any arena.

    Of two for the same arena, level and latency, the one of more episodes counts, or the first.
    """
    found: dict[str, dict[tuple[str, str, str], MeasuredResult]] = {}
    for entry in read_declared().values():
        if not entry.cards or entry.name not in records:
            continue
        record = records[entry.name]
        for run in record.runs.values():
            if (POLICIES / run.policy).is_dir():
                result = _result(run, record)
                key = result.level, result.arena, result.latency or ""
                known = found.setdefault(run.policy, {})
                if key not in known or known[key].episodes < result.episodes:
                    known[key] = result
    return {name: tuple(each[key] for key in sorted(each)) for name, each in found.items()}


def _result(run: FlownRun, record: Record) -> MeasuredResult:
    return MeasuredResult.of(
        run,
        arena=run.arena,
        level=run.level,
        latency=run.latency,
        seed=run.seed,
        flown_utc=record.made.date,
        behaviour=record.made.behaviour,
    )


def stale_cards(records: dict[str, Record]) -> Iterator[tuple[Path, tuple[MeasuredResult, ...]]]:
    """Yield the folder and the correct results of each policy with an outdated card."""
    for name, results in card_results(records).items():
        if read_card(POLICIES / name).results != results:
            yield POLICIES / name, results


# --- writing


def write_all(records: dict[str, Record]) -> list[Path]:
    """Write pages and cards that differ; return their paths. Raises UsageError."""
    written = []
    for page in pages():
        text = page.read_text(encoding="utf-8")
        new = rendered(text, records, page.relative_to(ROOT))
        if new != text:
            replace_file(page, new.encode())
            written.append(page)
    for folder, results in list(stale_cards(records)):
        write_card(folder, read_card(folder).model_copy(update={"results": results}))
        written.append(folder / "card.json")
    return written

"""Figures as text in the format of the pages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from airl_mav.profiles.loading import PublishedRun
from published.record import Figure, FlownRun, Record, out_of_date

NONE = "–"


def interval(figure: Figure, digits: int, sign: str = "", scale: float = 1.0) -> str:
    """Return a figure's interval in brackets, after a space; empty without one."""
    if figure.low is None or figure.high is None:
        return ""
    low, high = (_rounded(scale * end, digits, sign) for end in (figure.low, figure.high))
    return f" [{low}, {high}]"


def interval_cell(figure: Figure) -> str:
    """Return an interval for a separate cell."""
    if figure.low is None or figure.high is None:
        return NONE
    return f"{figure.low:+.1f} … {figure.high:+.1f}"


def number(figure: Figure, digits: int, sign: str = "", scale: float = 1.0) -> str:
    """Return a figure without its interval."""
    return NONE if figure.value is None else _rounded(scale * figure.value, digits, sign)


def both(figure: Figure, digits: int, sign: str = "", scale: float = 1.0) -> str:
    """Return a figure with its interval in brackets."""
    return number(figure, digits, sign, scale) + interval(figure, digits, sign, scale)


def rate(run: FlownRun) -> str:
    """Return a success rate with its interval, in percent."""
    return both(run.success_rate, 1, scale=100.0)


def percent(figure: Figure) -> str:
    """Return a relative difference with its interval."""
    return f"{both(figure, 1, '+')} %"


def energy_kj(run: FlownRun) -> str:
    """Return the vehicle's energy [kJ]."""
    return number(run.energy_j, 2, scale=1e-3)


def change(target: PublishedRun, reference: PublishedRun, field: str) -> float:
    """Return the relative difference of a figure of the paper [%]."""
    first, second = getattr(reference, field), getattr(target, field)
    return float(100.0 * (second - first) / first)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: int = 0) -> str:
    """Return a table as Markdown; the last `numbers` columns are right-aligned."""
    rules = ["---"] * (len(columns) - numbers) + ["---:"] * numbers
    lines = [columns, rules, *rows]
    return "\n".join(re.sub(" +", " ", f"| {' | '.join(line)} |") for line in lines)


def made_line(record: Record) -> str:
    """Return a result's command, date, commit, processor and file, with a note if outdated."""
    made = record.made
    line = f"`{made.command}` · {made.date}, {_commit(record)}, {made.cpu}"
    return f"{line} · {source_line(record)}"


def source_line(record: Record) -> str:
    """Return the file of a result, with a note if outdated."""
    stale = out_of_date(record)
    means = " · means" if record.averages == "means" else ""
    return f"`results/{record.name}.json`{means}" + (f" · **{stale}**" if stale else "")


def made_table(records: Iterable[Record]) -> str:
    """Return a table with the command, date and commit of results."""
    return table(
        ("result", "command", "date", "source"),
        (
            (
                f"`{each.name}`",
                f"`{each.made.command}`",
                each.made.date,
                _commit(each),
            )
            for each in records
        ),
    )


def _commit(record: Record) -> str:
    made = record.made
    return f"commit {made.commit[:7]}" if made.commit else f"version {made.version}"


def _rounded(value: float, digits: int, sign: str) -> str:
    """Return a number in decimals; rounding to zero keeps the sign."""
    return f"{value:{sign},.{digits}f}"

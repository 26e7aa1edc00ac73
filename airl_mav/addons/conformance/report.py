"""Terminal output of a conformance run."""

from __future__ import annotations

import math

from rich.table import Table
from rich.text import Text

from airl_mav.addons.conformance.checklist import CheckOutcome, TranscriptLine
from airl_mav.addons.conformance.result import (
    JUDGED,
    ConformanceResult,
    Reference,
    StoredStep,
    deviations,
)
from airl_mav.addons.conformance.steps import STEP_NAMES, StepResponse

FIGURES: dict[str, tuple[str, float, int]] = {
    "latency_s": ("latency\nms", 1e3, 0),
    "t10_s": ("t10\nms", 1e3, 0),
    "t50_s": ("t50\nms", 1e3, 0),
    "rise_s": ("rise\nms", 1e3, 0),
    "overshoot_percent": ("overshoot\n%", 1.0, 1),
    "error": ("error\nat end", 1.0, 2),
    "settle_s": ("settle 5 %\ns", 1.0, 2),
}
"""Column heading, scale and digits of each figure of a StepResponse."""

LINE_MARKS = {"sent": ("->", "cyan"), "heard": ("<-", ""), "check": ("==", "bold")}
COLOURS = {
    CheckOutcome.PASSED: "green",
    CheckOutcome.FAILED: "red",
    CheckOutcome.NOT_APPLICABLE: "yellow",
}


def line_text(line: TranscriptLine) -> Text:
    """Return a formatted line of the transcript."""
    mark, style = LINE_MARKS.get(line.kind, ("--", "dim"))
    return Text(f"{line.time_s:9.3f} {mark} {line.text}", style=style)


def step_table(result: ConformanceResult, reference: Reference) -> Table:
    """Return the step responses beside the stored ones, with marked deviations."""
    flights = max(len(each.flights) for each in result.steps.values())
    what = "one flight" if flights == 1 else f"median of {flights} flights"
    table = Table(
        title=f"Step responses: {what}, beside {reference.title}'s stored ones",
        title_justify="left",
    )
    table.add_column("step")
    table.add_column("")
    for heading, _, _ in FIGURES.values():
        table.add_column(heading, justify="right")
    for name in STEP_NAMES:
        if name not in result.steps:
            continue
        step, median = result.steps[name].step, result.steps[name].median
        stored = reference.steps.get(name, StoredStep())
        outside = {each.figure for each in deviations(median, stored, reference.tolerance)}
        table.add_row(
            f"{name}\n{step.title}",
            f"measured\n{reference.title}\ndifference",
            *(_cell(figure, median, stored, figure in outside) for figure in FIGURES),
            end_section=True,
        )
    return table


def check_table(result: ConformanceResult) -> Table:
    """Return the table of checks."""
    table = Table(title="Checks", title_justify="left")
    table.add_column("check")
    table.add_column("outcome")
    table.add_column("finding", overflow="fold")
    table.add_column("s", justify="right")
    for check in result.checks:
        outcome = Text(check.outcome.value, style=COLOURS[check.outcome])
        table.add_row(check.name, outcome, Text(check.finding), f"{check.time_s:.1f}")
    return table


def _cell(figure: str, median: StepResponse, stored: StoredStep, outside: bool) -> Text:
    """Return measured value, stored value and difference, one below the other."""
    _, scale, digits = FIGURES[figure]
    measured, expected = getattr(median, figure), getattr(stored, figure)
    shown = "never" if math.isnan(measured) else f"{scale * measured:.{digits}f}"
    if expected is None:
        return Text(f"{shown}\n\n")
    # The stored error is an absolute value.
    difference = (abs(measured) if figure == "error" else measured) - expected
    if math.isnan(difference):
        apart = ""
    elif figure.endswith("_s"):
        apart = f"{100.0 * difference / expected:+.0f} %"
    else:
        apart = f"{difference:+.{digits}f}"
    style = "red" if outside else ("green" if figure in JUDGED else "")
    text = Text(f"{shown}\n{scale * expected:.{digits}f}\n")
    text.append(f"{apart}{' !' if outside else ''}", style=style)
    return text

"""The result as people and as programs read it."""

from __future__ import annotations

import math
from typing import Any

from rich.table import Table
from rich.text import Text

from airl_mav.conformance.checks import Check, Outcome
from airl_mav.conformance.reference import JUDGED, Reference, misses
from airl_mav.conformance.sequence import Examination, Findings
from airl_mav.conformance.session import Session
from airl_mav.conformance.step_response import StepResponse
from airl_mav.conformance.stepping import stored_step
from airl_mav.conformance.steps import STEP_NAMES
from airl_mav.conformance.transcript import Line
from airl_mav.core.clock import utc_now

SCHEMA = 1
"""Version of the file."""

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

KINDS = {"sent": "->", "heard": "<-", "check": "==", "note": "--"}
COLOURS = {Outcome.PASSED: "green", Outcome.FAILED: "red", Outcome.NOT_APPLICABLE: "yellow"}


def line_text(line: Line) -> str:
    """Return a line of the transcript."""
    return f"{line.time_s:9.3f} {KINDS[line.kind]} {line.text}"


def step_table(findings: Findings, reference: Reference) -> Table:
    """Return the step responses beside the stored ones; what lies outside is marked."""
    flights = max(len(each.flights) for each in findings.flown.values())
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
        if name not in findings.flown:
            continue
        flown = findings.flown[name]
        stored, median = stored_step(reference, name), flown.median
        outside = {miss.figure for miss in misses(median, stored, reference.tolerance)}
        table.add_row(
            f"{name}\n{flown.step.title}",
            f"measured\n{reference.title}\ndifference",
            *(_cell(figure, median, stored, figure in outside) for figure in FIGURES),
            end_section=True,
        )
    return table


def check_table(checks: list[Check]) -> Table:
    """Return the list of checks."""
    table = Table(title="Checks", title_justify="left")
    table.add_column("check")
    table.add_column("outcome")
    table.add_column("finding", overflow="fold")
    table.add_column("s", justify="right")
    for check in checks:
        outcome = Text(check.outcome.value, style=COLOURS[check.outcome])
        table.add_row(check.name, outcome, Text(check.finding), f"{check.time_s:.1f}")
    return table


def verdict(findings: Findings) -> str:
    """Return the outcome in one line."""
    checks = findings.checklist.checks
    failed = [check.name for check in checks if check.outcome is Outcome.FAILED]
    passed = sum(check.outcome is Outcome.PASSED for check in checks)
    rest = len(checks) - passed - len(failed)
    counted = f"{passed} passed, {len(failed)} failed, {rest} not applicable"
    if findings.interrupted:
        return f"INTERRUPTED: {counted}" + ("" if findings.down else "; NOT known to be down")
    if failed:
        return f"FAILED: {counted}: {', '.join(failed)}" + (
            "" if findings.down else "; NOT known to be down"
        )
    title = findings.reference.title if findings.reference else ""
    return f"CONFORMS to {title}: {counted}"


def as_data(session: Session, asked: Examination, findings: Findings) -> dict[str, Any]:
    """Return everything, for a file."""
    reference, inbox = findings.reference, session.inbox
    return {
        "schema": SCHEMA,
        "date_utc": utc_now().isoformat(timespec="seconds"),
        "connection": session.url,
        "speed": session.speed,
        "asked": {
            "altitude_m": asked.altitude_m,
            "steps": asked.steps,
            "repeat": asked.repeat,
            "behaviour": asked.behaviour,
        },
        "vehicle": {
            "heartbeat": inbox.latest("HEARTBEAT"),
            "autopilot_version": inbox.latest("AUTOPILOT_VERSION"),
        },
        "reference": reference and reference.model_dump(),
        "verdict": verdict(findings),
        "passed": findings.checklist.passed and not findings.interrupted,
        "interrupted": findings.interrupted,
        "known_to_be_down": findings.down,
        "checks": [
            {**check._asdict(), "outcome": check.outcome.value}
            for check in findings.checklist.checks
        ],
        "steps": [
            {
                "name": name,
                "title": flown.step.title,
                "median": _plain(flown.median),
                "flights": [_plain(each) for each in flown.flights],
            }
            for name, flown in findings.flown.items()
        ],
        "transcript": [line._asdict() for line in session.transcript.lines],
    }


def _cell(figure: str, median: StepResponse, stored: Any, outside: bool) -> Text:
    """Return measured over stored over their difference."""
    _, scale, digits = FIGURES[figure]
    measured, held = getattr(median, figure), getattr(stored, figure)
    shown = "never" if math.isnan(measured) else f"{scale * measured:.{digits}f}"
    if held is None:
        return Text(f"{shown}\n\n")
    # What is stored of the error is its size.
    difference = (abs(measured) if figure == "error" else measured) - held
    if math.isnan(difference):
        apart = ""
    elif figure.endswith("_s"):
        apart = f"{100.0 * difference / held:+.0f} %"
    else:
        apart = f"{difference:+.{digits}f}"
    style = "red" if outside else ("green" if figure in JUDGED else "")
    text = Text(f"{shown}\n{scale * held:.{digits}f}\n")
    text.append(f"{apart}{' !' if outside else ''}", style=style)
    return text


def _plain(response: StepResponse) -> dict[str, float | None]:
    """JSON has no word for NaN."""
    return {
        name: None if math.isnan(value) else value for name, value in response._asdict().items()
    }

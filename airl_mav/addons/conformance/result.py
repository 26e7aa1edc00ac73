"""Result of a conformance run: deviations from the stored reference, file and terminal output."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, Field
from rich.table import Table
from rich.text import Text

from airl_mav.addons.conformance import checklist, telemetry
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError, usage_errors
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.core.files import write_json
from airl_mav.profiles.loading import load_profile

AUTO = "auto"
"""Selects the stored column of the firmware's release, or of the nearest one."""

JUDGED = ("latency_s", "rise_s", "overshoot_percent")
"""Figures with a tolerance; the others follow from these, or are noise."""


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


class Tolerance(ProfileModel):
    """Maximum deviation of a figure from the stored one."""

    latency_share: float = quantity("latency, of the stored one", "1", gt=0, le=1, default=0.10)
    rise_share: float = quantity("rise time, of the stored one", "1", gt=0, le=1, default=0.10)
    floor_s: float = quantity(
        "any time may be so far off: one sample of telemetry", "s", ge=0, le=1, default=0.010
    )
    overshoot_points: float = quantity("overshoot", "% of step", gt=0, le=100, default=5.0)


class StoredStep(ProfileModel):
    """Measured step; figures without a measurement are omitted."""

    latency_s: float | None = quantity("until the first movement", "s", gt=0, default=None)
    t10_s: float | None = quantity("until 10 %", "s", gt=0, default=None)
    t50_s: float | None = quantity("until 50 %", "s", gt=0, default=None)
    rise_s: float | None = quantity("10 % to 90 %", "s", gt=0, default=None)
    overshoot_percent: float | None = quantity("overshoot", "% of step", ge=0, default=None)
    error: float | None = quantity("size of the error at the end", "unit", ge=0, default=None)
    settle_s: float | None = quantity("until within 5 %", "s", gt=0, default=None)


class Reference(ProfileModel):
    """Stored column of one firmware."""

    title: str = Field(description="name of the firmware")
    source: str = Field(description="where the figures come from")
    tolerance: Tolerance = Field(default_factory=Tolerance, description="tolerances")
    streams_hz: Mapping[str, float] = Field(
        description="messages that a fresh UDP link carries unasked [Hz]"
    )
    steps: Mapping[telemetry.StepName, StoredStep] = Field(description="step responses")


class Deviation(NamedTuple):
    """Figure outside its tolerance."""

    figure: str
    measured: float
    stored: float
    allowed: float
    """Maximum allowed difference, in the figure's unit."""

    def __str__(self) -> str:
        heading, scale, digits = FIGURES[self.figure]
        found, stored, allowed = (f"{scale * value:.{digits}f}" for value in self[1:])
        return f"{heading} {found}, stored {stored} +- {allowed}".replace("\n", " in ")


def deviations(
    measured: telemetry.StepResponse, stored: StoredStep, tolerance: Tolerance
) -> list[Deviation]:
    """Return the deviations of latency, rise time and overshoot; NaN always deviates."""
    floor_s = tolerance.floor_s
    found = []
    for figure, share, floor in (
        ("latency_s", tolerance.latency_share, floor_s),
        ("rise_s", tolerance.rise_share, floor_s),
        ("overshoot_percent", 0.0, tolerance.overshoot_points),
    ):
        expected: float | None = getattr(stored, figure)
        if expected is None:
            continue
        allowed = max(share * expected, floor)
        value: float = getattr(measured, figure)
        # Undershoot counts as zero overshoot: the final error shows it.
        compared = max(value, 0.0) if figure == "overshoot_percent" else value
        if math.isnan(value) or abs(compared - expected) > allowed:
            found.append(Deviation(figure, value, expected, allowed))
    return found


def summary(response: telemetry.StepResponse) -> str:
    """Return the judged figures in one line."""
    return (
        f"latency {1e3 * response.latency_s:.0f} ms, rise {1e3 * response.rise_s:.0f} ms, "
        f"overshoot {max(response.overshoot_percent, 0.0):.1f} %"
    )


def judge(measured: telemetry.MeasuredStep | None, reference: Reference) -> str:
    """Return the finding of a step. Raises CheckFailedError if missing or deviating."""
    if measured is None:
        raise checklist.CheckFailedError("not flown")
    stored = reference.steps.get(measured.step.name)
    if stored is None:
        raise checklist.CheckFailedError(f"nothing stored for {reference.title}")
    found = deviations(measured.median, stored, reference.tolerance)
    checklist.require(not found, "; ".join(map(str, found)))
    return summary(measured.median)


SCHEMA = 1


class ConformanceSettings(BaseModel):
    """Settings of a run."""

    connect: str = Field(
        default="udpin://127.0.0.1:14540",
        description="MAVSDK connection to the flight controller: udpin://HOST:PORT or"
        " serial://DEVICE:BAUD",
    )
    reference: str = Field(
        default=AUTO,
        description="stored step responses to compare with: auto (by the firmware's release), a"
        " name such as px4-1.17, or a path to a .toml",
    )
    speed: float = Field(
        default=1.0,
        ge=0.01,
        le=100.0,
        description="simulated seconds per wall second of the vehicle; 1 for a real one",
    )
    altitude_m: float = Field(
        default=10.0,
        description="take-off altitude, 8 to 100 m, with --steps-only from 2 m: PX4 comes down"
        " while it waits for setpoints",
    )
    repeat: int = Field(
        default=1,
        ge=1,
        le=20,
        description="how often the steps are flown, 1 to 20: the table has the median; every other"
        " time they are mirrored, so that the vehicle comes back",
    )
    steps: tuple[str, ...] | None = Field(
        default=None,
        description="names of the steps to fly, as north-2 yaw-90; by default all",
    )
    steps_only: bool = Field(
        default=False,
        description="check neither refusals nor frames, offboard loss or hold: fly the steps",
    )
    connect_timeout_s: float = Field(
        default=30.0,
        ge=1.0,
        le=3600.0,
        description="how long a flight controller is waited for, 1 to 3600 s of wall time",
    )

    @property
    def flown_steps(self) -> tuple[str, ...]:
        """Names of the steps to fly."""
        return telemetry.STEP_NAMES if self.steps is None else self.steps

    def check(self) -> None:
        """Raise UsageError if a value does not fit the others."""
        lowest_m = 2 if self.steps_only else 8
        if not lowest_m <= self.altitude_m <= 100.0:
            raise FieldError("altitude_m", self.altitude_m, f"{lowest_m} <= value <= 100")
        for step in self.flown_steps:
            if step not in telemetry.STEP_NAMES:
                raise FieldError("steps", step, ", ".join(telemetry.STEP_NAMES))
        if self.reference != AUTO:
            load_profile("conformance", self.reference, Reference)


@dataclass
class ConformanceResult:
    """Results of a complete or interrupted run."""

    settings: ConformanceSettings
    checks: list[checklist.ConformanceCheck] = field(default_factory=list)
    transcript: list[checklist.TranscriptLine] = field(default_factory=list)
    steps: dict[telemetry.StepName, telemetry.MeasuredStep] = field(default_factory=dict)
    """Step responses, by step name."""
    reference: Reference | None = None
    """Stored column; None before the autopilot is known."""
    heartbeat: telemetry.Fields | None = None
    autopilot_version: telemetry.Fields | None = None
    firmware: str = ""
    """Name and version of the firmware; empty before they are known."""
    interrupted: bool = False
    known_to_be_down: bool = True
    """True if the vehicle is known to be disarmed at the end."""

    @property
    def passed(self) -> bool:
        """True if checks were made and all passed."""
        return bool(self.checks) and not self._named("fail") and not self.interrupted

    @property
    def verdict(self) -> str:
        """Outcome in one line."""
        failed, passed = self._named("fail"), len(self._named("pass"))
        rest = len(self.checks) - passed - len(failed)
        counted = f"{passed} passed, {len(failed)} failed, {rest} not applicable"
        end = f"; {self.firmware}" if self.firmware else ""
        end += "" if self.known_to_be_down else "; NOT known to be down"
        if self.interrupted:
            return f"INTERRUPTED: {counted}{end}"
        if failed:
            return f"FAILED: {counted}: {', '.join(failed)}{end}"
        return f"CONFORMS to {self.reference.title if self.reference else ''}: {counted}{end}"

    def _named(self, outcome: str) -> list[str]:
        return [check.name for check in self.checks if check.outcome.value == outcome]

    def as_data(self) -> dict[str, Any]:
        """Return all results in the file format of docs/reference/conformance.md."""
        return {
            "schema": SCHEMA,
            "date_utc": utc_now().isoformat(timespec="seconds"),
            "settings": self.settings.model_dump(),
            "firmware": self.firmware,
            "vehicle": {"heartbeat": self.heartbeat, "autopilot_version": self.autopilot_version},
            "reference": self.reference and self.reference.model_dump(),
            "verdict": self.verdict,
            "passed": self.passed,
            "interrupted": self.interrupted,
            "known_to_be_down": self.known_to_be_down,
            "checks": [
                {**check._asdict(), "outcome": check.outcome.value} for check in self.checks
            ],
            "steps": [
                {
                    "name": name,
                    "title": measured.step.title,
                    "median": _without_nan(measured.median),
                    "flights": [_without_nan(each) for each in measured.flights],
                }
                for name, measured in self.steps.items()
            ],
            "transcript": [line._asdict() for line in self.transcript],
        }

    def write(self, path: Path) -> None:
        """Write all results to a .json. Raises UsageError if it cannot be written."""
        with usage_errors(path):
            write_json(path, self.as_data())


def _without_nan(response: telemetry.StepResponse) -> dict[str, float | None]:
    """Return the figures with None for NaN, which JSON does not support."""
    return {
        name: None if math.isnan(value) else value for name, value in response._asdict().items()
    }


LINE_MARKS = {"sent": ("->", "cyan"), "heard": ("<-", ""), "check": ("==", "bold")}
COLOURS = {
    checklist.CheckOutcome.PASSED: "green",
    checklist.CheckOutcome.FAILED: "red",
    checklist.CheckOutcome.NOT_APPLICABLE: "yellow",
}


def line_text(line: checklist.TranscriptLine) -> Text:
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
    for name in telemetry.STEP_NAMES:
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


def _cell(figure: str, median: telemetry.StepResponse, stored: StoredStep, outside: bool) -> Text:
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

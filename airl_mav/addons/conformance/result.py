"""Result of a conformance run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from airl_mav.addons.conformance.checklist import CheckOutcome, ConformanceCheck, TranscriptLine
from airl_mav.addons.conformance.reference import Reference
from airl_mav.addons.conformance.steps import STEP_NAMES, MeasuredStep, StepName, StepResponse
from airl_mav.addons.conformance.telemetry import Fields
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.files import write_json

SCHEMA = 1


@dataclass(frozen=True)
class ConformanceSettings:
    """Settings of a run; see `check_conformance`."""

    connect: str
    reference: str
    speed: float
    altitude_m: float
    steps: tuple[StepName, ...]
    repeat: int
    steps_only: bool
    connect_timeout_s: float

    def __post_init__(self) -> None:
        """Raise UsageError if a value is out of range."""
        lowest_m = 2.0 if self.steps_only else 8.0
        for name, value, low, high in (
            ("speed", self.speed, 0.01, 100.0),
            ("altitude_m", self.altitude_m, lowest_m, 100.0),
            ("repeat", self.repeat, 1, 20),
            ("connect_timeout_s", self.connect_timeout_s, 1.0, 3600.0),
        ):
            if not low <= value <= high:
                raise FieldError(name, value, f"{low:g} <= value <= {high:g}")
        for step in self.steps:
            if step not in STEP_NAMES:
                raise FieldError("steps", step, ", ".join(STEP_NAMES))


@dataclass
class ConformanceResult:
    """Results of a complete or interrupted run."""

    settings: ConformanceSettings
    checks: list[ConformanceCheck] = field(default_factory=list)
    transcript: list[TranscriptLine] = field(default_factory=list)
    steps: dict[StepName, MeasuredStep] = field(default_factory=dict)
    """Step responses, by step name."""
    reference: Reference | None = None
    """Stored column; None before the autopilot is known."""
    heartbeat: Fields | None = None
    autopilot_version: Fields | None = None
    interrupted: bool = False
    known_to_be_down: bool = True
    """True if the vehicle is known to be disarmed at the end."""

    @property
    def passed(self) -> bool:
        """True if checks were made and all passed."""
        failed = any(check.outcome is CheckOutcome.FAILED for check in self.checks)
        return bool(self.checks) and not failed and not self.interrupted

    @property
    def verdict(self) -> str:
        """Outcome in one line."""
        failed = [check.name for check in self.checks if check.outcome is CheckOutcome.FAILED]
        passed = sum(check.outcome is CheckOutcome.PASSED for check in self.checks)
        rest = len(self.checks) - passed - len(failed)
        counted = f"{passed} passed, {len(failed)} failed, {rest} not applicable"
        down = "" if self.known_to_be_down else "; NOT known to be down"
        if self.interrupted:
            return f"INTERRUPTED: {counted}{down}"
        if failed:
            return f"FAILED: {counted}: {', '.join(failed)}{down}"
        return f"CONFORMS to {self.reference.title if self.reference else ''}: {counted}"

    def as_data(self) -> dict[str, Any]:
        """Return all results in the file format of docs/conformance.md."""
        settings = self.settings
        return {
            "schema": SCHEMA,
            "date_utc": utc_now().isoformat(timespec="seconds"),
            "connection": settings.connect,
            "speed": settings.speed,
            "asked": {
                "altitude_m": settings.altitude_m,
                "steps": settings.steps,
                "repeat": settings.repeat,
                "behaviour": not settings.steps_only,
            },
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
        try:
            write_json(path, self.as_data())
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from None


def _without_nan(response: StepResponse) -> dict[str, float | None]:
    """Return the figures with None for NaN, which JSON does not support."""
    return {
        name: None if math.isnan(value) else value for name, value in response._asdict().items()
    }

"""Transcript of a run, and its checks with their outcomes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from enum import Enum
from functools import partial
from typing import Any, Literal, NamedTuple

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from companion.interfaces import LinkError

LineKind = Literal["sent", "heard", "check", "note"]


class TranscriptLine(NamedTuple):
    """One line of the transcript."""

    time_s: float
    """Time since the start, in the vehicle's seconds [s]."""
    kind: LineKind
    text: str


class Transcript:
    """Ordered log of all messages sent and received; written by any thread."""

    def __init__(self, clock: Clock, progress: Callable[[TranscriptLine], None]) -> None:
        """Start empty. `progress` is called with each line, by the thread that adds it."""
        self._clock, self._progress = clock, progress
        self._lock = threading.Lock()
        self.lines: list[TranscriptLine] = []
        self._repeated = 0

    @property
    def time_s(self) -> float:
        """Current time on the lines' scale [s]."""
        return self._clock.time_us() / US_PER_S

    def add(self, kind: LineKind, text: str) -> None:
        """Add a line; a repetition of the last line is only counted."""
        with self._lock:
            if self.lines and self.lines[-1][1:] == (kind, text):
                self._repeated += 1
                return
            if self._repeated:
                self._append("note", f"... and {self._repeated} times more")
                self._repeated = 0
            self._append(kind, text)

    def _append(self, kind: LineKind, text: str) -> None:
        line = TranscriptLine(self.time_s, kind, text)
        self.lines.append(line)
        self._progress(line)


class CheckOutcome(Enum):
    """Outcome of a check."""

    PASSED = "pass"
    FAILED = "fail"
    NOT_APPLICABLE = "not applicable"


class ConformanceCheck(NamedTuple):
    """Completed check."""

    name: str
    outcome: CheckOutcome
    finding: str
    time_s: float
    """Duration by the transcript's clock [s]."""


class CheckFailedError(Exception):
    """Failure of a check; the message is its finding."""


class NotApplicableError(Exception):
    """The check does not apply to this vehicle; the message is the reason."""


def require(condition: object, finding: str) -> None:
    """Raise CheckFailedError with a finding unless a condition is true."""
    if not condition:
        raise CheckFailedError(finding)


class CheckDefinition(NamedTuple):
    """Definition of a check."""

    name: str
    function: Callable[[Any], str]
    """Runs the check on a Vehicle and returns its finding. Raises as in `Checklist.perform`."""
    essential: bool = False
    """True if its failure skips the rest of the table."""
    for_steps: bool = False
    """True if it also runs for step responses alone."""


class Checklist:
    """Checks in the order of execution."""

    def __init__(self, transcript: Transcript) -> None:
        self._transcript = transcript
        self.checks: list[ConformanceCheck] = []

    def perform(self, name: str, check: Callable[[], str]) -> bool:
        """Run a check and return True if it did not fail.

        `check` returns its finding, or raises CheckFailedError or NotApplicableError. LinkError and
        KeyboardInterrupt are recorded as failures and raised again.
        """
        start_s = self._transcript.time_s
        try:
            self._note(name, CheckOutcome.PASSED, check(), start_s)
        except NotApplicableError as reason:
            self._note(name, CheckOutcome.NOT_APPLICABLE, str(reason), start_s)
        except CheckFailedError as finding:
            self._note(name, CheckOutcome.FAILED, str(finding), start_s)
            return False
        except (LinkError, KeyboardInterrupt) as error:
            self._note(name, CheckOutcome.FAILED, str(error) or "interrupted", start_s)
            raise
        return True

    def perform_all(
        self, table: Iterable[CheckDefinition], vehicle: Any, *, steps_only: bool = False
    ) -> bool:
        """Make the checks of a table on a Vehicle; return True if no essential one failed."""
        return all(
            self.perform(entry.name, partial(entry.function, vehicle)) or not entry.essential
            for entry in table
            if entry.for_steps or not steps_only
        )

    def skip(self, name: str, reason: str) -> None:
        """Record a check that could not be made as failed."""
        self._note(name, CheckOutcome.FAILED, reason, self._transcript.time_s)

    def _note(self, name: str, outcome: CheckOutcome, finding: str, start_s: float) -> None:
        self.checks.append(
            ConformanceCheck(name, outcome, finding, self._transcript.time_s - start_s)
        )
        self._transcript.add("check", f"{name}: {outcome.value}: {finding}")

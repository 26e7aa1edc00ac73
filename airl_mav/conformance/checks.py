"""Named checks and their outcomes."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

from airl_mav.conformance.transcript import Transcript
from companion.interfaces import LinkError


class Outcome(Enum):
    """What came of a check."""

    PASSED = "pass"
    FAILED = "fail"
    NOT_APPLICABLE = "not applicable"


class Check(NamedTuple):
    """A check that was made."""

    name: str
    outcome: Outcome
    finding: str
    """One line."""
    time_s: float
    """How long it took, by the transcript's clock [s]."""


class FailedError(Exception):
    """A check's finding when it fails."""


class NotApplicableError(Exception):
    """Why a check says nothing here."""


def require(condition: bool, finding: str) -> None:
    """Raise FailedError with a finding unless a condition holds."""
    if not condition:
        raise FailedError(finding)


class Checklist:
    """Checks in the order in which they are made."""

    def __init__(self, transcript: Transcript) -> None:
        self._transcript = transcript
        self.checks: list[Check] = []

    def perform(self, name: str, check: Callable[[], str]) -> bool:
        """Make a check.

        Args:
            name: What it is called.
            check: Makes it and returns its finding; raises FailedError,
                NotApplicableError or LinkError.

        Returns:
            Whether it did not fail.

        Raises:
            LinkError: The vehicle is gone; noted as failed.
        """
        start_s = self._transcript.time_s
        try:
            self._note(name, Outcome.PASSED, check(), start_s)
        except NotApplicableError as reason:
            self._note(name, Outcome.NOT_APPLICABLE, str(reason), start_s)
        except FailedError as finding:
            self._note(name, Outcome.FAILED, str(finding), start_s)
            return False
        except LinkError as error:
            self._note(name, Outcome.FAILED, str(error), start_s)
            raise
        except KeyboardInterrupt:
            self._note(name, Outcome.FAILED, "interrupted", start_s)
            raise
        return True

    def skip(self, name: str, reason: str) -> None:
        """Note a check that could not be made as failed."""
        self._note(name, Outcome.FAILED, reason, self._transcript.time_s)

    @property
    def passed(self) -> bool:
        """Whether there are checks and none failed."""
        return bool(self.checks) and all(c.outcome is not Outcome.FAILED for c in self.checks)

    def _note(self, name: str, outcome: Outcome, finding: str, start_s: float) -> None:
        check = Check(name, outcome, finding, self._transcript.time_s - start_s)
        self.checks.append(check)
        self._transcript.say("check", f"{name}: {outcome.value}: {finding}")

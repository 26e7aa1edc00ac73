"""Errors meant for the person at the keyboard: one line, exit code 2, no traceback."""

from __future__ import annotations

EXIT_BROKEN = 1
"""The run could not be finished: a flight lost its processes, or its worker, too often."""

EXIT_USAGE = 2
"""The input cannot be used."""

EXIT_INTERRUPTED = 130
"""Ctrl-C (128 + SIGINT)."""


class UsageError(Exception):
    """Input that cannot be used. The message names the file, field, value and accepted range."""


class FieldError(UsageError):
    """A field with a value that cannot be used; whoever knows its option or file names that."""

    def __init__(self, field: str, value: object, accepted: str) -> None:
        """Take the dotted field name, its value, and what is accepted instead."""
        super().__init__(f"{field} = {value}: accepted: {accepted}")
        self.field, self.value, self.accepted = field, value, accepted

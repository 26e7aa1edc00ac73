"""Errors meant for the person at the keyboard: one line, no traceback.

Input that cannot be used ends a command with exit code 2, a failure of the machine with 1.
"""

from __future__ import annotations

import errno
import reprlib
from pathlib import PurePath

EXIT_BROKEN = 1
"""The run could not be finished: a flight lost its processes, or its worker, too often."""

EXIT_USAGE = 2
"""The input cannot be used."""

EXIT_NOT_MET = 3
"""All was flown, and a requirement is not met."""

EXIT_INVALID = 4
"""All was flown, but flights stayed invalid: the host could not keep up. There is no verdict."""

EXIT_UNDECIDED = 5
"""All was flown, and it was too little to tell whether a requirement is met."""

EXIT_INTERRUPTED = 130
"""Ctrl-C (128 + SIGINT)."""

MISSING = object()
"""Value of a field that was not given."""

LONGEST_VALUE = 80
"""Characters of a value that a message shows."""


class UsageError(Exception):
    """Input that cannot be used. The message names the file, field, value and accepted range."""


class FieldError(UsageError):
    """A field of a scenario or a file that cannot be used.

    The field is kept apart from the rest, so that each front end can name it in its own way: as an
    option of a command, as a key of a file.
    """

    def __init__(
        self, field: str, value: object = MISSING, accepted: str = "", problem: str = ""
    ) -> None:
        """Describe a field by its dotted path, "" for the whole, and the value that was given.

        The value is `MISSING` when there was none or when it would not help. `accepted` is a range
        such as "0 < value <= 10 s"; `problem` replaces it where it says more.
        """
        # All arguments, so that the error can be pickled between processes.
        super().__init__(field, value, accepted, problem)
        self.field = field
        self.value = value
        self.accepted = accepted
        self.problem = problem

    def line(self, name: str | None = None, sign: str = " ") -> str:
        """Return the message in one line: "NAME VALUE: accepted: RANGE".

        `name` is that of an option, whose value is shown as typed; None: the dotted path. `sign`
        stands between name and value, " = " in messages about files.
        """
        where = self.field if name is None else name
        if self.value is not MISSING:
            typed = isinstance(self.value, str) and name is not None
            value = shortened(str(self.value)) if typed else shown(self.value)
            where = f"{where}{sign}{value}" if where else value
        what = self.problem or f"accepted: {self.accepted}"
        return f"{where}: {what}" if where else what

    def __str__(self) -> str:
        """Return the message in one line."""
        return self.line()


class UnexpectedArgumentError(UsageError, TypeError):
    """A keyword argument that a function does not have.

    Python's own error for it as well: callers who offer what not every environment takes (TorchRL
    its `frameskip`) look for that and try without.
    """


MACHINE_ERRORS = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EMFILE, errno.ENFILE}
)
"""System errors that the machine is to blame for: a full or broken disk, no more open files."""


def machine_failure(error: OSError) -> str | None:
    """Return one line about a failure of the machine (exit code 1), None for any other error."""
    if error.errno not in MACHINE_ERRORS:
        return None
    return f"{error.filename}: {error.strerror}" if error.filename else f"{error.strerror}"


def shown(value: object) -> str:
    """Return a value as a message shows it: numbers as a person writes them, never too long."""
    if isinstance(value, float) and float(f"{value:g}") == value:
        return min(f"{value:g}", repr(value), key=len)
    if isinstance(value, PurePath):
        return shortened(str(value))
    try:
        # reprlib stops early in containers; a plain repr of a long list or number takes ages.
        text = _REPR.repr(value)
    except ValueError:  # A whole number with more digits than Python turns into text.
        return "a number of too many digits"
    return shortened(text)


def shortened(text: str) -> str:
    """Return a text as a message shows it: never too long."""
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."


_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = LONGEST_VALUE

"""Errors for the user: one line, no traceback.

Invalid input ends a command with exit code 2, a failure of the machine with 1.
"""

from __future__ import annotations

import errno
import re
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import PurePath

EXIT_BROKEN = 1
"""Exit code: a run ended early, as a flight or a worker lost its processes too often."""

EXIT_USAGE = 2
"""Exit code: invalid input."""

EXIT_NOT_MET = 3
"""Exit code: all flights are complete, and a requirement is not met."""

EXIT_INVALID = 4
"""Exit code: flights remain invalid as the host could not keep up. There is no verdict."""

EXIT_UNDECIDED = 5
"""Exit code: all flights are complete, and too few to decide a requirement."""

EXIT_INTERRUPTED = 130
"""Exit code: Ctrl-C (128 + SIGINT)."""

MISSING = object()
"""Marker for a field without a value."""

LONGEST_VALUE = 80
"""Maximum length of a value in a message [characters]."""


class UsageError(Exception):
    """Invalid input. The message names the file, field, value and accepted range."""


class FieldError(UsageError):
    """Invalid field of a scenario or a file.

    The field is stored separately, so each front end can name it differently: as an option of a
    command, or as a key of a file.
    """

    def __init__(
        self, field: str, value: object = MISSING, accepted: str = "", problem: str = ""
    ) -> None:
        """Describe a field by its dotted path, "" for the whole, and its value.

        The value is `MISSING` if it does not exist or does not help. `accepted` is a range such as
        "0 < value <= 10 s"; `problem` replaces it with a better explanation.
        """
        # All arguments, to support pickling between processes.
        super().__init__(field, value, accepted, problem)
        self.field = field
        self.value = value
        self.accepted = accepted
        self.problem = problem

    def line(self, name: str | None = None, sign: str = " ") -> str:
        """Return the message in one line: "NAME VALUE: accepted: RANGE".

        `name` is an option, whose value is shown as typed; None = the dotted path. `sign` separates
        name and value, " = " in messages about files.
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
    """Unsupported keyword argument of a function.

    Also a TypeError, Python's error for this case: callers with optional arguments (TorchRL with
    `frameskip`) catch it and retry without them.
    """


@contextmanager
def usage_errors(where: object) -> Iterator[None]:
    """Raise UsageError, with a file or an option, for a system error within the context."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"{where}: {error.strerror}") from None


MACHINE_ERRORS = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EMFILE, errno.ENFILE}
)
"""System errors caused by the machine: a full or broken disk, too many open files."""


def machine_failure(error: OSError) -> str | None:
    """Return one line about a failure of the machine (exit code 1), None for any other error."""
    if error.errno not in MACHINE_ERRORS:
        return None
    return f"{error.filename}: {error.strerror}" if error.filename else f"{error.strerror}"


def shown(value: object) -> str:
    """Return a value as text for messages: numbers in short notation, limited in length."""
    if isinstance(value, float) and float(f"{value:g}") == value:
        return min(f"{value:g}", repr(value), key=len)
    if isinstance(value, PurePath):
        return shortened(str(value))
    try:
        # reprlib stops early in containers; repr of a long list or number is slow.
        text = _REPR.repr(value)
    except ValueError:  # An integer with more digits than Python converts.
        return "a number of too many digits"
    return shortened(text)


def shortened(text: str) -> str:
    """Return a text for messages, limited in length."""
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."


_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = LONGEST_VALUE


PAGE = "docs/not-supported.md"
"""Page about everything that airl-mav does not do."""

_WORDS = re.compile(
    "(?:num-)?(?:drones|vehicles)|swarm"
    "|(?:arduplane|ardurover|ardusub|betaflight|inav)"
    "|(?:gazebo|gz)(?:[-_].*)?|airsim|flightgear|isaac|isaac-sim|jmavsim|jsbsim|simulink|webots"
    "|(?:hexa|octo|tri)(?:copter|rotor)?|boat|fixed[-_]?wing|helicopter|plane|rover|tailsitter|vtol",
    re.IGNORECASE,
)
"""Words on a command line for an unsupported vehicle, firmware or simulator."""


def refer(words: Iterable[str]) -> str | None:
    """Return a reference to the page for the first such word of a rejected command line."""
    for word in words:
        for part in word.lstrip("-").split("=", 1):
            if _WORDS.fullmatch(part):
                return f"{part} is unsupported: see {PAGE}"
    return None

"""What all commands share: errors in one line, exit codes."""

from __future__ import annotations

import sys
from collections.abc import Callable

from rich.console import Console

from airl_mav.errors import UsageError

EXIT_BROKEN = 1
"""The run could not be finished: a process died."""

EXIT_USAGE = 2
"""The input cannot be used."""

EXIT_INTERRUPTED = 130
"""Ctrl-C (128 + SIGINT)."""


def run_command(command: Callable[[], int]) -> None:
    """Run a command and exit with its code; usage errors become one line and exit code 2."""
    try:
        code = command()
    except UsageError as error:
        Console(stderr=True, soft_wrap=True).print(f"error: {error}", style="red", markup=False)
        code = EXIT_USAGE
    except KeyboardInterrupt:
        code = EXIT_INTERRUPTED
    sys.exit(code)

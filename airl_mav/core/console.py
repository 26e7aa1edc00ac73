"""Where commands print: rich's console, without its markup.

What is printed are paths, names and messages of others. Brackets in them are brackets, not styles,
and `:name:` is no emoji. Who wants a style gives it by name.
"""

from __future__ import annotations

from typing import IO

from rich.console import Console


def new_console(
    *,
    stderr: bool = False,
    quiet: bool = False,
    soft_wrap: bool = False,
    file: IO[str] | None = None,
    width: int | None = None,
) -> Console:
    """Return a console; with `soft_wrap`, lines longer than the terminal stay whole."""
    return Console(
        stderr=stderr,
        quiet=quiet,
        soft_wrap=soft_wrap,
        file=file,
        width=width,
        markup=False,
        emoji=False,
    )

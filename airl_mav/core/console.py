"""Console output by rich, without its markup.

The output contains paths, names and external messages. Square brackets in them are not styles, and
`:name:` is not an emoji. Pass styles by name.
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
    """Return a console; `soft_wrap` keeps lines longer than the terminal whole."""
    return Console(
        stderr=stderr,
        quiet=quiet,
        soft_wrap=soft_wrap,
        file=file,
        width=width,
        markup=False,
        emoji=False,
    )

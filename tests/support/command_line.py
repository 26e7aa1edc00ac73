"""Commands in this process: a command line in, exit status and printed text out."""

from __future__ import annotations

import io
from typing import Any

from airl_mav.cli.main import subcommands
from airl_mav.cli.options import carry_out
from airl_mav.core.progress import new_console


def airl(name: str, *words: str, width: int | None = None) -> tuple[int, str]:
    """Run `airl NAME WORDS`; usage errors are raised, their text naming the option.

    Without a width of the terminal, lines are as long as they are.
    """
    out = io.StringIO()
    console = new_console(file=out, width=width or 200, soft_wrap=width is None)
    code = carry_out(
        f"airl {name}", subcommands()[name.replace("_", "-")][2], words, console=console
    )
    return code, out.getvalue()


def option_words(**options: Any) -> list[str]:
    """Return options as words: `hold_s=0.4` is `--hold-s 0.4`, a tuple several values, True a flag.

    None and False leave an option out.
    """
    words: list[str] = []
    for name, value in options.items():
        if value is None or value is False:
            continue
        words.append("--" + name.replace("_", "-"))
        if value is not True:
            values = value if isinstance(value, tuple) else (value,)
            words += [str(each) for each in values]
    return words

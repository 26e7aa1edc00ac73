"""Commands in this process: a command line in, exit status and printed text out."""

from __future__ import annotations

import io

from rich.console import Console

from airl_mav.cli.options import carry_out


def airl(name: str, *words: str, width: int = 200) -> tuple[int, str]:
    """Run `airl NAME WORDS`; usage errors are raised, their text naming the option."""
    out = io.StringIO()
    console = Console(file=out, width=width, soft_wrap=True)
    code = carry_out(f"airl {name}", f"airl_mav.cli.{name}", words, console=console)
    return code, out.getvalue()

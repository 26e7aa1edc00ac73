"""Entry points of the console scripts: say what to install when a part is missing.

The companion's installation is light; the commands of the simulator are there all the same, and
must not greet its user with a traceback.
"""

from __future__ import annotations

import importlib
import sys

from rich.console import Console

from airl_mav.cli.common import EXIT_USAGE


def _main_of(command: str, extra: str) -> None:
    """Import `airl_mav.cli.<command>` and run its main."""
    try:
        module = importlib.import_module(f"airl_mav.cli.{command}")
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in ("airl_mav", "companion", "firmware_sim"):
            raise  # ours, not an optional part
        Console(stderr=True, soft_wrap=True).print(
            f"error: {missing} is not installed: pip install 'airl-mav[{extra}]'",
            style="red",
            markup=False,
        )
        sys.exit(EXIT_USAGE)
    module.main()


def sitl() -> None:
    """`airl-sitl`."""
    _main_of("sitl", "sim")


def firmware() -> None:
    """`airl-firmware`."""
    _main_of("firmware", "sim")


def companion() -> None:
    """`airl-companion`."""
    _main_of("companion", "sim")


def airl() -> None:
    """`airl`."""
    _main_of("main", "sim")

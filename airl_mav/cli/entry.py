"""Entry points of the console scripts: say what to install when a part is missing.

The companion's installation is light; the commands of the simulator are there all the same, and
must not greet its user with a traceback.
"""

from __future__ import annotations

import importlib

from airl_mav.cli.common import check_installed, run_command


def _start(command: str, *needed: str) -> None:
    """Run the main of `airl_mav.cli.<command>`, if the extras that it needs are installed."""

    def start() -> int:
        check_installed(*needed)
        importlib.import_module(f"airl_mav.cli.{command}").main()
        return 0

    # The imports take a second: who interrupts them sees no traceback either.
    run_command(start)


def sitl() -> None:
    """`airl-sitl`."""
    _start("sitl", "sim")


def firmware() -> None:
    """`airl-firmware`."""
    _start("firmware", "sim")


def companion() -> None:
    """`airl-companion`: needs nothing beyond the light installation."""
    _start("companion")


def airl() -> None:
    """`airl`: each subcommand says itself what it needs."""
    _start("main")

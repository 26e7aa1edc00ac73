"""Entry points of the console scripts. Light: `airl --help` loads no option models."""

from __future__ import annotations

import sys


def sitl() -> None:
    """Run `airl-sitl`."""
    from airl_mav.cli.options import run_command

    run_command("airl-sitl", "airl_mav.cli.sitl_command")


def firmware() -> None:
    """Run `airl-firmware`."""
    from airl_mav.cli.options import run_command

    run_command("airl-firmware", "airl_mav.cli.firmware_command")


def companion() -> None:
    """Run `airl-companion`, which needs only the light installation."""
    from airl_mav.cli.options import run_command

    run_command("airl-companion", "airl_mav.cli.companion_command")


def airl() -> None:
    """Run `airl` with its subcommands."""
    from airl_mav.cli.main import main

    main(sys.argv[1:])

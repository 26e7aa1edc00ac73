"""Entry points of the console scripts. Light: `airl --help` loads no models of options."""

from __future__ import annotations

import sys


def sitl() -> None:
    """`airl-sitl`."""
    from airl_mav.cli.options import run_command

    run_command("airl-sitl", "airl_mav.cli.sitl")


def firmware() -> None:
    """`airl-firmware`."""
    from airl_mav.cli.options import run_command

    run_command("airl-firmware", "airl_mav.cli.firmware")


def companion() -> None:
    """`airl-companion`: needs nothing beyond the light installation."""
    from airl_mav.cli.options import run_command

    run_command("airl-companion", "airl_mav.cli.companion")


def airl() -> None:
    """`airl`: the subcommands."""
    from airl_mav.cli.main import main

    main(sys.argv[1:])

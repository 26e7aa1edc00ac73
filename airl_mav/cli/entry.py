"""Entry points of the console scripts: say what to install when a part is missing.

The companion's installation is light; the commands of the simulator are there all the same, and
must not greet its user with a traceback.
"""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec

from rich.console import Console

from airl_mav.cli.common import EXIT_INTERRUPTED, EXIT_USAGE

SIM_MODULES = ("filterpy", "jinja2", "matplotlib", "numba", "pybullet", "pymavlink", "scipy")
"""What the [sim] extra installs."""


def _start(command: str, needed: tuple[str, ...] = SIM_MODULES) -> None:
    """Run the main of `airl_mav.cli.<command>`, if all that it needs is installed."""
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        Console(stderr=True, soft_wrap=True).print(
            f"error: not installed: {', '.join(missing)}; pip install 'airl-mav[sim]'",
            style="red",
            markup=False,
        )
        sys.exit(EXIT_USAGE)
    try:
        module = importlib.import_module(f"airl_mav.cli.{command}")
    except KeyboardInterrupt:  # The imports take a second: nothing has begun.
        sys.exit(EXIT_INTERRUPTED)
    module.main()


def sitl() -> None:
    """`airl-sitl`."""
    _start("sitl")


def firmware() -> None:
    """`airl-firmware`."""
    _start("firmware")


def companion() -> None:
    """`airl-companion`: needs nothing beyond the light installation."""
    _start("companion", needed=())


def airl() -> None:
    """`airl`."""
    _start("main")

"""Flight modes, found by themselves: `class Hold(FlightMode, modes=(Mode.HOLD,))`."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from firmware_sim.autopilot.modes.interface import IMPLEMENTATIONS

for _file in iter_modules(__path__):
    import_module(f"{__name__}.{_file.name}")

MODES = dict(sorted(IMPLEMENTATIONS.items()))
"""Implementation of each mode, in the order of their numbers."""

"""Flight modes, found by themselves: `class Hold(FlightMode, modes=(Mode.HOLD,))`."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from airl_mav.core.addons import entries, load
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import IMPLEMENTATIONS, FlightMode


@cache
def implementations() -> dict[Mode, type[FlightMode]]:
    """Return the implementations of the modes: of this package, and of add-ons."""
    for file in iter_modules(__path__):
        import_module(f"{__name__}.{file.name}")
    for place in entries("firmware_sim", "FLIGHT_MODES").values():
        load(place)
    return dict(sorted(IMPLEMENTATIONS.items()))

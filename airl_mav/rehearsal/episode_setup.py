"""Episode of a scenario as the firmware loads it."""

from __future__ import annotations

from airl_mav.arena.geometry import Arena
from airl_mav.core.frames import Geodetic
from airl_mav.scenario.resolved import ResolvedScenario
from firmware_sim.hover_start import HoverStart
from firmware_sim.simulation import EpisodeSetup


def episode_setup(resolved: ResolvedScenario, arena: Arena, seed: int) -> EpisodeSetup:
    """Return the setup of an episode in the arena of a seed."""
    hover = None
    if resolved.scenario.start == "hover":
        place = None if resolved.vehicle.uses_gps else resolved.companion_pilot.origin
        origin = None if place is None else Geodetic(*place)
        hover = HoverStart(resolved.pilot.altitude_m, origin)
    return EpisodeSetup(
        resolved.vehicle,
        arena,
        seed,
        resolved.scenario,
        resolved.computer.onboard_watts,
        hover,
    )

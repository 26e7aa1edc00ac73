"""Episode of a scenario in the form that the firmware loads."""

from __future__ import annotations

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core.frames import Geodetic, quat_yaw
from airl_mav.rehearsal.channel import State
from airl_mav.scenario.resolve import ResolvedScenario
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.simulation import EpisodeSetup, HoverStart, Simulation


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


def state_of(simulation: Simulation, collision: str | None, slipped_us: int = 0) -> State:
    """Return the state after the newest tick, with collision and skipped time [µs]."""
    truth, flight = simulation.truth, simulation.autopilot.flight
    x, y, z = (float(c) for c in truth.position)
    return State(
        time_us=truth.time_us,
        position=(x, y, z),
        speed_m_s=float(np.linalg.norm(truth.velocity)),
        yaw=quat_yaw(truth.quaternion),
        battery=truth.battery_remaining,
        collision=collision,
        mode=flight.mode.name.lower(),
        armed=flight.phase >= FlightPhase.GROUND,
        landed=flight.phase < FlightPhase.AIR,
        slipped_us=slipped_us,
    )

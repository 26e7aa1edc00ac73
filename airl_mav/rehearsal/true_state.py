"""The true state as the harness sees it."""

from __future__ import annotations

import numpy as np

from airl_mav.core.frames import quat_yaw
from airl_mav.rehearsal.channel import State
from firmware_sim.autopilot.commander import Phase
from firmware_sim.simulation import Simulation


def state_of(simulation: Simulation, collision: str | None, slipped_us: int = 0) -> State:
    """Return the state after the newest tick, with what has been hit and slipped so far."""
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
        armed=flight.phase >= Phase.GROUND,
        landed=flight.phase < Phase.AIR,
        slipped_us=slipped_us,
    )

"""Contacts that end a flight."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.commander import Flight, Phase
from firmware_sim.plant.body import FLOOR
from firmware_sim.plant.plant import Collision
from firmware_sim.simulation import Simulation

TOUCHDOWN_M_S = 2.0
"""A slower touch of the floor is a landing: PX4 lands at 0.7 to 1.5 m/s [m/s]."""


def is_crash(hit: Collision, flight: Flight) -> bool:
    """Return whether a contact ends a flight.

    All contacts do, except with the floor while the vehicle stands, and except a gentle touch of
    the floor in the modes that take off and land.
    """
    if hit.what != FLOOR:
        return True
    gentle = flight.mode not in (Mode.OFFBOARD, Mode.HOLD) and hit.speed_m_s < TOUCHDOWN_M_S
    return flight.phase is Phase.AIR and not gentle


class CrashDetector:
    """Remembers the first thing that was hit in flight; to be asked once a tick."""

    def __init__(self) -> None:
        self.hit: str | None = None
        """Name of the first body hit; None = none."""
        self._seen = 0

    def look(self, simulation: Simulation) -> bool:
        """Check the contacts of this tick; return whether the first crash is among them."""
        hits = simulation.plant.collisions
        if len(hits) == self._seen:
            return False
        new = hits[self._seen :]
        self._seen = len(hits)
        crashes = [hit.what for hit in new if is_crash(hit, simulation.autopilot.flight)]
        if self.hit is not None or not crashes:
            return False
        self.hit = crashes[0]
        return True

"""Detection of contacts that end a flight."""

from __future__ import annotations

from firmware_sim.autopilot.commander import CommanderState, FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.plant.body import FLOOR
from firmware_sim.plant.plant import Collision
from firmware_sim.simulation import Simulation

TOUCHDOWN_M_S = 2.0
"""Maximum speed of a landing on the floor [m/s]; PX4 lands at 0.7 to 1.5 m/s."""


def is_crash(hit: Collision, flight: CommanderState) -> bool:
    """Return True if a contact ends a flight.

    Contacts with the floor do not end a flight while the vehicle is on the ground, or if they are
    gentle and the mode is neither Offboard nor Hold.
    """
    if hit.what != FLOOR:
        return True
    gentle = flight.mode not in (Mode.OFFBOARD, Mode.HOLD) and hit.speed_m_s < TOUCHDOWN_M_S
    return flight.phase is FlightPhase.AIR and not gentle


class CrashDetector:
    """Detector of the first body hit in flight; call `look` once per tick."""

    def __init__(self) -> None:
        self.hit: str | None = None
        """Name of the first body hit; None = no crash."""
        self._seen = 0

    def look(self, simulation: Simulation) -> bool:
        """Check the contacts of this tick; return True if the first crash is among them."""
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

"""Contacts that end a flight: landing does not."""

from __future__ import annotations

import pytest

from firmware_sim.autopilot.commander import CommanderState, FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.plant.body import FLOOR
from firmware_sim.plant.plant import Collision
from firmware_sim.simulation import is_crash


@pytest.mark.parametrize(
    ("what", "speed_m_s", "phase", "mode", "crash"),
    [
        # Coming down, by command, by return and by the offboard-loss failsafe.
        (FLOOR, 0.75, FlightPhase.AIR, Mode.LAND, False),
        (FLOOR, 1.5, FlightPhase.AIR, Mode.RETURN, False),
        (FLOOR, 0.9, FlightPhase.AIR, Mode.POSITION, False),
        # A hop at take-off.
        (FLOOR, 0.3, FlightPhase.AIR, Mode.TAKEOFF, False),
        (FLOOR, 0.3, FlightPhase.GROUND, Mode.TAKEOFF, False),
        # Standing and sliding.
        (FLOOR, 0.5, FlightPhase.STANDBY, Mode.HOLD, False),
        (FLOOR, 5.0, FlightPhase.GROUND, Mode.OFFBOARD, False),
        # Falling out of the sky.
        (FLOOR, 6.0, FlightPhase.AIR, Mode.LAND, True),
        (FLOOR, 6.0, FlightPhase.AIR, Mode.POSITION, True),
        # A policy has no business on the floor.
        (FLOOR, 0.2, FlightPhase.AIR, Mode.OFFBOARD, True),
        (FLOOR, 0.2, FlightPhase.AIR, Mode.HOLD, True),
        # Any other contact, at any speed.
        ("wall north", 0.01, FlightPhase.AIR, Mode.LAND, True),
        ("box 3", 0.01, FlightPhase.GROUND, Mode.TAKEOFF, True),
        ("box 3", 2.0, FlightPhase.STANDBY, Mode.HOLD, True),
    ],
)
def test_contact(what: str, speed_m_s: float, phase: FlightPhase, mode: Mode, crash: bool) -> None:
    assert is_crash(Collision(0, what, speed_m_s), CommanderState(phase=phase, mode=mode)) is crash

"""Flight modes, one file each. To add a mode, write its file and register it below."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.modes.acro import Acro
from firmware_sim.autopilot.modes.altitude import Altitude
from firmware_sim.autopilot.modes.descend import Descend
from firmware_sim.autopilot.modes.follow import Follow
from firmware_sim.autopilot.modes.hold import Hold
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode
from firmware_sim.autopilot.modes.land import Land
from firmware_sim.autopilot.modes.mission import Mission
from firmware_sim.autopilot.modes.offboard import Offboard
from firmware_sim.autopilot.modes.orbit import Orbit
from firmware_sim.autopilot.modes.position import Position
from firmware_sim.autopilot.modes.precision_land import PrecisionLand
from firmware_sim.autopilot.modes.return_to_launch import ReturnToLaunch
from firmware_sim.autopilot.modes.stabilized import Stabilized
from firmware_sim.autopilot.modes.takeoff import Takeoff

MODES: Mapping[Mode, Callable[[FlightContext], FlightMode]] = MappingProxyType(
    {
        Mode.HOLD: Hold,
        Mode.TAKEOFF: Takeoff,
        Mode.OFFBOARD: Offboard,
        Mode.LAND: Land,
        Mode.RETURN: ReturnToLaunch,
        Mode.POSITION: Position,
        Mode.MISSION: Mission,
        Mode.MANUAL: Stabilized,
        Mode.STABILIZED: Stabilized,
        Mode.ACRO: Acro,
        Mode.ALTITUDE: Altitude,
        Mode.ORBIT: Orbit,
        Mode.FOLLOW: Follow,
        Mode.DESCEND: Descend,
        Mode.PRECISION_LAND: PrecisionLand,
    }
)
"""Implementation of each mode."""

"""Missions: mission protocol, plans, feasibility checks, executor and Mission mode, as in PX4.

Clients upload missions, geofence areas and rally points (mission protocol) and fly missions in
Mission mode. Return flies to rally points, or along the mission, by RTL_TYPE.
Depends on: `firmware_sim.autopilot`, `firmware_sim.mavlink`; uses Precision Landing of the add-on
`extra_modes` if installed.
Guide: docs/reference/modes.md.
"""

_HERE = "firmware_sim.addons.missions"

MISSIONS = {"missions": f"{_HERE}.manager:MissionManager"}
FLIGHT_MODES = {"MISSION": f"{_HERE}.manager"}
SERVICES = {"missions": f"{_HERE}.protocol"}
EVENTS = {name: f"{_HERE}.{name}" for name in ("executor", "feasibility", "manager", "protocol")}

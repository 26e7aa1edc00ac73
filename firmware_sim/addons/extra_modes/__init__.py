"""Extra flight modes: Orbit, Follow, Acro, Precision Landing; collision prevention in Position.

Requested like the other modes: MAV_CMD_DO_SET_MODE, MAV_CMD_DO_ORBIT, MAV_CMD_NAV_LAND_LOCAL.
CP_DIST enables collision prevention; RTL_PLD_MD and missions use Precision Landing.
Depends on: `firmware_sim.autopilot`; needs no other add-on.
Guide: docs/reference/modes.md.
"""

_HERE = "firmware_sim.addons.extra_modes"

FLIGHT_MODES = {
    "ORBIT": f"{_HERE}.modes",
    "FOLLOW": f"{_HERE}.modes",
    "ACRO": f"{_HERE}.modes",
    "PRECISION_LAND": f"{_HERE}.modes",
    "POSITION": f"{_HERE}.collision_prevention",
}

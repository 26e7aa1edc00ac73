"""Extra flight modes: Orbit, Follow, Acro, Precision Landing; collision prevention in Position.

Requested like the other modes: MAV_CMD_DO_SET_MODE, MAV_CMD_DO_ORBIT, MAV_CMD_NAV_LAND_LOCAL.
CP_DIST enables collision prevention; RTL_PLD_MD and missions use Precision Landing.
Depends on: `firmware_sim.autopilot`; needs no other add-on.
Guide: docs/reference/modes.md.
"""

FLIGHT_MODES = {
    name: f"firmware_sim.addons.extra_modes.{module}"
    for module, names in {
        "orbit": ("ORBIT", "FOLLOW", "ACRO"),
        "precision_land": ("PRECISION_LAND",),
        "collision_prevention": ("POSITION",),
    }.items()
    for name in names
}

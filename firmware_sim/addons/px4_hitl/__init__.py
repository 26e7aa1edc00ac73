"""Hardware in the loop: a PX4 board flies the vehicle over a serial or USB line.

The board runs on its own clock; a router shares its line between simulator and clients.
Option: `--firmware px4-hitl`; parameters for it: `airl parameters px4-hitl`.
Depends on: `firmware_sim.external`, pyserial.
Guide: docs/how-to/hitl.md.
"""

FIRMWARE = {"px4-hitl": "firmware_sim.addons.px4_hitl.bridge:PX4_HITL"}

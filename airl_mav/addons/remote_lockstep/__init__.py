"""Lockstep with a companion in another process, or in another language.

Vehicle and companion pass turns as texts over their MAVLink connection.
Options: `airl-firmware --lockstep`, `airl-companion --lockstep`.
Depends on: `airl_mav.lockstep`; the companion's side needs no simulator.
Guide: docs/explanation/lockstep.md; protocol: docs/reference/lockstep-protocol.md.
"""

LOCKSTEP = {
    "firmware": "airl_mav.addons.remote_lockstep.vehicle_side:fly_vehicle_in_lockstep",
    "companion": "airl_mav.addons.remote_lockstep.companion_side:fly_in_lockstep",
}

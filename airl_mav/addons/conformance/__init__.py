"""Conformance test of a flight controller.

Checks a flight controller over MAVSDK against the assumptions of a rehearsal, flies step responses
and compares them with PX4's. Always lands.
Command: `airl conformance`. From Python: `conformance.command.check_conformance`.
Depends on: MAVSDK; needs no other add-on.
Guide: docs/reference/conformance.md.
"""

COMMANDS = {
    "conformance": (
        "judge",
        "test a flight controller against the rehearsal",
        "airl_mav.addons.conformance.command",
    )
}

LIGHT = True

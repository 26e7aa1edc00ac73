"""Fault injection: effects of faults on sensors, motors, battery, wind, camera and MAVLink link.

A scenario or an option requests faults (`--fault 'gps off at 8s'`), and a client injects them with
MAV_CMD_INJECT_FAILURE. The core schedules the faults (`firmware_sim.fault_timeline`) and inserts
these effects only in episodes with faults.
Depends on: `airl_mav.faults`, `firmware_sim.plant`, `firmware_sim.mavlink`.
Guide: docs/how-to/faults.md.
"""

_HERE = "firmware_sim.addons.fault_injection"

SERVICES = {"inject_failure": f"{_HERE}.inject_failure"}
FAULT_EFFECTS = {
    "parts": f"{_HERE}.failing_parts:FailingParts",
    "camera": f"{_HERE}.failing_parts:FailingCamera",
    "link": f"{_HERE}.failing_link:FailingEndpoint",
}

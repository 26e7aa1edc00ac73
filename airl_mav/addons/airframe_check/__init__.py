"""Airframe check: figures of a vehicle profile before its first flight.

Hover throttle, thrust to weight, power, endurance, top speed, stopping distance, step responses.
Command: `airl vehicle`. From Python: `airframe_check.airframe_check.check_airframe`.
Depends on: the vectorized simulator (`airl_mav.envs`), report tables.
Guide: docs/how-to/airframe-check.md.
"""

COMMANDS = {
    "vehicle": (
        "measure",
        "check hover throttle, endurance and step responses",
        "airl_mav.addons.airframe_check.airframe_check",
    )
}

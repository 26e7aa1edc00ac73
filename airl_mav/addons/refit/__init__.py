"""Refit: vehicle and computer profiles estimated from recorded flights.

`refit` estimates drag, thrust, response, wind and latencies; `refly` rehearses the flight again.
Commands: `airl refit`, `airl refly`. From Python: `refit.refit.refit`.
Depends on: black boxes and vehicle logs (`airl_mav.black_box`, `airl_mav.vehicle_log`), lockstep.
Guide: docs/how-to/refit.md.
"""

COMMANDS = {
    "refit": (
        "vehicle and computer profiles from a recorded flight",
        "airl_mav.addons.refit.refit_command",
    ),
    "refly": (
        "rehearse a flight that was recorded, and compare the two",
        "airl_mav.addons.refit.refly_command",
    ),
}

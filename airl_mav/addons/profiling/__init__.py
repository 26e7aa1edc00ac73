"""Profiling: decision latency of a policy on this computer, as a computer profile.

Measures bare decisions, decisions in flight (sitl) and decisions in the loop with a vehicle (hil),
under sustained load and with the power drawn.
Command: `airl profile`. From Python: `profiling.profile.profile`.
Depends on: policies, `airl_mav.rehearsal` for flights. Needs no other add-on.
Guide: docs/how-to/profile.md.
"""

COMMANDS = {
    "profile": (
        "measure",
        "measure this computer's latency for a policy",
        "airl_mav.addons.profiling.profile",
    )
}

LIGHT = True

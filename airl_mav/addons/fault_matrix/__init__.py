"""Fault matrix: every fault in every phase of a flight, and its outcome.

Flies each fault of the table at each phase in lockstep and tabulates how the flights ended.
Command: `airl faults`.
Depends on: `airl_mav.faults`, `firmware_sim.addons.fault_injection`, lockstep, experiments.
Guide: docs/how-to/fault-matrix.md.
"""

COMMANDS = {
    "faults": (
        "judge",
        "inject every fault in every phase of a flight",
        "airl_mav.addons.fault_matrix.command",
    )
}

"""Export of flights: MCAP for Foxglove and rerun, ULog for PX4's tools.

Writes the flights of a run as files.
Command: `airl export-log`.
Depends on: `airl_mav.black_box`, the add-ons `view` and `firmware_sim.addons.flight_log`.
Guide: docs/how-to/view-and-export.md.
"""

COMMANDS = {
    "export-log": (
        "logs",
        "write flights as MCAP or ULog",
        "airl_mav.addons.export_log.command",
    )
}

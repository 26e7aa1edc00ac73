"""Causes of failed and long flights, derived from recorded data.

Ranks the flights of a run and names the cause of each: hit out of the picture, seen too late to
stop, swung on the spot, passed the goal. Used by the sections "Worst flights" and "Flights" of a
run's page (`airl report`).
Depends on: `airl_mav.report`, `airl_mav.envs.stopping`.
Guide: docs/how-to/run-report.md.
"""

FORENSICS = {
    "examine": "airl_mav.addons.forensics.worst:examine_worst",
    "section": "airl_mav.addons.forensics.worst:worst_section",
}

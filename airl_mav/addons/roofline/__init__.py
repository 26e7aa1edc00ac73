"""Roofline: safe velocity against reaction time, and the stage that limits it.

Flies towards an obstacle at several reaction times; compares with the F-1 model.
Command: `airl roofline`. From Python: `roofline.roofline.roofline`.
Depends on: the vectorized simulator (`airl_mav.envs`), computer profiles, report pages.
Guide: docs/how-to/roofline.md.
"""

COMMANDS = {
    "roofline": (
        "measure",
        "compute safe speed by reaction time and computer",
        "airl_mav.addons.roofline.roofline",
    )
}

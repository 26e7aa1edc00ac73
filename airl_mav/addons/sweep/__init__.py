"""Architecture search: many trainings of template networks, and their results.

Trains every network of a configuration, evaluates the trained policies on several computers and
selects the best network for each.
Command: `airl sweep`; configurations in profiles/sweeps.
Depends on: training, experiments and their executors; with `--executor ray` on the add-on `ray`.
Guide: docs/how-to/sweep.md.
"""

COMMANDS = {"sweep": ("learn", "train and evaluate many networks", "airl_mav.addons.sweep.command")}

"""Imitation learning: behaviour cloning and DAgger of experts that know the true arena.

The experts are the greedy baseline, a planner, and a pilot through gates. They fly and label the
flights of the vectorized simulator.
Use: `name = "dagger"` or `"bc"` in the table `[algorithm]` of a training file.
Depends on: training and its environments (`airl_mav.envs`).
Guide: docs/how-to/train.md, "Imitation".
"""

ALGORITHMS = {
    "bc": "airl_mav.addons.imitation.table:BEHAVIOUR_CLONING",
    "dagger": "airl_mav.addons.imitation.table:DAGGER",
}

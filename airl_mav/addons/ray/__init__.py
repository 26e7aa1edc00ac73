"""Executor on a Ray cluster, or on a Ray instance of this machine.

Runs the flights and trainings of experiments as Ray tasks. Restarts lost tasks.
Option: `--executor ray` of `airl evaluate`, `hardware-gap`, `latency-sweep`, `compare-levels` and
`sweep`.
Depends on: `airl_mav.experiments.executors` and the extra `ray`.
Guide: docs/how-to/cluster.md.
"""

EXECUTORS = {"ray": "airl_mav.addons.ray.executor"}

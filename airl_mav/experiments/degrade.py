"""Latency curve: the same policies and seeds at increasing latencies."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

from airl_mav.core.errors import FieldError
from airl_mav.experiments import experiment
from airl_mav.policy.registry import find_policy
from airl_mav.scenario.model import Scenario

NATIVE = "native"
"""Name for no injected latency."""

LATENCIES = (NATIVE, "150ms", "300ms", "400ms", "950ms")

FACTS = ("arena", "level", "vehicle", "episodes", "seed")


def degrade(
    scenario: Scenario,
    latencies: Sequence[str] = LATENCIES,
    policies: Sequence[str] = (),
    *,
    compensated: bool = False,
    out: Path | str | None = None,
    progress: bool = False,
) -> experiment.ExperimentResult:
    """Fly policies at increasing latencies and compare the results. Raises as `evaluate`.

    Args:
        scenario: Flight settings; latency and workload are ignored.
        latencies: Sources of t2, increasing, the reference first; `native` = none injected.
        policies: Names or folders; empty = the scenario's policy.
        compensated: Also fly each policy with latency compensation.
        out: Folder to create or resume; None = `runs/<UTC time>-degradation-...`.
        progress: Draw progress bars on standard error.
    """
    declared = declare_degradation(scenario, latencies, policies, compensated=compensated)
    return experiment.run_and_compare(declared, out, progress=progress)


def declare_degradation(
    scenario: Scenario,
    latencies: Sequence[str] = LATENCIES,
    policies: Sequence[str] = (),
    *,
    compensated: bool = False,
) -> experiment.Experiment:
    """Declare a latency curve; see `degrade`. Raises UsageError."""
    if len(latencies) < 2 or len(set(latencies)) < len(latencies):
        raise FieldError("latencies", " ".join(latencies), "two or more, each once, growing")
    names = list(policies) or [scenario.policy]
    cells = []
    found = [find_policy(name, trust=scenario.trust).name for name in names]
    flown_as: list[dict[str, Any]] = [{}, {"compensate": True}] if compensated else [{}]
    for (path, name), way in product(zip(names, found, strict=True), flown_as):
        policy = f"{name}, compensated" if way else name
        for latency in latencies:
            given = None if latency == NATIVE else latency
            label = latency if given is None or not Path(given).is_file() else Path(given).stem
            flown = {"policy": path, "latency": given, "workload": None, **way}
            cells.append(
                experiment.make_cell(
                    experiment.file_name(f"{policy}-{label}"),
                    f"{policy} at {label}",
                    scenario.model_copy(update=flown),
                    label=label,
                    role=label,
                    group=policy,
                )
            )
    facts = {field: getattr(scenario, field) for field in FACTS}
    return experiment.Experiment(
        kind="degradation",
        name="-".join(found),
        facts={"policies": found, **facts},
        cells=tuple(cells),
    )

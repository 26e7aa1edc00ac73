"""From the folder that a command left to a published result."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import UsageError
from airl_mav.experiments.fault_matrix import load, markdown
from airl_mav.experiments.run import load_run
from airl_mav.flight.statistics import NO_ESTIMATE, Aggregate
from airl_mav.rehearsal.run_folder import RunInfo, load_info
from airl_mav.report.comparison.model import Comparison, load_comparison
from published.declared import Declared
from published.record import (
    MEASURES,
    Figure,
    FlownRun,
    Gap,
    Made,
    Printed,
    Record,
    shipped_policies,
)


def collect(declared: Declared, out: Path, behaviour: str | None) -> Record:
    """Return the result that lies in a folder.

    Args:
        declared: What it is.
        out: Where its command has flown.
        behaviour: Fingerprint of the flight behaviour of the code that flew it.

    Raises:
        UsageError: The folder does not hold it, or its flights are not all there.
    """
    if declared.kind == "faults":
        return _fault_matrix(declared, out, behaviour)
    if declared.kind == "run":
        runs, gaps, infos = _single(out)
    else:
        runs, gaps, infos = {}, {}, []
        for within in declared.within:
            comparison = load_comparison(out / within, declared.kind)
            prefix = "" if within == "." else f"{within}/"
            for name, run, info in _runs(comparison, out / within):
                runs[prefix + name] = run
                infos.append(info)
            gaps |= {f"{prefix}{name}": gap for name, gap in _gaps(comparison, prefix)}
    return Record(
        name=declared.name,
        what=declared.what,
        made=made_by(declared.command, infos, {run.policy for run in runs.values()}, behaviour),
        runs=runs,
        gaps=gaps,
    )


def _fault_matrix(declared: Declared, out: Path, behaviour: str | None) -> Record:
    """Return a fault matrix, as the table that `airl faults` shows."""
    matrix = load(out / "faults.json")
    head, _, *rows = markdown(matrix.cells).strip().split("\n")
    columns, *cells = (
        tuple(cell.strip() for cell in line.strip("|").split("|")) for line in (head, *rows)
    )
    return Record(
        name=declared.name,
        what=declared.what,
        made=made_of(declared.command, matrix.made, behaviour, {}),
        printed=Printed(columns=columns, rows=tuple(cells)),
    )


def made_of(
    command: str, made: Mapping[str, Any], behaviour: str | None, policies: dict[str, str]
) -> Made:
    """Return with what figures were made, from what `core.provenance` wrote down."""
    git, versions = made["git"], dict(made["versions"])
    return Made(
        command=command,
        date=datetime.fromisoformat(made["created_utc"]).date().isoformat(),
        version=versions.pop("airl-mav"),
        commit=None if git is None else git["commit"],
        changed=None if git is None else git["changed"],
        cpu=f"{made['machine']['cpu']}, {made['machine']['cores_usable']} cores",
        versions=versions,
        behaviour=behaviour,
        policies=policies,
    )


def made_by(command: str, infos: list[RunInfo], policies: set[str], behaviour: str | None) -> Made:
    """Return with what runs were made: of one command, by one version, on one machine.

    Raises:
        UsageError: They are of different commits: not one version flew them.
    """
    commits = {None if info.git is None else info.git["commit"] for info in infos}
    if len(commits) > 1:
        raise UsageError(f"{command}: flown by {len(commits)} commits; accepted: one")
    last = max(infos, key=lambda info: info.created_utc)
    shipped = shipped_policies()
    used = {name: shipped[name] for name in sorted(policies) if name in shipped}
    return made_of(command, vars(last), behaviour, used)


def _single(out: Path) -> tuple[dict[str, FlownRun], dict[str, Gap], list[RunInfo]]:
    run = load_run(out)
    if not run.complete:
        raise UsageError(f"{out}: {len(run.episodes)} flights of {len(run.info.seeds)}")
    t2 = run.latency["t2"]
    mean_us = t2.mean() if len(t2) else None
    return {"run": _run(run.quality, run.info, mean_us)}, {}, [run.info]


def _runs(comparison: Comparison, folder: Path) -> Iterator[tuple[str, FlownRun, RunInfo]]:
    for run in comparison.runs:
        if run.flown < run.planned:
            raise UsageError(f"{folder}: {run.name}: {run.flown} flights of {run.planned}")
        info = load_info(folder / run.entry.folder)
        yield run.name, _run(run.quality, info, run.stages["t2"].mean), info


def _run(quality: Aggregate, info: RunInfo, t2_us: float | None) -> FlownRun:
    asked = info.config
    workload = None if asked["workload"] is None else f"{asked['computer']}/{asked['workload']}"
    return FlownRun(
        policy=info.setup.policy.name,
        arena=info.setup.arena.name,
        level=info.setup.level,
        latency=asked["latency"] or workload,
        seed=asked["seed"],
        t2_ms=None if t2_us is None else round(t2_us / US_PER_MS, 3),
        **{measure: Figure.of(getattr(quality, measure)) for measure in MEASURES},
    )


def _gaps(comparison: Comparison, prefix: str) -> Iterator[tuple[str, Gap]]:
    for contrast in comparison.contrasts:
        entry = contrast.entry
        paired = contrast.paired
        yield (
            f"{entry.target} against {entry.reference}",
            Gap(
                target=prefix + entry.target,
                reference=prefix + entry.reference,
                median_flight_time=Figure.of(paired.flight_time_s.median or NO_ESTIMATE),
                t2_percent=contrast.t2_percent,
                **{m: Figure.of(getattr(paired, m).difference) for m in MEASURES},
            ),
        )

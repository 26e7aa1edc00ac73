"""Conversion of a command's output folder to a published result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from airl_mav.addons.fault_matrix.matrix import load, markdown
from airl_mav.addons.roofline.page import Roofline, RooflinePoint
from airl_mav.addons.roofline.roofline import RESULT_FILE as ROOFLINE_FILE
from airl_mav.addons.roofline.roofline import SCHEMA as ROOFLINE_SCHEMA
from airl_mav.addons.sweep.summary import SCHEMA as SWEEP_SCHEMA
from airl_mav.addons.sweep.summary import SWEEP_FILE
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_json
from airl_mav.experiments.experiment import load_run
from airl_mav.flight.statistics import Aggregate
from airl_mav.rehearsal.run_folder import RunInfo, load_info
from airl_mav.report.comparison.comparison_model import Comparison, load_comparison
from airl_mav.report.document import SCHEMA, TABLE_FILE
from airl_mav.training.config import check_seeds
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
    """Return the result in a folder.

    Args:
        declared: Declaration of the result.
        out: Output folder of its command.
        behaviour: Behaviour fingerprint of the code that flew it.

    Raises:
        UsageError: The folder does not contain it, or lacks flights.
    """
    match declared.kind:
        case "faults":
            return _of_table(declared, _fault_matrix(out), behaviour)
        case "roofline":
            return _of_table(declared, _roofline(out), behaviour)
        case "sweep":
            return _of_table(declared, _sweep(out), behaviour)
        case "table":
            return _of_table(declared, _table(out), behaviour)
        case "run":
            runs, gaps, infos = _single(out)
        case kind:
            runs, gaps, infos = {}, {}, []
            for within in declared.within:
                comparison = load_comparison(out / within, kind)
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


class _Table(NamedTuple):
    """Output of a command that is no comparison of runs."""

    printed: Printed
    made: Mapping[str, Any]
    """Provenance (`core.provenance`)."""
    policies: frozenset[str] = frozenset()
    """Names of the policies that flew."""


def _fault_matrix(out: Path) -> _Table:
    """Return a fault matrix as the table of `airl faults`."""
    matrix = load(out / "faults.json")
    head, _, *rows = markdown(matrix.cells).strip().split("\n")
    columns, *cells = (
        tuple(cell.strip() for cell in line.strip("|").split("|")) for line in (head, *rows)
    )
    return _Table(Printed(columns=columns, rows=tuple(cells)), matrix.made)


def _roofline(out: Path) -> _Table:
    """Return the computers of a roofline, one per row."""
    path = out / ROOFLINE_FILE
    data = read_json(path, ROOFLINE_SCHEMA, "roofline")
    found = Roofline.model_validate({name: data[name] for name in Roofline.model_fields})
    shown: dict[str, Callable[[RooflinePoint], str]] = {
        "computer": lambda point: f"`{point.computer}`",
        "F-1": lambda point: f"{point.f1_m_s:.2f} m/s",
        "measured": lambda point: f"{point.measured_m_s:.2f} m/s",
        "flown": lambda point: f"{point.flown_m_s:.2f} m/s",
        "roof (F-1)": lambda point: f"{point.roof_m_s:.2f} ({point.f1_roof_m_s:.2f}) m/s",
        "T": lambda point: f"{point.reaction_s:.2f} s",
        "knee": lambda point: f"{point.knee_hz:.1f} Hz",
        "binds": lambda point: point.binds,
        "missions of 100 m": lambda point: f"{point.missions_per_charge:.0f}",
    }
    rows = tuple(tuple(cell(point) for cell in shown.values()) for point in found.points)
    return _Table(Printed(columns=tuple(shown), rows=rows), data, frozenset({found.policy}))


def _sweep(out: Path) -> _Table:
    """Return the success of a sweep's networks, layers by filters in each arena."""
    path = out / SWEEP_FILE
    data = read_json(path, SWEEP_SCHEMA, "sweep")
    if not all(cell["trials"] for cell in data["cells"]):
        raise UsageError(f"{path}: {data['trials_ended']} trials of {data['trials_planned']}")
    filters = sorted({cell["filters"] for cell in data["cells"]})
    rows: dict[tuple[str, int], dict[int, str]] = {}
    seeds: dict[tuple[str, int], set[int]] = {}
    for cell in data["cells"]:
        best = data["best"][cell["arena"]]
        shown = f"{100.0 * cell['success_rate']['value']:.1f}"
        if cell["success_std"] is not None:
            shown += f" ± {100.0 * cell['success_std']:.1f}"
        if (cell["layers"], cell["filters"]) == (best["layers"], best["filters"]):
            shown = f"**{shown}**"
        key = cell["arena"], cell["layers"]
        rows.setdefault(key, {})[cell["filters"]] = shown
        seeds.setdefault(key, set()).add(len(cell["trials"]))
    columns = ("arena", "layers", "seeds", *(f"{n} filters" for n in filters))
    lines = tuple(
        (
            *map(str, key),
            " to ".join(map(str, sorted(seeds[key]))),
            *(row.get(n, "") for n in filters),
        )
        for key, row in rows.items()
    )
    return _Table(Printed(columns=columns, rows=lines), data["made"])


def _table(out: Path) -> _Table:
    """Return the table written by a script."""
    saved = read_json(out / TABLE_FILE, SCHEMA, "table")
    printed = Printed(columns=saved["columns"], rows=saved["rows"])
    return _Table(printed, saved["made"], frozenset(saved["policies"]))


def _of_table(declared: Declared, found: _Table, behaviour: str | None) -> Record:
    return Record(
        name=declared.name,
        what=declared.what,
        made=made_of(declared.command, found.made, behaviour, _shipped(found.policies)),
        printed=found.printed,
    )


def made_of(
    command: str, made: Mapping[str, Any], behaviour: str | None, policies: dict[str, str]
) -> Made:
    """Return the provenance of figures, from the output of `core.provenance`."""
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


def made_by(
    command: str, infos: list[RunInfo], policies: AbstractSet[str], behaviour: str | None
) -> Made:
    """Return the provenance of runs: of one command, by one version, on one machine.

    Raises:
        UsageError: The runs are of different commits.
    """
    commits = {None if info.git is None else info.git["commit"] for info in infos}
    if len(commits) > 1:
        raise UsageError(f"{command}: flown by {len(commits)} commits; accepted: one")
    last = max(infos, key=lambda info: info.created_utc)
    return made_of(command, vars(last), behaviour, _shipped(policies))


def _shipped(policies: AbstractSet[str]) -> dict[str, str]:
    """Return the digests of the built-in policies among the names."""
    shipped = shipped_policies()
    return {name: shipped[name] for name in sorted(policies) if name in shipped}


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
    check_seeds(asked.get("arena_seed") or 0, field="arena_seed")
    workload = None if asked["workload"] is None else f"{asked['computer']}/{asked['workload']}"
    return FlownRun(
        policy=info.setup.policy.name,
        arena=info.setup.arena.name,
        level=info.setup.level,
        latency=workload if asked["latency"] is None else _source(asked["latency"]),
        seed=asked["seed"],
        t2_ms=None if t2_us is None else round(t2_us / US_PER_MS, 3),
        **{measure: Figure.of(getattr(quality, measure)) for measure in MEASURES},
    )


def _source(latency: str) -> str:
    """Return a source of t2 for publication: a file without its folder."""
    path = Path(latency)
    return path.name if path.is_absolute() else latency


def _gaps(comparison: Comparison, prefix: str) -> Iterator[tuple[str, Gap]]:
    for contrast in comparison.contrasts:
        entry = contrast.entry
        paired = contrast.paired
        yield (
            f"{entry.target} against {entry.reference}",
            Gap(
                target=prefix + entry.target,
                reference=prefix + entry.reference,
                t2_percent=contrast.t2_percent,
                **{m: Figure.of(getattr(paired, m).difference) for m in MEASURES},
            ),
        )

"""Policy size and latency: decision time of each network of the template grid on this machine.

    python scripts/studies/policy_size.py [--runs N] [--quick] [--threads N] [--out DIR]

The paper's appendix C (Fig. 16): randomly initialised networks of L convolutions x F filters, each
timed on ONNX Runtime on this machine. The study shows whether latency grows with size, and the
accuracy of a prediction from multiply-accumulates, the basis of `--workload estimate`.

Each network has one file, cells/<layers>x<filters>.json: with the same --out, the study resumes
with missing networks, and with networks of too few runs. The result is policy-size.json, .md and
.png, updated after each network.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from rich.console import Console
from size_latency_fit import Fit, fit_times

from airl_mav.addons.sweep.document import count, t2_ms
from airl_mav.cli.options import run_command
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import EXIT_INTERRUPTED, UsageError
from airl_mav.core.fields import Each, ProfileModel, quantity
from airl_mav.core.files import replace_file
from airl_mav.core.machine import describe_machine, package_versions
from airl_mav.core.progress import RichProgress, new_console
from airl_mav.latency.stages import MIN_SAMPLES, percentile
from airl_mav.policy.actions import ActionSpec
from airl_mav.policy.card import OnnxRuntime, outputs_of
from airl_mav.policy.card_writing import NetworkSize, build_template, template_size
from airl_mav.policy.layouts import boxes
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.report.document import TOO_FEW_CELL, Column, TableView, markdown_table, print_table
from airl_mav.report.heatmap import Field as Cell
from airl_mav.report.heatmap import HeatMap, draw_heat_map
from airl_mav.report.theme import PAPER, new_figure, render_png

SCHEMA = 1
DEFAULT = Path(__file__).with_suffix(".toml")
FITTED = {"p50_ms": "p50", "processor_p50_ms": "processor time, p50,"}
WARM_UP = 10
"""Inferences before the timed ones."""
QUICK_RUNS = 70
"""Sufficient for a p90."""
DISTURBED = 0.95
"""Minimum share of a core on an undisturbed machine [1]."""


class StudyConfig(ProfileModel):
    """Networks of the study, and number of runs."""

    description: str = Field(description="one line for people")
    layers: Annotated[tuple[int, ...], Each(1, 16, ascending=True)] = quantity("layers", "1")
    filters: Annotated[tuple[int, ...], Each(1, 256, ascending=True)] = quantity("filters", "1")
    runs: int = quantity("inferences of each network", "1", ge=1, le=1_000_000, default=1000)
    seed: int = quantity("of weights and images", "1", ge=0, le=2**31, default=1)
    observation: ObservationSpec = Field(description="observations of the networks")
    actions: ActionSpec = Field(default_factory=ActionSpec, description="actions of the networks")


class StudyOptions(ProfileModel):
    """Time the template grid on this machine."""

    config: Path = Field(default=DEFAULT, description="which networks, on which image")
    runs: int | None = quantity(
        "inferences of each network, by default the configuration's; a p99 needs 662",
        "1",
        ge=1,
        le=1_000_000,
        default=None,
    )
    quick: bool = Field(default=False, description="70 inferences each")
    threads: int = quantity("threads of one inference", "1", ge=1, le=64, default=1)
    out: Path = Field(default=Path("runs/policy-size"), description="folder of the results")


OPTIONS = StudyOptions


@dataclass(frozen=True)
class Timed:
    """Timing of one network."""

    layers: int
    filters: int
    parameters: int
    macs: int
    runs: int
    threads: int
    seed: int
    p50_ms: float
    p90_ms: float | None
    p99_ms: float | None
    """Percentiles; None: too few runs, as everywhere (latency.percentiles)."""
    min_ms: float
    max_ms: float
    processor_p50_ms: float
    """Median processor time of an inference, all threads: without the machine's other work."""
    core_share: float
    """Processor time by wall time and thread: near 1 on an undisturbed machine."""

    @property
    def network(self) -> str:
        return f"{self.layers}x{self.filters}"

    @property
    def ms_per_gmac(self) -> float:
        return self.processor_p50_ms / (self.macs / 1e9)


def run(options: StudyOptions, console: Console | None = None) -> int:
    console = console or new_console()
    try:
        study(options, load_profile("sweeps", f"{options.config}", StudyConfig), console)
    except KeyboardInterrupt:
        console.print(f"interrupted: resume with --out {options.out}")
        return EXIT_INTERRUPTED
    return 0


def study(options: StudyOptions, config: StudyConfig, console: Console) -> None:
    runs = QUICK_RUNS if options.quick else options.runs or config.runs
    cells = options.out / "cells"
    cells.mkdir(parents=True, exist_ok=True)
    # Small ones first, for early results; long ones last.
    grid = sorted(
        ((layers, filters) for layers in config.layers for filters in config.filters),
        key=lambda cell: size_of(config, *cell).macs,
    )
    done = {cell: read(cells, cell, config, options.threads) for cell in grid}
    work = {cell: size_of(config, *cell).macs * runs for cell in grid}
    with RichProgress(console) as progress:
        bar = progress.bar("networks", sum(work.values()))
        for cell in grid:
            bar.update(postfix=f"{cell[0]}x{cell[1]}")
            held = done[cell]
            if held is None or held.runs < runs:
                timed = time_network(config, *cell, runs, options.threads)
                write(cells / f"{timed.network}.json", asdict(timed) | shared(config))
                done[cell] = timed
                progress.note(told(timed))
                conclude(options.out, config, [t for t in done.values() if t is not None])
            bar.advance(work[cell])
    everything = [timed for timed in done.values() if timed is not None]
    conclude(options.out, config, everything)
    print_table(table(everything), console, wrap=True)
    for line in words(everything):
        console.print(line, highlight=False)
    console.print(f"figure  {options.out / 'policy-size.png'}", highlight=False)


# --- one network


def size_of(config: StudyConfig, layers: int, filters: int) -> NetworkSize:
    seen = config.observation
    outputs = outputs_of(config.actions)
    return template_size(layers, filters, seen.height_px, seen.width_px, outputs)


def time_network(config: StudyConfig, layers: int, filters: int, runs: int, threads: int) -> Timed:
    """Time a network without warm-up, with a new image for each inference."""
    rng = np.random.default_rng([config.seed, layers, filters])
    model = build_template(layers, filters, config.observation, config.actions, rng)
    runtime = OnnxRuntime(model, config.observation, config.actions, threads)
    del model
    images = [image(config, rng) for _ in range(8)]
    for i in range(WARM_UP):
        runtime.infer(images[i % len(images)])
    taken_ns, used_ns = np.zeros(runs, np.int64), np.zeros(runs, np.int64)
    for i in range(runs):
        seen = images[i % len(images)]
        used, start = time.process_time_ns(), time.perf_counter_ns()
        runtime.infer(seen)
        taken_ns[i] = time.perf_counter_ns() - start
        used_ns[i] = time.process_time_ns() - used
    size = size_of(config, layers, filters)
    taken_ms = taken_ns / 1e6

    def at(p: float) -> float | None:
        return percentile(taken_ms, p)

    p50, processor = at(50.0), percentile(used_ns / 1e6, 50.0)
    assert p50 is not None and processor is not None
    return Timed(
        layers=layers,
        filters=filters,
        parameters=size.parameters,
        macs=size.macs,
        runs=runs,
        threads=threads,
        seed=config.seed,
        p50_ms=p50,
        p90_ms=at(90.0),
        p99_ms=at(99.0),
        min_ms=float(taken_ms.min()),
        max_ms=float(taken_ms.max()),
        processor_p50_ms=processor,
        core_share=min(float(used_ns.sum() / taken_ns.sum()) / threads, 1.0),
    )


def image(config: StudyConfig, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
    return {
        name: rng.integers(0, 256, (1, *box.shape), np.uint8)
        if box.dtype is np.uint8
        else rng.standard_normal((1, *box.shape), np.float32)
        for name, box in boxes(config.observation).items()
    }


# --- files


def shared(config: StudyConfig) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "observation": config.observation.model_dump(mode="json"),
        "actions": config.actions.model_dump(mode="json"),
        "machine": describe_machine(),
        "versions": {"onnxruntime": package_versions()["onnxruntime"]},
    }


def read(folder: Path, cell: tuple[int, int], config: StudyConfig, threads: int) -> Timed | None:
    """Return the timing of a network. Raises UsageError for another network or machine."""
    path = folder / f"{cell[0]}x{cell[1]}.json"
    if not path.exists():
        return None
    data = json.loads(path.read_bytes())
    wanted = shared(config) | {"threads": threads, "seed": config.seed}
    for name, value in wanted.items():
        if data.get(name) != value:
            raise UsageError(f"{path}: timed with another {name}; accepted: another --out")
    return Timed(**{name: data[name] for name in Timed.__dataclass_fields__})


def write(path: Path, data: dict[str, Any]) -> None:
    replace_file(path, (json.dumps(data, indent=2, allow_nan=False) + "\n").encode())


# --- results


def told(t: Timed) -> str:
    tail = "" if t.p99_ms is None else f", p99 {t2_ms(t.p99_ms)} ms"
    return (
        f"{t.network:>6}  p50 {t2_ms(t.p50_ms)} ms{tail}, {t.runs:,} runs, "
        f"processor {t2_ms(t.processor_p50_ms)} ms, {t.ms_per_gmac:.1f} ms/GMAC, "
        f"{100 * t.core_share:.0f} % of a core"
    )


def fit(timed: list[Timed], key: str) -> Fit | None:
    sizes = {(t.layers, t.filters): NetworkSize(t.parameters, t.macs) for t in timed}
    return fit_times(sizes, {(t.layers, t.filters): getattr(t, key) for t in timed})


def words(timed: list[Timed]) -> list[str]:
    lines = []
    for key, title in FITTED.items():
        line = fit(timed, key)
        if line is None:
            return []
        lines += [
            f"{title} = {line.intercept_ms:.2f} ms + {line.ms_per_gmac:.1f} ms/GMAC, R² = "
            f"{line.r_squared:.4f}, {line.n} networks (parameters alone: R² = "
            f"{line.parameters_r_squared:.4f}; both: {line.both_r_squared:.4f}). Each from the "
            f"one nearest in MACs (--workload estimate): off by "
            f"{100 * line.estimate_error_median:.1f} % in the median, "
            f"{100 * line.estimate_error_worst:.1f} % at worst. Of two neighbours on the grid "
            f"the larger is slower in {100 * line.grows:.0f} %.",
        ]
    disturbed = [t.network for t in timed if t.core_share < DISTURBED]
    if disturbed:
        lines.append(
            f"Disturbed, less than {100 * DISTURBED:.0f} % of a core: {', '.join(disturbed)}; "
            "their wall times hold the machine's other work, processor times do not."
        )
    return lines


def table(timed: list[Timed]) -> TableView:
    columns = (
        Column("network", number=False),
        Column("parameters", page_only=True),
        *(Column(title) for title in ("MACs", "runs")),
        *(Column(title, "ms") for title in ("p50", "p90", "p99", "max", "processor")),
        Column("per GMAC", "ms"),
        Column("core", "%"),
    )
    rows = tuple(
        (
            t.network,
            count(t.parameters),
            count(t.macs),
            f"{t.runs:,}",
            t2_ms(t.p50_ms),
            *(TOO_FEW_CELL if p is None else t2_ms(p) for p in (t.p90_ms, t.p99_ms)),
            t2_ms(t.max_ms),
            t2_ms(t.processor_p50_ms),
            f"{t.ms_per_gmac:.1f}",
            f"{100 * t.core_share:.0f}",
        )
        for t in timed
    )
    notes = (
        f"{WARM_UP} inferences before those that count. A p90 needs {MIN_SAMPLES[90.0]} runs, a "
        f"p99 {MIN_SAMPLES[99.0]}. Processor: p50 of the processor time; per GMAC: of that. Core: "
        "the share of one that the process got.",
    )
    return TableView("policy-size", "Latency by size", columns, rows, notes)


def conclude(out: Path, config: StudyConfig, timed: list[Timed]) -> None:
    fits = {key: fit(timed, key) for key in FITTED}
    data = {
        **shared(config),
        "date_utc": utc_now().isoformat(timespec="seconds"),
        "fit": {key: None if line is None else asdict(line) for key, line in fits.items()},
        "cells": [asdict(t) | {"ms_per_gmac": t.ms_per_gmac} for t in timed],
    }
    write(out / "policy-size.json", data)
    text = "\n\n".join([markdown_table(table(timed)), *words(timed)]) + "\n"
    replace_file(out / "policy-size.md", text.encode())
    replace_file(out / "policy-size.png", picture(config, timed))


def picture(config: StudyConfig, timed: list[Timed]) -> bytes:
    """Draw p50, processor time and p99 over the grid."""
    maps = [heat_map(config, timed, "p50_ms", "p50")]
    if any(t.core_share < DISTURBED for t in timed):
        maps.append(heat_map(config, timed, "processor_p50_ms", "p50 of the processor time"))
    if any(t.p99_ms is not None for t in timed):
        maps.append(heat_map(config, timed, "p99_ms", "p99"))
    figure = new_figure(maps[0].size_in[0] * len(maps), maps[0].size_in[1])
    parts = np.ravel(figure.subfigures(1, len(maps), squeeze=False))
    for part, heat in zip(parts, maps, strict=True):
        part.set_facecolor(PAPER)
        draw_heat_map(part, heat)
    return render_png(figure)


def heat_map(config: StudyConfig, timed: list[Timed], key: str, title: str) -> HeatMap:
    known = {(t.layers, t.filters): getattr(t, key) for t in timed if getattr(t, key) is not None}
    sizes = {(t.layers, t.filters): t.macs for t in timed}
    values = list(known.values())
    seen = config.observation
    return HeatMap(
        title=title,
        rows=config.layers,
        row_title="layers",
        columns=config.filters,
        column_title="filters",
        fields={
            cell: Cell(value, f"{t2_ms(value)} ms\n{count(sizes[cell])} MAC")
            for cell, value in known.items()
        },
        unit="ms",
        limits=(min(values), max(max(values), 1.01 * min(values))),
        logarithmic=True,
        note=f"image {seen.width_px}x{seen.height_px}, ONNX Runtime, CPU",
    )


if __name__ == "__main__":
    run_command("policy_size.py", __name__)

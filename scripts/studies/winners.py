"""Winners: the best networks of an architecture search at several decision latencies.

    python scripts/studies/winners.py [--sweep DIR] [--episodes N] [--out DIR]

The paper (V.B, VI.B) selects the best network of each arena and flies it with its latency on a
Raspberry Pi 4. This study takes the best network of each arena of a sweep, and the training of it
with the highest success. It flies that policy undelayed, with the latency of its network measured
on this computer and estimated on the Raspberry Pi 4, and with the latency of the paper's network.
The flights have other seeds than the selection. Writes table.json.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field
from rich.console import Console

from airl_mav.addons.profiling.measurement import ProfileRequest
from airl_mav.addons.profiling.profile import profile
from airl_mav.addons.sweep.summary import SCHEMA, SWEEP_FILE, estimated_ms
from airl_mav.cli.options import run_command
from airl_mav.cli.shared_options import fly_and_show
from airl_mav.core.constants import US_PER_MS
from airl_mav.core.files import read_json
from airl_mav.core.machine import provenance
from airl_mav.core.progress import new_console
from airl_mav.experiments.evaluate import NATIVE, declare_latency_sweep
from airl_mav.flight.statistics import Estimate, aggregate
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_published
from airl_mav.report.document import Column, TableView, print_table, with_interval, write_table
from airl_mav.scenario.model import Scenario

PI = "ras-pi-4"
COLUMNS = (
    Column("arena", number=False),
    Column("the paper", number=False),
    Column("here", number=False),
    Column("over seeds", "%"),
    Column("undelayed", "%"),
    Column("measured here", "%"),
    Column("estimated on the Pi", "%"),
    Column("the paper's latency", "%"),
)


class OPTIONS(BaseModel):
    __doc__ = __doc__
    sweep: Path = Field(default=Path("runs/sweep-quick"), description="folder of the sweep")
    vehicle: Path = Field(
        default=Path(__file__).with_name("quad-64x24.toml"),
        description="vehicle with the camera of the training",
    )
    episodes: int = Field(default=500, ge=1, description="flights at each latency")
    seed: int = Field(default=10_001, description="seed of the first flight")
    out: Path = Field(default=Path("runs/studies/winners"), description="folder of the results")


def percent(rate: Estimate) -> str:
    assert rate.value is not None and rate.low is not None and rate.high is not None
    return with_interval(Estimate(100 * rate.value, 100 * rate.low, 100 * rate.high, rate.n))


def run(options: OPTIONS, console: Console | None = None) -> int:
    console = console or new_console()
    sweep = read_json(options.sweep / SWEEP_FILE, SCHEMA, "sweep")
    rows, vehicle = [], f"{options.vehicle}"
    for arena, best in sweep["best"].items():
        network = f"{best['layers']}x{best['filters']}"
        told = load_published().best_networks[arena]
        (winner,) = (
            cell
            for cell in sweep["cells"]
            if (cell["arena"], cell["layers"], cell["filters"])
            == (arena, best["layers"], best["filters"])
        )
        seed = max(winner["trials"], key=lambda each: each["successes"])["trial"]["seed"]
        policy = f"{options.sweep / f'{arena}-{network}-seed{seed}' / 'policy'}"
        workload = f"template-{told.network}"
        paper = load_computer(PI).workloads[workload].latency
        measured = profile(ProfileRequest(policy=policy, vehicle=vehicle))
        here_ms = float(np.median(measured.t2_us)) / US_PER_MS
        there_ms = estimated_ms(load_computer(PI), winner["macs"])
        latencies = (NATIVE, f"{here_ms:.3g}ms", f"{there_ms:.3g}ms", f"{PI}/{workload}")
        scenario = Scenario(
            level="gym",
            arena=arena,
            policy=policy,
            vehicle=vehicle,
            episodes=options.episodes,
            seed=options.seed,
        )
        declared = declare_latency_sweep(scenario, latencies, (policy,))
        code, flown = fly_and_show(declared, options.out / arena, console)
        if code:
            return code
        late = ("", f" ({here_ms:.3g} ms)", f" ({there_ms:.3g} ms)", f" ({paper.mean_ms:.0f} ms)")
        rates = (percent(aggregate(cell.episodes).success_rate) for cell in flown.cells)
        rows.append(
            (
                arena,
                f"{told.network}, {told.success_percent:.0f} %",
                network,
                percent(Estimate(**best["success_rate"])),
                *(f"{rate}{ms}" for rate, ms in zip(rates, late, strict=True)),
            )
        )
    view = TableView("winners", "Best networks of the sweep by latency", COLUMNS, tuple(rows))
    print_table(view, console)
    write_table(view, options.out, provenance(f"python scripts/studies/{Path(__file__).name}"))
    return 0


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)

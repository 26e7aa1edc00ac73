"""Savings by 8-bit integers: file size, and processor time per decision on one thread.

    python benchmarks/bench_int8.py [POLICY | LAYERSxFILTERS ...]

Policies are exported as by `airl export --int8`. A size selects a random network of the paper's
template on its image. Its ranges come from noise: they do not affect its time. Measures processor
time, which other processes change little.
"""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.table import Table

from airl_mav.addons.int8.quantisation import export_int8, quantised
from airl_mav.policy.card import ONNX_FILE, OnnxRuntime, PolicyFacts, load_card, read_card
from airl_mav.policy.card_writing import write_template
from airl_mav.policy.layouts import Encoded, boxes
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.policy.registry import find_policy

DEFAULT = ("static-obstacles", "5x32")
LONGEST_S = 10.0
"""Maximum time for measuring one network [s]."""
CALLS, WARM_UP, NOISE_FRAMES = 5000, 20, 32


def main() -> None:
    table = Table("network", "floats", "int8", "t2 floats [ms]", "t2 int8 [ms]")
    for name in sys.argv[1:] or DEFAULT:
        with TemporaryDirectory(prefix="airl-bench-") as scratch:
            floats, integers, spec = pair_of(name, Path(scratch))
            card = read_card(floats)
            sizes, times = [], []
            for path in (floats / ONNX_FILE, integers):
                model = path.read_bytes()
                sizes.append(f"{len(model) / 1e6:.2f} MB")
                times.append(timed(OnnxRuntime(model, card.observation, card.actions), spec))
        table.add_row(name, *sizes, *(f"{each:.3f}" for each in times))
    Console().print(table)


def pair_of(name: str, scratch: Path) -> tuple[Path, Path, ObservationSpec]:
    """Return the float model's folder, the integer model's file, and the input of both."""
    size = re.fullmatch(r"(\d+)x(\d+)", name)
    if size is None:
        folder = find_policy(name).folder
        assert folder is not None, "a learned policy"
        export_int8(folder, scratch)
        return folder, scratch / ONNX_FILE, load_card(folder).observation
    spec = ObservationSpec(
        layout="paper", height_px=154, width_px=256, horizontal_fov_deg=90.0, range_m=20.0
    )
    facts = PolicyFacts(
        name="template", observation=spec, hold_s=0.5, goal_radius_m=3, altitude_m=2.5
    )
    rng = np.random.default_rng(1)
    write_template(scratch, int(size[1]), int(size[2]), facts, rng)
    model = quantised((scratch / ONNX_FILE).read_bytes(), noise(spec, NOISE_FRAMES, rng))
    (scratch / "int8.onnx").write_bytes(model)
    return scratch, scratch / "int8.onnx", spec


def noise(spec: ObservationSpec, n: int, rng: np.random.Generator) -> Encoded:
    return {
        key: rng.integers(0, 256, (n, *box.shape), np.uint8)
        if key == "depth"
        else rng.normal(0.0, 0.5, (n, *box.shape)).astype(np.float32)
        for key, box in boxes(spec).items()
    }


def timed(runtime: OnnxRuntime, spec: ObservationSpec) -> float:
    """Return the median processor time of a decision [ms]."""
    one = noise(spec, 1, np.random.default_rng(2))
    for _ in range(WARM_UP):
        runtime.infer(one)
    times: list[int] = []
    end = time.monotonic() + LONGEST_S
    while len(times) < CALLS and time.monotonic() < end:
        start = time.thread_time_ns()
        runtime.infer(one)
        times.append(time.thread_time_ns() - start)
    return float(np.median(times)) / 1e6


if __name__ == "__main__":
    main()

"""Time per decision of a shipped policy, on one thread.

    python benchmarks/bench_policy.py [POLICY]

Measures ONNX Runtime, as used by the companion; torch in eager mode with a network of the same
shape; and the whole decision from frame and telemetry to velocity command.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.policy.card import open_model
from airl_mav.policy.observation import Kinematics, encode
from airl_mav.policy.registry import find_policy, load_learned
from airl_mav.training.algorithms import make_model
from airl_mav.training.config import ALGORITHMS, AlgorithmSpec, TrainingConfig
from airl_mav.training.export import network_of
from airl_mav.training.onnx_export import random_inputs

CALLS = 5000
WARM_UP = 200


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Return median and 99th percentile of a call [µs]."""
    for _ in range(WARM_UP):
        call()
    times = np.empty(CALLS)
    for i in range(CALLS):
        start = time.perf_counter_ns()
        call()
        times[i] = time.perf_counter_ns() - start
    p50, p99 = np.percentile(times, (50, 99)) / 1e3
    return float(p50), float(p99)


def main() -> None:
    policy = find_policy(sys.argv[1] if len(sys.argv) > 1 else "static-obstacles-fast")
    card, folder = policy.card, policy.folder
    assert card is not None and folder is not None, "a learned policy"
    rng = np.random.default_rng(0)
    inputs = random_inputs(card.observation, 1, rng)
    runtime = open_model(folder, card)
    config = TrainingConfig.model_validate(card.training.config)
    env = NavigationVecEnv(NavigationVectorEnv(1, config.environment))
    # A card lists the fields of all algorithms, and make_model rejects those of the others.
    fields = {"name", "options", *ALGORITHMS[config.algorithm.name].fields}
    algorithm = AlgorithmSpec.model_validate(config.algorithm.model_dump(include=fields))
    learner = make_model(algorithm, config.network, env, 0)
    network = network_of(learner, tuple(inputs)).eval()
    tensors = tuple(torch.from_numpy(array) for array in inputs.values())
    learned = load_learned(folder, rng=rng)
    lens = Intrinsics.from_fov(64, 48, np.deg2rad(card.observation.horizontal_fov_deg))
    frame = Frame(0, 0, rng.integers(0, 20_000, (48, 64), np.uint16), lens)
    state = Kinematics(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def in_torch() -> None:
        with torch.inference_mode():
            network(*tensors)

    rows = {
        "ONNX Runtime": lambda: runtime.infer(inputs),
        "torch, eager": in_torch,
        "frame and telemetry to velocity, ONNX Runtime": lambda: learned.act(
            encode(frame, state, (20.0, 5.0))
        ),
    }
    title = f"{policy.name}: {card.parameters:,} parameters, {card.macs:,} multiply-accumulates"
    table = Table("one decision", "p50, ms", "p99, ms", title=f"{title}; one thread, n = {CALLS}")
    for name, call in rows.items():
        p50, p99 = timed(call)
        table.add_row(name, f"{p50 / 1e3:.3f}", f"{p99 / 1e3:.3f}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()

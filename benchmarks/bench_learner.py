"""Samples per second in updates of the double DQN, on one thread.

Run as `python benchmarks/bench_learner.py`. The real environment fills the replay buffer. An update
draws 128 samples, and runs two passes without gradients, a pass with gradients, and the optimiser's
step. Weights have torch's default memory format ("plain") or the preferred format of its
convolutions ("channels last", as in `make_model`).
"""

from __future__ import annotations

import time

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.training.algorithms import make_model
from airl_mav.training.config import ALGORITHMS, AlgorithmSpec, NetworkSpec
from airl_mav.training.dqn import DoubleDQN

SIZES = ((32, 24), (64, 48))
NETWORKS = {"small": NetworkSpec(), "appendix": NetworkSpec(kind="appendix")}
VEHICLES = 32
SECONDS = 1.5  # of each measurement
BATCH = ALGORITHMS["dqn"].batch


def fastest(model: DoubleDQN) -> float:
    """Return samples per second of CPU time in the fastest tenth of updates, as on an idle core."""
    took: list[float] = []
    end = time.perf_counter() + SECONDS
    while time.perf_counter() < end or len(took) < 20:
        start = time.process_time()
        model._update(model.replay.sample(BATCH, model.generator))
        took.append(time.process_time() - start)
    return float(BATCH / np.quantile(took, 0.1))


def as_plain(policy: BasePolicy) -> None:
    for module in policy.modules():
        if isinstance(module, nn.Conv2d):
            # torch declares no overload of `to` with a layout alone.
            module.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    policy.optimizer.state.clear()


def main() -> None:
    table = Table(title=f"samples a second, batch {BATCH}, one thread")
    for column in ("network", "image", "parameters", "precision", "plain", "channels last"):
        table.add_column(column, justify="left" if column in ("network", "precision") else "right")
    for width, height in SIZES:
        spec = EnvironmentSpec(image_width_px=width, image_height_px=height)
        env = NavigationVecEnv(NavigationVectorEnv(VEHICLES, spec))
        for name, network in NETWORKS.items():
            for precision in ("float32", "bfloat16"):
                fields = AlgorithmSpec(precision=precision, buffer_size=10_000)
                model = make_model(fields, network, env, seed=0)
                assert isinstance(model, DoubleDQN)
                model.learn(2500)
                last = fastest(model)
                as_plain(model.policy)
                size = f"{sum(weights.numel() for weights in model.q_net.parameters()):,}"
                rates = (f"{fastest(model):,.0f}", f"{last:,.0f}")
                table.add_row(name, f"{width}x{height}", size, precision, *rates)
    Console().print(table)


if __name__ == "__main__":
    main()

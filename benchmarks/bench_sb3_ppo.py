"""Learning curve of examples/sb3_ppo.py, over decisions and CPU time.

    python benchmarks/bench_sb3_ppo.py [--seeds 1 2 3] [--out DIR] [--plain]

Runs the unmodified example for each training seed and evaluates between rollouts, on the example's
own evaluation seeds. Evaluations do not count as CPU time. Appends to curve.jsonl, whose complete
seeds are not trained again, and draws curve.png. `--plain` then measures the CPU time of PPO with
its defaults on one `gymnasium.make` environment.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from functools import partialmethod
from pathlib import Path
from typing import Any
from unittest.mock import patch

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from airl_mav.envs.evaluation import fly_episodes, mean_of_successes, success_rate
from airl_mav.flight.statistics import wilson

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "sb3_ppo.py"
EVERY = 2  # rollouts an evaluation
SEEDS = range(1, 301)
STEPS = 150_000  # of the example
Y = ("success, %", "success, %", "flight time, s")
PLAIN_STEPS = 2048


class Curve(BaseCallback):
    """Evaluates between rollouts."""

    def __init__(self, seed: int, file: Path) -> None:
        super().__init__()
        self._seed, self._file = seed, file
        self._rollouts = 0
        self._begun_s = time.process_time()

    def _on_rollout_start(self) -> None:
        if self._rollouts % EVERY == 0:
            self._evaluate()
        self._rollouts += 1

    def _on_training_end(self) -> None:
        self._evaluate()

    def _on_step(self) -> bool:
        return True

    def _evaluate(self) -> None:
        paused_s = time.process_time()
        spec = self.training_env.env.environment  # type: ignore[attr-defined]
        flown = list(fly_episodes(spec, self._decide, SEEDS))
        row = {
            "seed": self._seed,
            "steps": self.num_timesteps,
            "cpu_s": round(paused_s - self._begun_s, 1),
            "success": success_rate(flown),
            "flight_time_s": mean_of_successes(flown, "flight_time_s"),
        }
        print(row, flush=True)
        with self._file.open("a", encoding="utf-8") as lines:
            lines.write(f"{json.dumps(row)}\n")
        self._begun_s += time.process_time() - paused_s

    def _decide(self, seen: Any) -> Any:
        return self.model.predict(seen, deterministic=True)[0]


def train(seed: int, file: Path) -> None:
    """Run the example with another training seed."""
    program = EXAMPLE.read_text(encoding="utf-8").replace("seed=1", f"seed={seed}")
    learn = partialmethod(PPO.learn, callback=Curve(seed, file))
    with patch.object(PPO, "learn", learn):
        exec(compile(program, str(EXAMPLE), "exec"), {})  # noqa: S102 (our own example)


def plain_cpu_s() -> float:
    """Return the CPU time of a thousand decisions with stable-baselines3's defaults."""
    model = PPO("MultiInputPolicy", "airl_mav:airl/Navigation-v0", n_steps=64, device="cpu")
    model.learn(64)  # compiles
    model = PPO("MultiInputPolicy", "airl_mav:airl/Navigation-v0", device="cpu")
    begun_s = time.process_time()
    model.learn(PLAIN_STEPS)
    return (time.process_time() - begun_s) * 1000 / PLAIN_STEPS


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    figure = Figure(figsize=(8.4, 2.8), layout="constrained")
    panels = figure.subplots(1, 3)
    panels[1].sharey(panels[0])
    for seed in sorted({row["seed"] for row in rows}):
        mine = [row for row in rows if row["seed"] == seed]
        rates = [100 * row["success"] for row in mine]
        spent_s = [row["cpu_s"] for row in mine]
        panels[0].plot([row["steps"] / 1e3 for row in mine], rates, label=f"training seed {seed}")
        panels[1].plot(spent_s, rates)
        panels[2].plot(spent_s, [row["flight_time_s"] or math.nan for row in mine])
    for ax, x, y in zip(panels, ("decisions, thousands", *["CPU time, s"] * 2), Y, strict=True):
        ax.set_xlabel(x)
        ax.set_ylabel(y)
        ax.set_ylim(bottom=0)
        ax.grid(alpha=0.25)
    panels[0].legend(frameon=False, fontsize=8.5, loc="lower right")
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=150)


def read(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.open(encoding="utf-8")] if file.exists() else []


def last(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the last row of each complete training."""
    return [row for row in rows if row["steps"] >= STEPS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--out", type=Path, default=Path("runs/sb3-ppo"))
    parser.add_argument("--plain", action="store_true", help="measure a plain environment too")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    os.chdir(asked.out)  # The example saves its model here.
    file = Path("curve.jsonl")
    for seed in asked.seeds:
        if seed not in {row["seed"] for row in last(read(file))}:
            train(seed, file)
    draw(read(file), Path("curve.png"))
    for row in last(read(file)):
        rate = wilson(round(row["success"] * len(SEEDS)), len(SEEDS))
        print(f"{row}, 95 % interval {rate.low:.3f} to {rate.high:.3f}")
    if asked.plain:
        print(f"one plain environment: {plain_cpu_s():.1f} CPU s a thousand decisions")


if __name__ == "__main__":
    main()

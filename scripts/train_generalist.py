"""Train the network of the policy `generalist`, and export it.

The planner (`airl_mav.policy.planner`) flies training arenas with random preferences for speeds and
directions. A network learns the risk of its candidates from their features: the discounted time to
the collision of the flight, or zero (a Monte Carlo estimate of the planner's value). The policy
takes the candidate with the least sum of the planner's cost and the risk.

Use: train_generalist.py OUT [--decisions N] [--seed N]; about ten minutes on one core.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from airl_mav.core import fields
from airl_mav.core.clock import WallClock
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.navigation_env import FIRST_TRAINING_SEED
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy import planner
from airl_mav.policy.card import PolicyFacts
from airl_mav.training.onnx_export import export_network

ARENAS = {
    "crowded": ("1ms",),
    "training/traffic": ("1ms",),
    "training/traffic-fast": ("1ms",),
    "dynamic-obstacles": ("1ms", "normal:150ms,30ms"),
    "dense-obstacles": ("1ms", "normal:250ms,50ms", "normal:500ms,100ms"),
    "training/passage": ("1ms", "normal:250ms,50ms"),
    "rooms": ("1ms",),
    "gates": ("1ms",),
}
"""Latencies by arena; each episode draws one."""

SPREAD = {"mass": 0.15, "thrust": 0.1, "drag": 0.5, "rotor_lag": 0.3}
"""Largest differences of the vehicle, as shares."""

SLOTS = 24
"""Parallel flights in an arena."""

HOLD_S = 0.1
UNITS = 64
DISCOUNT_S = 1.5
"""Time constant of a risk [s]."""

SURE_S = 0.3
"""A collision within this time has the risk 1 [s]."""

WEIGHT_S = 10.0
"""Cost of a certain collision [s]."""

UPDATES, BATCH, RATE = 4000, 512, 2e-3


class Scorer(nn.Module):
    """Choice of a candidate: the planner's cost plus the learned risk."""

    def __init__(self, units: int = UNITS) -> None:
        super().__init__()
        self.risk = nn.Sequential(
            *(nn.Linear(planner.FEATURES, units), nn.ReLU()),
            *(nn.Linear(units, units), nn.ReLU()),
            nn.Linear(units, 1),
        )

    def forward(
        self, candidates: torch.Tensor, commands: torch.Tensor, costs: torch.Tensor
    ) -> torch.Tensor:
        """Return the commands (n, 4) of the best of the candidates (n, c, features)."""
        total = costs + WEIGHT_S * torch.sigmoid(self.risk(candidates))[..., 0]
        best = total.argmin(dim=1)[:, None, None].expand(-1, 1, commands.shape[2])
        return commands.gather(1, best)[:, 0]


class Explorer:
    """The planner with a random preference for a speed, and for directions that change."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._planner = planner.PlannerPolicy(planner.LEARNED)
        self._rng = rng
        self._speed = 0.6 * rng.normal()
        self._left = 0

    def decide(self, observation: Any) -> tuple[NDArray[np.float64], NDArray[np.float16]]:
        """Return the command (4,) and the features of the candidate."""
        found = self._planner.candidates(observation, features=True)
        if self._left == 0:
            self._left = int(self._rng.integers(3, 15))
            self._strength = 0.6 * self._rng.normal() * (self._rng.random() < 0.5)
            self._course = 2.0 * math.pi * self._rng.random()
        self._left -= 1
        north, east = found.velocities.T
        liked = self._speed * np.hypot(north, east) / 5.0
        off = np.arctan2(east, north) - self._course
        liked += self._strength * np.cos(off) * (np.hypot(north, east) > 0.0)
        best = int((np.minimum(found.costs, 1e4) - liked).argmin())
        return found.commands[best], found.features[best].astype(np.float16)


def main() -> int:
    """Fly, train and export; return 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--decisions", type=int, default=120_000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(asked.seed)
    seen: list[NDArray[np.float16]] = []
    risks: list[NDArray[np.float32]] = []
    share = asked.decisions // len(ARENAS)
    last_seed = 0
    for k, (arena, latencies) in enumerate(ARENAS.items()):
        first = FIRST_TRAINING_SEED + 100_000 * (k + len(ARENAS) * asked.seed)
        features, told, last = fly(arena, latencies, share, first, asked.seed)
        last_seed = max(last_seed, last)
        seen.append(features)
        risks.append(told)
    scorer = Scorer()
    train(scorer, np.concatenate(seen), np.concatenate(risks), asked.seed)
    description = "a network scores the planner's candidates with a learned risk of collision"
    facts: dict[str, Any] = {
        "name": "generalist",
        "description": description,
        "observation": {
            "layout": "candidates",
            "width_px": 32,
            "height_px": 24,
            "horizontal_fov_deg": 90.0,
            "range_m": 20.0,
            "in_flight": ("command", "latency"),
        },
        "actions": {"set": "velocity3d-yaw-rate", "max_speed_m_s": planner.LEARNED.speeds_m_s[-1]},
        "hold_s": HOLD_S,
        "goal_radius_m": 3.0,
        "altitude_m": 2.5,
        "algorithm": "monte-carlo",
        "training": {
            "arena": "crowded",
            "first_arena_seed": FIRST_TRAINING_SEED,
            "last_arena_seed": last_seed,
            "seed": asked.seed,
            "env_steps": share * len(ARENAS),
            "command": f"python scripts/train_generalist.py {asked.out} --seed {asked.seed}",
        },
    }
    card = export_network(scorer, fields.validated(PolicyFacts, facts), asked.out)
    print(f"policy  {asked.out}  {card.parameters:,} parameters")
    return 0


def fly(
    arena: str, latencies: tuple[str, ...], decisions: int, first_seed: int, seed: int
) -> tuple[NDArray[np.float16], NDArray[np.float32], int]:
    """Fly an arena; return features (n, FEATURES), risks (n,) and the last seed."""
    told = {"arena": arena, "in_flight": ("command", "latency"), "episode": {"hold_s": HOLD_S}}
    drawn = {"delay": {"latency": latencies}, "randomisation": SPREAD}
    spec = fields.validated(EnvironmentSpec, told | drawn)
    navigation, rng = Navigation(spec, SLOTS), np.random.default_rng([seed, first_seed])
    pilots: list[Explorer] = [Explorer(rng)] * SLOTS
    rows: list[list[NDArray[np.float16]]] = [[] for _ in range(SLOTS)]
    seen: list[NDArray[np.float16]] = []
    risks: list[NDArray[np.float32]] = []
    following, known, goals, flights = first_seed, 0, 0, 0
    clock = WallClock()
    began_us = clock.time_us()

    def begin(slots: list[int]) -> None:
        nonlocal following
        navigation.begin(slots, range(following, following + len(slots)), None)
        following += len(slots)
        for i in slots:
            pilots[i], rows[i] = Explorer(rng), []

    begin(list(range(SLOTS)))
    while known < decisions:
        looked = navigation.see()
        chosen = np.zeros((SLOTS, 4))
        times = navigation.flights().time_s.copy()
        for i in range(SLOTS):
            chosen[i], features = pilots[i].decide(looked.rows(i))
            rows[i].append(np.append(features, np.float16(times[i])))
        navigation.fly(chosen)
        now = navigation.flights()
        ended = np.flatnonzero(now.verdict != FlightStatus.FLYING).tolist()
        for i in ended:
            flown = np.array(rows[i])
            hit = now.verdict[i] == FlightStatus.COLLISION
            before_s = np.maximum(now.time_s[i] - flown[:, -1].astype(np.float32) - SURE_S, 0.0)
            seen.append(flown[:, :-1])
            risks.append(hit * np.exp(-before_s / DISCOUNT_S).astype(np.float32))
            known += len(flown)
            flights += 1
            goals += now.verdict[i] == FlightStatus.SUCCESS
        if ended:
            begin(ended)
    passed_s = (clock.time_us() - began_us) / 1e6
    print(f"{arena:22} {known:7,} decisions  {goals:4} of {flights:4} goals  {passed_s:5.0f} s")
    sys.stdout.flush()
    return np.concatenate(seen), np.concatenate(risks), following - 1


def train(scorer: Scorer, seen: NDArray[np.float16], risks: NDArray[np.float32], seed: int) -> None:
    """Fit the risk to its estimates."""
    inputs, wanted = torch.from_numpy(seen.astype(np.float32)), torch.from_numpy(risks)
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(scorer.parameters(), RATE, weight_decay=1e-5)
    for update in range(UPDATES):
        for group in optimizer.param_groups:
            group["lr"] = RATE * (1.0 - update / UPDATES)
        rows = torch.randint(len(inputs), (BATCH,), generator=generator)
        guess = scorer.risk(inputs[rows])[:, 0]
        loss = functional.binary_cross_entropy_with_logits(guess, wanted[rows])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        if (update + 1) % 1000 == 0:
            print(f"update {update + 1}  cross entropy {loss.item():.4f}")


if __name__ == "__main__":
    raise SystemExit(main())

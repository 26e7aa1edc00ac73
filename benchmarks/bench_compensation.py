"""Time of latency compensation per decision, on one core.

    python benchmarks/bench_compensation.py [VEHICLE]

Images of a real arena along a flight through it, predicted 396 ms ahead; the camera is the
vehicle's (64 x 48 pixels on the shipped vehicle).
"""

from __future__ import annotations

import sys
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.observation import Kinematics
from airl_mav.prediction import REMEMBERED, Compensator
from airl_mav.profiles.vehicle import load_vehicle

CALLS, WARM_UP = 2000, 100
PLACES = 12
"""Decisions that are flown; their images and states are carried forward again and again."""

LATE_US = 396_000
HOLD_US = 500_000


def flight(vehicle: str) -> list[tuple[np.ndarray, Kinematics]]:
    """Return images (1, h, w) and states of a flight."""
    knobs = {"vehicle": vehicle, "arena": "static-obstacles", "delay": {"native_ms": 396.0}}
    navigation = Navigation(EnvironmentSpec.model_validate(knobs), 1)
    navigation.begin([0], [1])
    seen = []
    for _ in range(PLACES):
        navigation.fly(np.array([[2.0, 0.0, 0.5]]))
        seen.append((navigation.cameras.image.copy(), navigation.kinematics()))
    return seen


def timed(vehicle: str, remembered: int, seen: list[tuple[np.ndarray, Kinematics]]) -> np.ndarray:
    """Return how long each call took [ms], of both that a decision makes."""
    profile = load_vehicle(vehicle)
    intrinsics = Navigation(EnvironmentSpec(vehicle=vehicle), 1).intrinsics
    compensator = Compensator(1, profile, intrinsics, remembered=remembered)
    one, age_us = np.zeros(1, np.intp), np.array([20_000])
    command = np.array([[2.0, 0.0, 0.0, 0.5]])
    times = np.empty(CALLS + WARM_UP)
    for k in range(len(times)):
        image, state = seen[k % PLACES]
        now_us = np.array([k * (LATE_US + HOLD_US)])
        start = time.perf_counter_ns()
        compensator.foresee(one, image, age_us, now_us, state)
        compensator.decided(one, command, np.array([LATE_US]), now_us + LATE_US)
        times[k] = time.perf_counter_ns() - start
    return times[WARM_UP:] / 1e6


def main() -> None:
    vehicle = sys.argv[1] if len(sys.argv) > 1 else "quad"
    seen = flight(vehicle)
    height, width = seen[0][0].shape[1:]
    title = f"compensation in a decision, {width}x{height}, one core, n = {CALLS}"
    table = Table("images remembered", "p50, ms", "p99, ms", title=title)
    for remembered in (1, 2, REMEMBERED, 8):
        p50, p99 = np.percentile(timed(vehicle, remembered, seen), (50, 99))
        table.add_row(f"{remembered}", f"{p50:.3f}", f"{p99:.3f}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()

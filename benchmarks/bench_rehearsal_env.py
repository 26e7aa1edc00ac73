"""Decisions and take-offs a second of `airl/Rehearsal-v0`, wall time, one flight at a time.

    python benchmarks/bench_rehearsal_env.py [--px4-dir PX4-Autopilot]

Six flights in static-obstacles fly straight on, a decision every half second, by the built-in
flight controller with each plant, and by a PX4 where one is given.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium

FLIGHTS = 6
DECISIONS = 20
AHEAD = 22
"""The action that flies straight on."""


def measure(name: str, **beside: Any) -> str:
    """Return a line of the table."""
    env = gymnasium.make("airl_mav:airl/Rehearsal-v0", arena="static-obstacles", **beside)
    env.reset(seed=1)  # Compile and load before the measurement.
    takeoffs_s = steps_s = flown_s = 0.0
    decisions = 0
    for seed in range(1, FLIGHTS + 1):
        began = time.perf_counter()
        env.reset(seed=seed)
        took_off = time.perf_counter()
        for _ in range(DECISIONS):
            *_, terminated, truncated, info = env.step(AHEAD)
            decisions += 1
            if terminated or truncated:
                break
        takeoffs_s += took_off - began
        steps_s += time.perf_counter() - took_off
        flown_s += info["flight_time_s"]
    env.close()
    return (
        f"| {name} | {decisions / steps_s:.0f} | {flown_s / steps_s:.0f} x | "
        f"{takeoffs_s / FLIGHTS:.2f} s |"
    )


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--px4-dir", metavar="PATH", help="PX4 SITL build, or its source tree")
    px4_dir = parser.parse_args().px4_dir
    print("| flown by | decisions a second | real time | reset |")
    print("|---|---:|---:|---:|")
    for plant in ("pybullet", "kernel"):
        print(measure(f"the built-in flight controller, plant {plant}", plant=plant))
    if px4_dir is not None:
        print(measure("PX4, plant pybullet", firmware="px4", real={"px4_dir": px4_dir}))


if __name__ == "__main__":
    main()

"""Compile time of the first start after an install: with an empty cache, then with a full one.

Run as `python benchmarks/bench_compiling.py`. Wall and processor time of the kernels that each
level compiles before its first flight, in a new process each.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

PROGRAMS = {
    "sitl, lockstep": """
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.warm_up import warm_up
work = lambda: warm_up(resolve(Scenario()).vehicle)
""",
    "gym": """
from airl_mav import Scenario, rehearse
asked = Scenario(policy="greedy", arena="no-obstacles", level="gym", episodes=1)
work = lambda: rehearse(asked, out=sys.argv[1])
""",
}
TIMED = """
import time
wall, cpu = time.perf_counter(), time.process_time()
work()
print(f"{time.perf_counter() - wall:6.1f} s, processor {time.process_time() - cpu:6.1f} s")
"""


def main() -> None:
    for level, program in PROGRAMS.items():
        with tempfile.TemporaryDirectory() as scratch:
            kept = {**os.environ, "NUMBA_CACHE_DIR": f"{scratch}/kernels"}
            for state in ("empty cache", "full cache"):
                words = [sys.executable, "-c", f"import sys\n{program}{TIMED}"]
                out = Path(scratch) / state
                done = subprocess.run(  # noqa: S603 (our own words)
                    [*words, str(out)], env=kept, capture_output=True, text=True, check=True
                )
                print(f"{level:<15} {state:<12} {done.stdout.strip()}")


if __name__ == "__main__":
    main()

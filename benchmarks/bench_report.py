"""Time to draw the page of a run, and its size.

Run as `python benchmarks/bench_report.py RUN [TIMES]`; RUN is a run folder, which is not changed.
Each time in a new process, excluding the first imports. Includes everything that `airl report`
draws for the page, the PNG files and the verdict.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

TIMED = """
import sys, time
from pathlib import Path
from airl_mav.report.run_report import write_report
begun = time.perf_counter()
page = write_report(Path(sys.argv[1]), Path(sys.argv[2]))
print(time.perf_counter() - begun, page.stat().st_size)
"""


def main(run: str, times: int = 7) -> None:
    took, size = [], 0
    for _ in range(times):
        with tempfile.TemporaryDirectory() as out:
            words = [sys.executable, "-c", TIMED, str(Path(run).resolve()), out]
            done = subprocess.run(words, capture_output=True, text=True, check=True)  # noqa: S603 (our own words)
        seconds, size_now = done.stdout.split()
        took.append(float(seconds))
        size = int(size_now)
    print(
        f"drawn in {statistics.median(took):.2f} s"
        f" ({min(took):.2f} to {max(took):.2f}, {times} times), page {size / 1e6:.1f} MB"
    )


if __name__ == "__main__":
    main(sys.argv[1], *(int(word) for word in sys.argv[2:3]))

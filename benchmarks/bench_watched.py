"""Cost of a viewer for flights: pairs of the same run, alone and watched.

Run as `python benchmarks/bench_watched.py [lockstep sitl]`; without arguments, all of
them. Requires a Chromium, which draws in software unless it has a GPU, and then takes processor
time from everything else on the machine. Each figure shows the machine's load.

lockstep  The same flight at full speed, alone, with a view without viewers, and with a page:
          fingerprints, and wall time.
sitl      Flights in real time on twenty seeds, each alone and with a page, in turn: t2, lateness
          of the vehicle's ticks, and skipped simulated time, paired by seed. The viewer is remote:
          a process receives all data of a page, and draws nothing. With `--browser` it is a
          browser of this machine, at the lowest priority.
"""

from __future__ import annotations

import argparse
import gc
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from bench_view import load, say, viewed, wait_for  # noqa: E402 (from here on it is found)

from airl_mav.flight.statistics import Estimate, median_ratio  # noqa: E402
from airl_mav.rehearsal.live_view import ViewAddresses  # noqa: E402
from airl_mav.scenario.model import Scenario  # noqa: E402
from airl_mav.scenario.resolve import resolve  # noqa: E402
from tests.support.browser import Page, browser  # noqa: E402
from tests.support.processes import SITL_WITHOUT_REPORT  # noqa: E402

LOWEST = 19
"""Niceness of processes that use only idle processor time."""

ELSEWHERE = """
import sys
import msgspec, viser
from websockets.sync.client import connect
url = sys.argv[1].replace("http", "ws")
camera = dict(
    type="ViewerCameraMessage", wxyz=[1.0, 0.0, 0.0, 0.0], position=[-8.0, 0.0, -4.0], fov=1.0,
    near=0.1, far=1000.0, image_height=600, image_width=900, look_at=[0.0, 0.0, 0.0],
    up_direction=[0.0, 0.0, -1.0],
)
with connect(url, subprotocols=["viser-v" + viser.__version__], max_size=None) as page:
    page.send(msgspec.msgpack.encode(camera))
    print(flush=True)
    taken = 0
    try:
        while True:
            taken += len(page.recv())
    except Exception:
        print(taken)
"""
"""A watcher that draws nothing; it prints a line when it watches, and how many bytes it got."""


def wait_until_shown(page: Page, seconds: float = 60.0) -> None:
    wait_for(lambda: "phase" in page.text(), seconds)


def measure_lockstep(folder: Path, pairs: int = 4) -> None:
    from airl_mav.lockstep.lockstep_flight import fly

    resolved = resolve(
        Scenario(policy="static-obstacles", level="lockstep", time_limit_s=60.0, speed=None)
    )

    def lockstep(ends: ViewAddresses | None) -> tuple[float, str]:
        gc.collect()
        began = time.monotonic()
        record = fly(resolved, resolved.fresh_policy(11), 0, 11, view=ends).record
        return time.monotonic() - began, str(record.sha256)

    lockstep(None)
    with viewed(paced=True) as viewer, ExitStack() as held:
        unseen = [(lockstep(None), lockstep(viewer.ends)) for _ in range(pairs)]
        page = held.enter_context(browser(folder))
        page.resize(900, 600)
        page.open(viewer.url)
        wait_until_shown(page)
        seen = [(lockstep(None), lockstep(viewer.ends)) for _ in range(pairs)]
    digests = {sha for pair in (*unseen, *seen) for _, sha in pair}
    for name, rows in (("with --view, nobody there", unseen), ("with a page", seen)):
        ratio = statistics.median(watched[0] / alone[0] for alone, watched in rows)
        say(f"lockstep at full speed, {name}: {ratio:.2f} times the wall time of alone"
            f" ({rows[0][0][0]:.2f} s); {load()}")  # fmt: skip
    say(f"fingerprints of all {4 * pairs} flights: {'the same' if len(digests) == 1 else digests}")


Watch: TypeAlias = Callable[[Path, str], AbstractContextManager[None]]
"""Context manager that keeps the page of an address open, with a scratch folder."""


@contextmanager
def by_browser(folder: Path, url: str) -> Iterator[None]:
    with browser(folder, niceness=LOWEST) as page:
        page.resize(900, 600)
        page.open(url)
        yield


@contextmanager
def elsewhere(folder: Path, url: str) -> Iterator[None]:
    words = ["nice", "-n", str(LOWEST), sys.executable, "-c", ELSEWHERE, url]
    log = folder / "watcher.log"
    with log.open("w") as told:
        process = subprocess.Popen(words, stdout=told, stderr=told)  # noqa: S603 (this file)
    end = time.monotonic() + 60.0
    while not log.read_text():
        assert time.monotonic() < end, "nobody watches"
        time.sleep(0.02)
    try:
        yield
    finally:
        process.wait(10.0)
        taken = int(log.read_text().split()[-1])
        assert taken > 100_000, f"a watcher that got {taken} bytes"


@dataclass(frozen=True)
class Disturbed:
    """Timing of a flight in real time [ms]."""

    t2: float
    """Median."""
    lateness: float
    """99 % of the vehicle's ticks began less late."""
    slipped: float
    """Skipped simulated time."""


def measure_sitl(folder: Path, pairs: int = 20, watch: Watch = elsewhere) -> None:
    rows: dict[bool, list[Disturbed]] = {False: [], True: []}
    for seed in range(11, 11 + pairs):
        for watched in (False, True):
            out = folder / f"{seed}-{watched}"
            rows[watched].append(disturbed(out, seed, watch if watched else None))
        alone, seen = rows[False][-1], rows[True][-1]
        say(f"seed {seed}: alone {alone}, watched {seen}")
    for watched, found in rows.items():
        t2 = statistics.median(each.t2 for each in found)
        lateness = statistics.median(each.lateness for each in found)
        slipped = sum(each.slipped for each in found)
        say(
            f"sitl, {'watched' if watched else 'alone'}, median of {pairs} flights: t2 {t2:.2f} ms,"
            f" 99 % of ticks less than {lateness:.2f} ms late; {slipped:.1f} ms given up in all"
        )
    for name, figure in (("t2, median", "t2"), ("lateness of ticks, p99", "lateness")):
        alone_ms, seen_ms = ([getattr(each, figure) for each in rows[k]] for k in (False, True))
        more = median_ratio(alone_ms, seen_ms)
        say(f"sitl, watched against alone, {name}: {told(more)}; {load()}")


def told(more: Estimate) -> str:
    return f"{more.value:+.1f} [{more.low:+.1f}, {more.high:+.1f}] %, n = {more.n}"


def disturbed(out: Path, seed: int, watch: Watch | None) -> Disturbed:
    """Fly a seed at level sitl, watched or not, and return how well the host has kept up."""
    from airl_mav.rehearsal.run_folder import TICK_LATENESS
    from airl_mav.rehearsal.run_folder import load as load_run

    words = [sys.executable, *SITL_WITHOUT_REPORT, "--episodes", "1", "--seed", str(seed)]
    words += ["--out", str(out), "--policy", "static-obstacles"]
    with ExitStack() as held:
        process = subprocess.Popen(  # noqa: S603 (this checkout)
            words + ([] if watch is None else ["--view"]),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert process.stdout is not None
        if watch is not None:
            line = next(each for each in process.stdout if "view" in each)
            profile = out.with_suffix(".watcher")
            profile.mkdir()
            held.enter_context(watch(profile, line.split()[-1]))
        rest = process.stdout.read()
        assert process.wait() == 0, rest
    run = load_run(out)
    (record,) = run.episodes
    stamps = run.latency[record.index]
    t2_us = stamps["action_ready_us"] - stamps["infer_start_us"]
    return Disturbed(
        float(np.median(t2_us)) / 1e3,
        float(np.percentile(stamps[TICK_LATENESS], 99.0)) / 1e3,
        record.slipped_us / 1e3,
    )


MEASURES: dict[str, Callable[[Path], None]] = {
    "lockstep": measure_lockstep,
    "sitl": measure_sitl,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="*", choices=[*MEASURES, []], help="by default all")
    parser.add_argument(
        "--browser", action="store_true", help="level sitl: a browser of this machine watches"
    )
    asked = parser.parse_args()
    say(load())
    if asked.browser:
        MEASURES["sitl"] = partial(measure_sitl, watch=by_browser)
    for name in asked.what or MEASURES:
        say(f"--- {name}")
        with tempfile.TemporaryDirectory() as folder:
            MEASURES[name](Path(folder))


if __name__ == "__main__":
    main()

"""Repeat an episode in lockstep under different loads, and compare.

    python scripts/lockstep_reruns.py --idle 50 --loaded 30 --stopped 20

Idle: nothing else runs. Loaded: twice as many busy processes as cores. Stopped: the process gets
SIGSTOP at a random time of the flight and resumes ten seconds later. Prints every distinct hash
with its count; exit status 0 if all flights are equal.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import tyro
from rich.table import Table

from airl_mav.core.progress import new_console

BEGINS = "begins"


@dataclass(frozen=True)
class Reruns:
    """Compare reruns of one episode in lockstep."""

    idle: int = 50
    """Flights on an idle machine."""

    loaded: int = 30
    """Flights beside busy processes."""

    stopped: int = 20
    """Flights with a temporary stop."""

    stop_s: float = 10.0
    """Duration of a stop [s]."""

    policy: str = "static-obstacles"
    """Policy that decides."""

    arena: str = "static-obstacles"
    """Arena profile."""

    seed: int = 1
    """Seed of the episode."""

    fly: int | None = None
    """Fly this many flights and print their hashes; used internally by this script."""


def main() -> int:
    command = tyro.cli(Reruns)
    if command.fly is not None:
        fly(command, command.fly)
        return 0
    console = new_console()
    counts: dict[str, Counter[str]] = {}
    conditions = (("idle", command.idle), ("loaded", command.loaded), ("stopped", command.stopped))
    for name, flights in conditions:
        with busy(2 * (os.cpu_count() or 1) if name == "loaded" else 0):
            stop_s = command.stop_s if name == "stopped" else None
            counts[name] = Counter(fingerprints(command, flights, stop_s))
        console.print(f"{name}: {sum(counts[name].values())} flights", highlight=False)
    table = Table("condition", "flights", "sha256 of the flight")
    for name, counter in counts.items():
        for fingerprint, count in counter.most_common():
            table.add_row(name, str(count), fingerprint)
    console.print(table)
    distinct = {fingerprint for counter in counts.values() for fingerprint in counter}
    flown = sum(sum(counter.values()) for counter in counts.values())
    same = sum(counts.values(), Counter()).most_common(1)[0][1] if flown else 0
    console.print(f"{same} of {flown} the same", highlight=False)
    return 0 if len(distinct) == 1 and flown == sum(n for _, n in conditions) else 1


def fingerprints(command: Reruns, flights: int, stop_s: float | None) -> Iterator[str]:
    """Yield the hash of each flight of a child process."""
    if not flights:
        return
    moments = np.random.default_rng(command.seed)
    same = [f"--{name}={getattr(command, name)}" for name in ("policy", "arena", "seed")]
    arguments = [sys.executable, __file__, f"--fly={flights}", *same]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        try:
            for line in child.stdout:
                if line.strip() != BEGINS:
                    yield line.strip()
                elif stop_s is not None:
                    time.sleep(moments.uniform(0.0, 0.4))
                    child.send_signal(signal.SIGSTOP)
                    time.sleep(stop_s)
                    child.send_signal(signal.SIGCONT)
        finally:
            child.kill()


BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
"""Busy loop that ends with its parent process."""


@contextmanager
def busy(processes: int) -> Iterator[None]:
    loops = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(processes)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def fly(command: Reruns, flights: int) -> None:
    """Fly, and print the start and the hash of each flight."""
    from airl_mav.lockstep.lockstep_flight import fly as fly_episode
    from airl_mav.rehearsal.observer import Observer
    from airl_mav.scenario.model import Scenario
    from airl_mav.scenario.resolve import resolve

    scenario = Scenario(
        level="lockstep", policy=command.policy, arena=command.arena, seed=command.seed
    )
    resolved = resolve(scenario)

    class Speaking(Observer):
        def episode(self, *_: object) -> None:
            say(BEGINS)

    # Compile and load everything before the first counted flight.
    fly_episode(resolved, resolved.fresh_policy(command.seed + 1), 0, command.seed + 1)
    for _ in range(flights):
        policy = resolved.fresh_policy(command.seed)
        record = fly_episode(resolved, policy, 0, command.seed, observer=Speaking()).record
        assert record.sha256 is not None
        say(record.sha256["flight"])


def say(word: str) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())

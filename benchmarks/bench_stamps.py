"""Cost of the stamps, and the harness's effect on the measured latency t2.

    python benchmarks/bench_stamps.py

1. One stamp (`WallClock.time_us`) and one row of the decision log.
2. In a real flight (airl-firmware in a separate process, MAVSDK and camera here, as on the drone)
   every decision is also timed from inside, from the encoding to the bounded action. The difference
   from t2 is the cost of the pilot's stamps. Compared in pairs, decision by decision.
3. The same decisions without a flight, with the same pauses, before and after each flight: the
   effect of MAVSDK and the camera in the same process, and of the simulator beside it.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.table import Table

from airl_mav.addons.profiling import hil
from airl_mav.addons.profiling.measurement import ProfileRequest
from airl_mav.addons.profiling.policy_under_test import BareLoop, PolicyUnderTest, open_policy
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import CommandKind
from airl_mav.core.frames import Goal
from airl_mav.core.progress import Bar
from airl_mav.latency.stamps import DecisionLog
from airl_mav.policy import actions
from airl_mav.policy.actions import AnyAction, flyable
from airl_mav.policy.observation import Kinematics, Observation
from companion import pilot
from companion.frame_source import ReceivedFrame

CALLS, REPEATS = 10_000, 50
FLIGHTS, DECISIONS, WARM_UP = 2, 60, 20
STAMP_LIMIT_US, CHANGE_LIMIT = 0.5, 0.01

READY = "Ctrl-C ends it."
"""The last that airl-firmware says before it flies."""

START_S = 300.0
"""Longest wait for it: the first start after an install compiles."""

NETWORKS = {
    "milliseconds": ProfileRequest(
        level="hil", network="3x32", image="64x48", decisions=DECISIONS, warm_up=WARM_UP
    ),
    "shipped policy": ProfileRequest(level="hil", decisions=DECISIONS, warm_up=WARM_UP),
}


def best_us(call: Callable[[], object]) -> tuple[float, float]:
    """Return the least and the median time of a call over repeats, loop included [µs]."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter_ns()
        for _ in range(CALLS):
            call()
        times.append((time.perf_counter_ns() - start) / CALLS / 1e3)
    return min(times), float(np.median(times))


@contextmanager
def watched() -> Iterator[list[int]]:
    """Time decisions from inside the pilot, from the encoding to the bounded action [ns]."""
    took_ns: list[int] = []
    started_ns = 0
    encode = pilot.Pilot._observe

    def encode_timed(
        of: pilot.Pilot,
        seen: ReceivedFrame,
        state: Kinematics,
        goal: Goal,
        now_us: int,
    ) -> Observation:
        nonlocal started_ns
        started_ns = time.perf_counter_ns()
        return encode(of, seen, state, goal, now_us)

    def flyable_timed(action: AnyAction, commands: CommandKind, speed_m_s: float) -> AnyAction:
        bounded = flyable(action, commands, speed_m_s)
        took_ns.append(time.perf_counter_ns() - started_ns)
        return bounded

    # Raises AttributeError if the pilot's names change.
    with (
        patch.object(pilot.Pilot, "_observe", encode_timed),
        patch.object(actions, "flyable", flyable_timed),
    ):
        yield took_ns


@dataclass(frozen=True)
class Flight:
    added_us: np.ndarray
    """t2 as stamped less the decision itself, of each decision [µs]."""
    inside_us: np.ndarray
    """The decision itself: encode, infer, bound [µs]."""


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def firmware(vehicle: str, folder: Path) -> Iterator[tuple[str, str]]:
    """Run a separate simulator; yield its two addresses."""
    udp = [free_port(socket.SOCK_DGRAM) for _ in range(2)]
    tcp = free_port(socket.SOCK_STREAM)
    words = [sys.executable, "-m", "airl_mav.cli.firmware_command", "--vehicle", vehicle]
    words += ["--arena", "no-obstacles", "--api-port", f"{udp[0]}", "--gcs-port", f"{udp[1]}"]
    words += ["--api-local-port", "0", "--gcs-local-port", "0", "--camera-port", f"{tcp}"]
    said = folder / "firmware.log"
    with said.open("wb") as log:
        process = subprocess.Popen(words, stdout=log, stderr=log)  # noqa: S603
        try:
            limit_s = time.monotonic() + START_S
            while READY not in said.read_text():
                if process.poll() is not None or time.monotonic() > limit_s:
                    raise SystemExit(f"airl-firmware did not start: {said.read_text()}")
                time.sleep(0.1)
            yield f"udpin://127.0.0.1:{udp[0]}", f"tcp://127.0.0.1:{tcp}"
        finally:
            process.terminate()
            process.wait(20)


def flown(request: ProfileRequest, policy: PolicyUnderTest) -> Flight:
    """Fly, and pair each t2 with the work inside it."""
    with watched() as took_ns:
        (stamps,) = hil.measure(request, policy, Bar()).flights
    t2_us = stamps["action_ready_us"] - stamps["infer_start_us"]
    inside_us = np.array(took_ns[WARM_UP : WARM_UP + len(t2_us)]) / 1e3
    return Flight(t2_us - inside_us, inside_us)


def alone(request: ProfileRequest, policy: PolicyUnderTest) -> float:
    """Return the median of the same decisions without a flight, with the same pauses [µs]."""
    loop, times = BareLoop(request, policy), []
    for _ in range(WARM_UP + DECISIONS):
        time.sleep(request.hold_s)
        start_us, end_us = loop.decide()
        times.append(end_us - start_us)
    return float(np.median(times[WARM_UP:]))


def main() -> None:
    console = Console(width=110)
    clock, log = WallClock(), DecisionLog(REPEATS * CALLS)
    setpoint = (1.0, 0.0, 0.0, 0.1)

    def record() -> None:
        log.record(1, 2, 3, 4, 5, 6, setpoint)

    table = Table("cost", "best, µs", "median, µs", "limit, µs", title="stamps")
    costs = {"one stamp": best_us(clock.time_us), "one row of the log": best_us(record)}
    for name, (best, median) in costs.items():
        limit = f"{STAMP_LIMIT_US:g}" if name == "one stamp" else ""
        table.add_row(name, f"{best:.3f}", f"{median:.3f}", limit)
    console.print(table)
    change = Table(
        *("network", "flight", "decision, µs", "added, µs", "added, %"),
        *("alone before / after, µs", "flown / alone"),
        title=f"t2 in flight, {DECISIONS} decisions a flight (medians)",
    )
    shares = []
    for name, request in NETWORKS.items():
        with TemporaryDirectory() as scratch, open_policy(request) as policy:
            before: float | None = None
            for k in range(FLIGHTS):
                with firmware(policy.vehicle, Path(scratch)) as (connect, camera):
                    addresses = {"connect": connect, "camera": camera}
                    before = alone(request, policy) if before is None else before
                    flight = flown(request.model_copy(update=addresses), policy)
                    after = alone(request, policy)
                added = float(np.median(flight.added_us))
                inside = float(np.median(flight.inside_us))
                share = float(np.median(flight.added_us / flight.inside_us))
                low, high = np.percentile(flight.added_us / flight.inside_us, (25, 75))
                if name == "milliseconds":
                    shares.append(share)
                change.add_row(
                    name if k == 0 else "",
                    f"{k + 1}",
                    f"{inside:,.0f}",
                    f"{added:.1f}",
                    f"{share:.2%} ({low:.2%} to {high:.2%})",
                    f"{before:,.0f} / {after:,.0f}",
                    f"{2.0 * inside / (before + after):.3f}",
                )
                before = after
    console.print(change)
    stamp_us = costs["one stamp"][0]
    worst = max(shares)
    console.print(
        f"one stamp {stamp_us:.2f} µs (limit {STAMP_LIMIT_US:g}): "
        f"{'yes' if stamp_us <= STAMP_LIMIT_US else 'NO'}; added to a t2 of milliseconds "
        f"{worst:.2%} (limit {CHANGE_LIMIT:.0%}): {'yes' if worst < CHANGE_LIMIT else 'NO'}"
    )
    sys.exit(not (stamp_us <= STAMP_LIMIT_US and worst < CHANGE_LIMIT))


if __name__ == "__main__":
    main()

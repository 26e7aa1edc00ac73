"""Check whether this host keeps real time, before flights at level sitl.

Two processes run paced ticks with the typical work of a tick, as firmware and companion do. A
flight allows 1 % of its ticks to be 40 ms late (`airl_mav.flight.judge.RULES`). The check is much
shorter than a flight, so it allows no tick to be half as late.
"""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

from airl_mav.core.constants import TICK_US, US_PER_MS
from firmware_sim.pacing import MAX_LAG_US, WallPacing

if TYPE_CHECKING:
    from airl_mav.scenario.model import Scenario

PROCESSES = 2

TICKS = 500
"""Maximum number of ticks: two seconds."""

PUNCTUAL_TICKS = 125
"""Number of ticks after which the check ends, unless one was later than a tick."""

LOOPS = 20_000
"""Iterations of an empty loop that take as long as the firmware's tick, 0.5 ms."""

LATE_MS = 20.0
"""Maximum lateness of a tick [ms]."""


def host_warning(asked: Scenario) -> str:
    """Return a warning if flights of a scenario may be invalid on this host; empty if not."""
    checked = asked.level == "sitl" and asked.validity
    why = host_problem(asked.speed or 1.0) if checked else ""
    return why and f"warning: flights may be invalid, as this host does not keep real time: {why}"


def host_problem(speed: float) -> str:
    """Return why flights at a speed [simulated s per wall s] may be invalid; empty if not."""
    words = [sys.executable, "-m", __name__, f"{speed}"]
    started = [
        subprocess.Popen(words, stdout=subprocess.PIPE)  # noqa: S603 - fixed words, no shell
        for _ in range(PROCESSES)
    ]
    late_ms = max(float(each.communicate()[0]) for each in started)
    if late_ms <= LATE_MS:
        return ""
    return f"a tick in a short test began {late_ms:.0f} ms late (limit {LATE_MS:g} ms)"


def greatest_lateness_ms(speed: float, ticks: int = TICKS) -> float:
    """Return the maximum lateness of paced ticks [ms]; skipped time counts as `MAX_LAG_US`."""
    pacing, late_us = WallPacing(speed), 0
    for number in range(1, ticks + 1):
        due_us = number * TICK_US
        late_us = max(late_us, pacing.wait(due_us, (), lambda _now_us: None) - due_us)
        if number == PUNCTUAL_TICKS and late_us < TICK_US:
            break
        for _ in range(LOOPS):
            pass
    return max(late_us, MAX_LAG_US if pacing.slipped_us else 0) / US_PER_MS


if __name__ == "__main__":
    sys.stdout.write(f"{greatest_lateness_ms(float(sys.argv[1]))}")

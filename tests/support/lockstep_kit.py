"""A scenario for tests in lockstep; as a script, flights in a process that a test may stop."""

from __future__ import annotations

import sys
from typing import Any

from airl_mav.lockstep.flight import fly
from airl_mav.rehearsal.progress import Observer
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.resolved import ResolvedScenario

SEED = 11
"""A short flight: two seconds to the goal."""

BEGINS = "begins"
"""Said by the script when a flight begins; its fingerprint follows at the end."""


class Speaking(Observer):
    """Says when a flight begins."""

    def episode(self, index: int, seed: int, goal: tuple[float, float]) -> None:
        say(BEGINS)


def demo_scenario(**changes: Any) -> ResolvedScenario:
    """Return a short flight in lockstep; `changes` are fields of the scenario."""
    return resolve(Scenario(**({"level": "lockstep", "time_limit_s": 60.0} | changes)))


def main(flights: int) -> None:
    resolved = demo_scenario()
    fly(resolved, resolved.fresh_policy(3), 0, 3)  # what is compiled or loaded late is, now
    for _ in range(flights):
        policy = resolved.fresh_policy(SEED)
        record = fly(resolved, policy, 0, SEED, observer=Speaking()).record
        assert record.sha256 is not None
        say(record.sha256["flight"])


def say(word: str) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))

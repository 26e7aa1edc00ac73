"""Checks of the true state after every tick: digest, collisions, verdict, orders."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.judge import Referee, TruthSample, Verdict
from airl_mav.lockstep.digest import FlightDigest
from airl_mav.rehearsal.episode import EpisodeSupervisor, Order
from firmware_sim.engine.record import Record
from firmware_sim.simulation import CrashDetector, Simulation


class Judge:
    """Observer of one flight's true state. Call on the conductor's thread, or while it waits."""

    def __init__(
        self,
        supervisor: EpisodeSupervisor | None,
        digest: FlightDigest,
        *,
        order: Callable[[Order], None],
        judged: Callable[[Verdict], None] = lambda _: None,
    ) -> None:
        """Initialize before the flight.

        Args:
            supervisor: Decides when the flight is over; None = no verdict.
            digest: Digest to update with the true trajectory.
            order: Callback for orders to the companion.
            judged: Callback for the verdict.
        """
        self.battery: float | None = None
        """Remaining battery at the verdict; None = no verdict yet."""
        self._supervisor = supervisor
        self._digest = digest
        self._order = order
        self._judged = judged
        self._crash = CrashDetector()

    @property
    def due_us(self) -> float:
        """Time of the next time-based order to the companion [µs]; inf = never."""
        return math.inf if self._supervisor is None else self._supervisor.due_us

    @property
    def hit(self) -> str | None:
        """First object that was hit; None = no collision."""
        return self._crash.hit

    def enter(self, phase: str, time_us: int) -> None:
        """Register that the companion enters a phase, at a simulated time [µs]."""
        if self._supervisor is None or phase != "navigating":
            return
        referee = self._supervisor.referee
        if referee.navigation_us is None:
            referee.start_navigation(time_us)

    def look(self, simulation: Simulation) -> None:
        """Process the true states of the newest ticks."""
        self._crash.look(simulation)
        truths, supervisor = simulation.truths, self._supervisor
        self._digest.extend("trajectory", truths.tobytes())
        if supervisor is not None:
            # Earlier ticks are relevant only if the flight may end at any of them.
            first = 0 if self._may_decide(supervisor.referee, truths) else -1
            for time_us, motion, _, charge in truths[first:].tolist():
                self._see(supervisor, TruthSample(time_us, motion[:3], self._crash.hit, charge))

    def _see(self, supervisor: EpisodeSupervisor, sample: TruthSample) -> None:
        before = supervisor.verdict
        order = supervisor.see(sample)
        if before is None and supervisor.verdict is not None:
            self.battery = sample.battery_remaining
            self._judged(supervisor.verdict)
        if order is not None:
            self._order(order)

    def _may_decide(self, referee: Referee, truths: Record) -> bool:
        """Return True if the flight may end before the last of some ticks (n,)."""
        # A single tick is always judged on its own.
        if referee.verdict is not None or len(truths) < 2:
            return False
        last, task, began_us = truths[-1], referee.task, referee.navigation_us
        # Cheap necessary conditions; the referee decides tick by tick if one holds.
        if self._crash.hit is not None or last["charge"] <= 0.0:
            return True
        if began_us is None:
            return False
        if last["time_us"] - began_us >= task.time_limit_s * US_PER_S:
            return True
        # Horizontal distance: a lower bound if the goal has a height.
        away = truths["motion"][:, :2] - task.goal[:2]
        return bool((np.hypot(away[:, 0], away[:, 1]) < task.goal_radius_m).any())

"""Who looks at the true state after every tick: fingerprint, collisions, verdict, orders."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.flight.judge import TruthSample, Verdict
from airl_mav.lockstep.digest import FlightDigest
from airl_mav.rehearsal.supervisor import Order, Supervisor
from firmware_sim.crash_detector import CrashDetector
from firmware_sim.simulation import Simulation


class Judge:
    """Follows one flight in truth. All calls on the conductor's thread, or while it waits."""

    def __init__(
        self,
        supervisor: Supervisor | None,
        digest: FlightDigest,
        *,
        order: Callable[[Order], None],
        judged: Callable[[Verdict], None] = lambda _: None,
    ) -> None:
        """Nothing has been flown yet.

        Args:
            supervisor: Knows when the flight is decided; None: nobody judges.
            digest: Takes the fingerprint.
            order: Called with what the companion must be told.
            judged: Called with the verdict.
        """
        self.battery: float | None = None
        """What was left of the battery at the verdict."""
        self._supervisor = supervisor
        self._digest = digest
        self._order = order
        self._judged = judged
        self._crash = CrashDetector()

    @property
    def hit(self) -> str | None:
        """What has been hit so far."""
        return self._crash.hit

    def enter(self, phase: str, time_us: int) -> None:
        """The companion has entered a phase, at a simulated time [µs]."""
        if self._supervisor is None or phase != "navigating":
            return
        referee = self._supervisor.referee
        if referee.navigation_us is None:
            referee.start_navigation(time_us)

    def look(self, simulation: Simulation) -> None:
        """Take the true state after a tick."""
        plant = simulation.plant
        self._crash.look(simulation)
        self._digest.add("trajectory", simulation.time_us, plant.motion.tobytes())
        supervisor = self._supervisor
        if supervisor is None:
            return
        sample = TruthSample(
            simulation.time_us, plant.position, self._crash.hit, plant.battery_remaining
        )
        before = supervisor.verdict
        order = supervisor.see(sample)
        if before is None and supervisor.verdict is not None:
            self.battery = sample.battery_remaining
            self._judged(supervisor.verdict)
        if order is not None:
            self._order(order)

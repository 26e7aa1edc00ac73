"""Viewer connection of a lockstep flight: display, pace, and manual latency."""

from __future__ import annotations

from contextlib import ExitStack, closing

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.scenario.resolve import ResolvedScenario
from airl_mav.view.ends import ViewEnds
from airl_mav.view.taps import CompanionTap, SimulationTap
from airl_mav.view.viewer import REAL_TIME, Pace
from companion.pilot import SentDecision
from firmware_sim.simulation import Simulation


class Watched:
    """Connection of one flight to a viewer, until it is closed.

    Call the companion's methods on its thread, all others on the waiting conductor's thread.
    """

    def __init__(self, ends: ViewEnds, scenario: ResolvedScenario) -> None:
        """Connect to a viewer; the pace is real time until a spectator changes it."""
        self._open = ExitStack()
        self._simulation = self._open.enter_context(closing(SimulationTap(ends, scenario)))
        self.companion = self._open.enter_context(closing(CompanionTap(ends, scenario)))
        """Companion's part of the connection."""
        self._pace = self._open.enter_context(closing(Pace(ends, scenario.speed or REAL_TIME)))

    def close(self) -> None:
        """Disconnect."""
        self._open.close()

    def begin(self, seed: int, arena: Arena, started_us: int) -> None:
        """Show the start of an episode, at a simulated time [µs]."""
        self._simulation.begin(seed, arena, started_us)

    def frame(self, frame: Frame) -> None:
        """Show a camera frame."""
        self._simulation.frame(frame)

    def tick(self, simulation: Simulation, collision: str | None) -> None:
        """Show the newest ticks, and wait as the pace requires."""
        self._simulation.tick(simulation, collision, self._pace.tick)
        self._pace.tick(simulation.time_us)

    def decided(self, decision: SentDecision) -> None:
        """Show an executed decision."""
        self.companion.decided(decision)
        self._pace.decided()

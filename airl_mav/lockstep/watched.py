"""A flight in lockstep that is watched: shown, held back, and its latency set by hand."""

from __future__ import annotations

from contextlib import ExitStack, closing

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.scenario.resolved import ResolvedScenario
from airl_mav.view.ends import ViewEnds
from airl_mav.view.pace import REAL_TIME, Pace
from airl_mav.view.taps import CompanionTap, SimulationTap
from companion.pilot import Decided
from firmware_sim.simulation import Simulation


class Watched:
    """What a view has of one flight, until it is closed.

    The companion's calls come on its thread, all others on the conductor's, which waits meanwhile.
    """

    def __init__(self, ends: ViewEnds, scenario: ResolvedScenario) -> None:
        """Connect to a view; it flies in real time until the watchers want it otherwise."""
        self._open = ExitStack()
        self._simulation = self._open.enter_context(closing(SimulationTap(ends, scenario)))
        self.companion = self._open.enter_context(closing(CompanionTap(ends, scenario)))
        """The companion's side."""
        self._pace = self._open.enter_context(closing(Pace(ends, scenario.speed or REAL_TIME)))

    def close(self) -> None:
        """Disconnect."""
        self._open.close()

    def begin(self, seed: int, arena: Arena, started_us: int) -> None:
        """Show that an episode begins, at a simulated time [µs]."""
        self._simulation.begin(seed, arena, started_us)

    def frame(self, frame: Frame) -> None:
        """Show a frame of the camera."""
        self._simulation.frame(frame)

    def tick(self, simulation: Simulation, collision: str | None) -> None:
        """Show the newest ticks, and wait as the watchers ask for."""
        self._simulation.tick(simulation, collision, self._pace.tick)
        self._pace.tick(simulation.time_us)

    def decided(self, decision: Decided) -> None:
        """Show a decision that was sent."""
        self.companion.decided(decision)
        self._pace.decided()

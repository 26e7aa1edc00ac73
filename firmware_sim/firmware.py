"""The firmware process: simulation, MAVLink and camera, tick after tick."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from airl_mav.camera.frame import Frame
from airl_mav.constants import TICK_US, US_PER_S
from firmware_sim.autopilot.state import Message
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.tlog import TlogWriter
from firmware_sim.pacing import Pacing
from firmware_sim.simulation import EpisodeSetup, Simulation

IDLE_S = 0.02
"""How often requests are looked for while no episode stands [s]."""


class FrameServer(Protocol):
    """Where the camera's frames go; `plant.camera_server.CameraServer` is one."""

    endpoint: str
    """Where subscribers connect."""

    def publish(self, frame: Frame) -> None:
        """Offer a frame, without waiting for anybody."""
        ...

    def close(self) -> None:
        """Release the resources."""
        ...


@dataclass(frozen=True)
class Loaded:
    """An episode that has just been set up."""

    time_us: int
    epoch_ns: int | None
    """Host monotonic time of simulated time 0 [ns]; None when time is not paced."""


class Firmware:
    """Flies one episode after the other; its links and its camera stay."""

    def __init__(self, server: MavlinkServer, camera: FrameServer | None, pacing: Pacing) -> None:
        self.server = server
        self.clock = pacing.clock
        self.simulation: Simulation | None = None
        self.on_tick: Callable[[Simulation], None] | None = None
        """Called after every tick, if set."""
        self.on_message: Callable[[Message], None] | None = None
        """Called with every text of the autopilot for its operator, if set."""
        self._camera = camera
        self._pacing = pacing
        self._sockets = server.filenos()
        self._tlog: TlogWriter | None = None

    @property
    def camera_endpoint(self) -> str:
        """Where frames are published; "" without a camera."""
        return self._camera.endpoint if self._camera is not None else ""

    @property
    def epoch_ns(self) -> int | None:
        """Host monotonic time of simulated time 0 [ns]; None when time is not paced."""
        return self._pacing.epoch_ns

    @property
    def slipped_us(self) -> int:
        """Simulated time given up since the start because the host could not keep up [µs]."""
        return self._pacing.slipped_us

    def load(self, setup: EpisodeSetup, tlog: Path | None, start_unix_us: int) -> Loaded:
        """Replace the episode: a new arena, the vehicle at rest, the autopilot booting.

        Args:
            setup: The episode.
            tlog: Where its MAVLink log goes; None = no log.
            start_unix_us: Calendar time of this moment [µs since 1970].
        """
        self.discard()
        start_us = (self.clock.time_us() // TICK_US + 1) * TICK_US
        simulation = Simulation(setup, start_us=start_us, clock=self.clock)
        self.simulation = simulation
        simulation.autopilot.on_message = self.on_message
        simulation.tick()
        self.server.attach(simulation.autopilot)
        if tlog is not None:
            self._tlog = TlogWriter(tlog, start_unix_us - simulation.time_us)
            self.server.log_to(self._tlog)
        if self.epoch_ns is not None:
            # What lives for the whole episode need not be searched by the garbage collector: a
            # full collection would stall the 250 Hz loop by tens of milliseconds.
            gc.collect()
            gc.freeze()
        # All this took wall time, which is no part of the episode: it starts now.
        self._pacing.restart(simulation.time_us)
        return Loaded(start_us, self.epoch_ns)

    def step(self) -> None:
        """Wait for the next tick's wall time, then run it."""
        simulation, server = self.simulation, self.server
        if simulation is None:
            self.clock.sleep_until(self.clock.time_us() + int(IDLE_S * US_PER_S))
            return
        server.receive(self._pacing.wait(simulation.time_us, self._sockets, server.receive))
        # Before the tick, while its time is now: after it the state lies one tick ahead.
        if self._camera is not None:
            simulation.capture_due(self._camera.publish)
        simulation.tick()
        server.send(simulation.time_us)
        if self.on_tick is not None:
            self.on_tick(simulation)

    def save(self, path: Path) -> None:
        """Write the episode's arrays and close its MAVLink log; the flight goes on unrecorded."""
        if self.simulation is None:
            return
        pacing = self._pacing
        self.simulation.save(
            path,
            {"tick/lateness_us": pacing.take_lateness(), "tick/slips_us": pacing.take_slips()},
        )
        self._close_tlog()

    def _close_tlog(self) -> None:
        if self._tlog is not None:
            self.server.log_to(None)
            self._tlog.close()
            self._tlog = None

    def discard(self) -> None:
        """Forget the episode."""
        self._close_tlog()
        if self.simulation is not None:
            if self.epoch_ns is not None:
                gc.unfreeze()
            self.simulation.close()
            self.simulation = None

    def close(self) -> None:
        """Release everything."""
        self.discard()
        self.server.close()
        if self._camera is not None:
            self._camera.close()

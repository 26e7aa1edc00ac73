"""The plant behind the bridge to ArduPilot, with the stand-in at the other end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import US_PER_S
from firmware_sim.addons.ardupilot.bridge import ArdupilotBridge
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.autopilot.commander import CommanderState
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.ardupilot_peer import ArdupilotPeer
from tests.support.flight_rig import quad
from tests.support.ports import free_ports


class BridgeOnly:
    """A flight controller that is nothing but its bridge. Implements `FlightController`."""

    on_message: Callable[[OperatorText], None] | None = None
    internals = None
    body_by = None

    def __init__(self, bridge: ArdupilotBridge) -> None:
        self.rate_hz = bridge.rate_hz
        self.step, self.use_truth, self.close = bridge.step, bridge.use_truth, bridge.close
        self.flight = CommanderState()


class Stage:
    """A flying stand-in."""

    def __init__(self, peer: ArdupilotPeer, bridge: ArdupilotBridge) -> None:
        self.peer, self.bridge = peer, bridge
        self.dies: Exception | None = None
        """Error raised after the end of the process's thread."""
        bridge.wait_connected(20.0, self._alive)
        setup = EpisodeSetup(quad(), None, 1)
        self.simulation = Simulation(
            setup, start_us=4000, clock=SimClock(), autopilot=BridgeOnly(bridge)
        )

    def _alive(self) -> None:
        if self.dies is not None and not self.peer.alive:
            raise self.dies

    def run(self, seconds: float) -> None:
        until_us = self.simulation.time_us + seconds * US_PER_S
        while self.simulation.time_us < until_us:
            self.simulation.tick()

    def until(self, reached: Callable[[], Any], limit_s: float) -> None:
        limit_us = self.simulation.time_us + limit_s * US_PER_S
        while not reached():
            assert self.simulation.time_us < limit_us, "not in time"
            self.simulation.tick()

    @contextmanager
    def flying(self, speed: float) -> Iterator[None]:
        """Run simulated time in a separate thread, at most at a multiple of real time."""
        stop, errors = threading.Event(), []

        def fly() -> None:
            began, start_us = time.monotonic(), self.simulation.time_us
            try:
                while not stop.is_set():
                    self.run(0.02)
                    flown_s = (self.simulation.time_us - start_us) / US_PER_S / speed
                    time.sleep(max(0.0, flown_s - (time.monotonic() - began)))
            except Exception as error:  # shown to the test at the end
                errors.append(error)

        thread = threading.Thread(target=fly, name="plant", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join(20.0)
        assert not errors, errors


@contextmanager
def bridged(
    api_ports: list[int] | None = None, *, silence_s: float = 20.0, **settings: Any
) -> Iterator[Stage]:
    """Power a stand-in up behind a bridge and the plant."""
    (port,), _ = free_ports(1, 0)
    bridge = ArdupilotBridge(port, silence_s=silence_s)
    try:
        with ArdupilotPeer(port, api_ports, **settings) as peer:
            stage = Stage(peer, bridge)
            yield stage
            stage.simulation.close()
    finally:
        bridge.close()

"""MAVSDK at the built-in autopilot and a simulated vehicle, all in this process.

Simulated time runs at a multiple of real time that the test chooses: slowly while MAVSDK is waiting
for an answer, fast while the vehicle flies.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mavsdk import ComponentType, Configuration, Mavsdk

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_S, US_PER_S
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.mavlink.px4_links import ONBOARD_HZ, LinkConfig
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.mavlink_clients import BOOT_UNIX_US, Companion, RawLane

SLOW = 2.0
"""Default speed, while no test waits for simulated time."""

MOST_HZ = 10.0
"""Maximum rate of any stream: at the tests' speed, higher rates cost more than the flight."""

AHEAD_S = 1.0
"""Maximum lead [s] of simulated time over the last time read by a waiting test. Without this limit,
a test on a busy machine could find the vehicle minutes later, landed by a failsafe."""

_TURN_S = 0.01
"""Pause between two bursts of ticks [wall s]."""


class Flown:
    """Vehicle in simulated time, run by a separate thread."""

    def __init__(self, companion: Companion, simulation: Simulation) -> None:
        self.companion = companion
        self.simulation = simulation
        self.speed = SLOW
        self._until_s = math.inf

    @property
    def waits(self) -> bool:
        """True if simulated time has to wait for the test."""
        return self.simulation.time_us > self._until_s * US_PER_S

    @contextmanager
    def at(self, speed: float) -> Iterator[Callable[[float], None]]:
        """Run simulated time at a speed inside the context.

        Call the yielded function with the last time read [s]: the lead is limited to `AHEAD_S`.
        """
        before, self.speed = self.speed, speed
        try:
            yield self._see
        finally:
            self.speed, self._until_s = before, math.inf

    def _see(self, now_s: float) -> None:
        self._until_s = now_s + AHEAD_S


class _Thread:
    """Ticks the vehicle and its MAVLink."""

    def __init__(self, lane: RawLane, release: PX4ReleaseName) -> None:
        vehicle = load_vehicle("quad", release)
        setup = EpisodeSetup(vehicle, None, 1, Aircraft())
        self.simulation = Simulation(setup, start_us=0, clock=SimClock(), recording=False)
        rates = {name: min(hz, MOST_HZ) for name, hz in ONBOARD_HZ.items()}
        self.server = MavlinkServer([LinkConfig("onboard", lane, rates)], boot_unix_us=BOOT_UNIX_US)
        self.simulation.tick()
        autopilot = self.simulation.autopilot.internals
        assert autopilot is not None
        self.server.attach(autopilot)
        self.flown: Flown | None = None
        self.error: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicle", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.server.close()
        self.simulation.close()
        if self.error is not None:
            raise self.error

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                speed = SLOW if self.flown is None else self.flown.speed
                for _ in range(max(1, round(speed * _TURN_S / TICK_S))):
                    if self.flown is not None and self.flown.waits:
                        break
                    self.server.receive(self.simulation.time_us)
                    self.simulation.tick()
                    self.server.send(self.simulation.time_us)
                time.sleep(_TURN_S)
        except BaseException as error:  # shown to the test by stop()
            self.error = error


@contextmanager
def flown(
    component: ComponentType = ComponentType.GROUND_STATION, release: PX4ReleaseName = CURRENT
) -> Iterator[Flown]:
    """Yield MAVSDK and the vehicle that it is connected to."""
    lane = RawLane()
    thread = _Thread(lane, release)
    mavsdk = Mavsdk(Configuration.create_with_component_type(component))
    assert mavsdk.add_any_connection("raw://") == 0
    mavsdk.subscribe_raw_bytes_to_be_sent(lane.inbox.append)
    lane.mavsdk = mavsdk
    companion: Companion | None = None
    thread.start()
    try:
        companion = Companion(mavsdk)
        thread.flown = Flown(companion, thread.simulation)
        yield thread.flown
    finally:
        # Stop the feed before MAVSDK is destroyed.
        thread.stop()
        if companion is None:
            mavsdk.destroy()
        else:
            companion.destroy()

"""Hardware in the loop over a pseudo-terminal: a board's peer flies the real plant."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.telemetry import Telemetry

from airl_mav.core.clock import SimClock, WallClock
from firmware_sim.addons.px4_hitl import bridge
from firmware_sim.addons.px4_hitl.bridge import BoardLink, HitlBridge
from firmware_sim.addons.px4_hitl.line import Router
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.external.flight_stack import ExternalFlightController, ExternalFlightStack
from firmware_sim.external.launcher import Launcher
from firmware_sim.external.observer import FirmwareObserver
from firmware_sim.external.parameters import HITL_OUTPUT, px4_airframe
from firmware_sim.interfaces import FirmwareMissingError
from firmware_sim.mavlink.px4_links import bind_udp_links
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.flight_rig import quad
from tests.support.hitl_peer import HitlPeer
from tests.support.mavlink_clients import Companion
from tests.support.ports import LOOPBACK, free_ports

PATIENCE_S = 60.0
SETUP = EpisodeSetup(quad(), None, 1)


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[HitlPeer]:
    peer = HitlPeer(tmp_path)
    yield peer
    peer.close()


class Flight:
    """The real plant, the bridge and the router, with companion and ground station over UDP."""

    def __init__(self, peer: HitlPeer) -> None:
        (self.api, api_local, gcs, gcs_local), _ = free_ports(4, 0)
        ends = bind_udp_links(
            bind=LOOPBACK,
            api_remote=(LOOPBACK, self.api),
            api_local_port=api_local,
            gcs_remote=(LOOPBACK, gcs),
            gcs_local_port=gcs_local,
            insecure=False,
        )
        self.router = Router(ends.by_name(), WallClock())
        bridge = partial(HitlBridge, BoardLink(self.router, peer.device, 921_600))
        self.launcher = Launcher(px4_airframe(quad(), HITL_OUTPUT), bridge, PATIENCE_S)
        self.observer = FirmwareObserver(self.router, "observer")
        self.texts: list[str] = []
        self.simulation = self.boot()

    def boot(self) -> Simulation:
        self.observer.restart()
        firmware = ExternalFlightController(self.launcher, self.observer)
        firmware.on_message = lambda m: self.texts.append(m.text)
        self.firmware = firmware
        return Simulation(SETUP, start_us=7_000_000, clock=SimClock(), autopilot=firmware)

    def tick(self) -> None:
        self.simulation.tick()
        self.observer.receive(self.simulation.time_us)
        self.observer.send(self.simulation.time_us)

    def until(self, condition: Callable[[], Any], what: str, limit_s: float = 60.0) -> None:
        """Fly on until something is so, for a simulated time that is bounded."""
        end_us = self.simulation.time_us + int(limit_s * 1e6)
        while not condition():
            assert self.simulation.time_us < end_us, f"not within {limit_s} s: {what}; {self.texts}"
            self.tick()

    @property
    def height(self) -> float:
        return -float(self.simulation.truth.position[2])

    def close(self) -> None:
        self.simulation.close()
        self.observer.close()


@pytest.fixture
def flight(peer: HitlPeer, monkeypatch: pytest.MonkeyPatch) -> Iterator[Flight]:
    monkeypatch.setattr(bridge, "SILENCE_US", int(PATIENCE_S * 1e6))
    flight = Flight(peer)
    yield flight
    flight.close()


@pytest.mark.slow
def test_take_off_and_hover(flight: Flight, peer: HitlPeer) -> None:
    """A companion arms and takes off through the router; then the plant hovers where it says."""
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
    assert mavsdk.add_any_connection(f"udpin://{LOOPBACK}:{flight.api}") == 0
    flight.until(lambda: flight.observer.ready, "ready to arm")
    companion = in_background(flight, lambda: Companion(mavsdk), "MAVSDK finds the board")
    try:
        action, telemetry = companion.plugin(Action), companion.plugin(Telemetry)
        in_background(flight, lambda: action.set_takeoff_altitude(3.0), "a parameter is set")
        in_background(flight, action.arm, "it arms")
        in_background(flight, action.takeoff, "it takes off")
        flight.until(lambda: flight.firmware.flight.mode is Mode.HOLD and flight.height > 2.0, "up")
        assert flight.firmware.flight.phase is FlightPhase.AIR
        heights = []
        for _ in range(500):
            flight.tick()
            heights.append(flight.height)
        assert abs(float(np.mean(heights)) - 3.0) < 0.7
        assert float(np.ptp(heights)) < 0.7
        position = telemetry.position()
        assert position.relative_altitude_m == pytest.approx(flight.height, abs=0.7)
        assert any("Armed" in text for text in flight.texts)
    finally:
        companion.destroy()


def in_background(flight: Flight, call: Callable[[], Any], what: str) -> Any:
    """Run a blocking call in a separate thread while flying; return its result."""
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(call)
        flight.until(future.done, what)
        return future.result()


@pytest.mark.nightly
@pytest.mark.slow
def test_one_episode_after_the_other(flight: Flight, peer: HitlPeer) -> None:
    boots = peer.boots
    flight.until(lambda: flight.observer.ready, "ready to arm")
    flight.simulation.close()
    flight.simulation = flight.boot()
    assert peer.boots == boots + 1  # rebooted once, at the end of the episode
    flight.until(lambda: flight.observer.ready, "ready to arm")


@pytest.mark.slow
def test_a_board_that_does_not_tell_its_frame_stays_on_the_ground(
    flight: Flight, peer: HitlPeer
) -> None:
    peer.parameters = partial(Parameters, quad().parameters)  # no HIL_ACT_FUNC among them
    stack = ExternalFlightStack(flight.launcher, flight.observer, 2.0)
    flight.simulation.close()
    firmware = stack.boot(SETUP)
    simulation = Simulation(SETUP, start_us=7_000_000, clock=SimClock(), autopilot=firmware)
    flight.simulation = simulation

    def tick() -> int:
        simulation.tick()
        return simulation.time_us

    with pytest.raises(FirmwareMissingError, match=r"PX4 1.17.0 lacks HIL_ACT_FUNC1"):
        stack.connect(tick, simulation.plant.truth)

"""`airl-firmware --lockstep`: simulated time waits for a companion in another process."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from airl_mav.cli.common import check_ports, check_range
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.ports import Ports
from airl_mav.envs.spec import Delay
from airl_mav.flight.judge import TIME_LIMIT_S
from airl_mav.lockstep.remote import RemotePlan, RemoteStage
from airl_mav.lockstep.tokens import LONGEST_REST_US, TokenSettings
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.firmware import Loaded
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.plant.camera_server import CameraServer
from firmware_sim.simulation import EpisodeSetup, Simulation

LOCKSTEP_SPEEDS = 0.1, 1000.0
"""Limits of the pace; slower, the companion would take the vehicle for gone between two turns."""


@dataclass(frozen=True)
class LockstepOptions:
    """What --lockstep needs to know; docs/lockstep.md explains it."""

    transport_ms: float = Delay().transport_ms
    """With --lockstep: from a frame's exposure until the companion sees it, ms."""

    turn_us: int = TokenSettings().turn_us
    """With --lockstep: a companion that does not say when it wants its next turn has it so long
    after the last, us of simulated time."""

    companion_timeout: float = TokenSettings().patience_s
    """With --lockstep: longest turn of the companion, s of wall time."""

    goal_radius: float | None = None
    """With --lockstep: judge the flight, and tell the companion when it is lost; the goal is
    reached closer than this, seen from above, m. None: nobody judges."""

    time_limit: float = TIME_LIMIT_S
    """With --goal-radius: longest flight from the start of navigation, s."""


def remote_plan(options: LockstepOptions, speed: float | Literal["max"] | None) -> RemotePlan:
    """Return how to fly. Raises UsageError for an option that is out of range."""
    check_range("--transport-ms", options.transport_ms, 0.0, 1000.0)
    check_range("--turn-us", options.turn_us, 1, LONGEST_REST_US)
    check_range("--companion-timeout", options.companion_timeout, 1.0, 3600.0)
    check_range("--time-limit", options.time_limit, 1.0, 3600.0)
    if options.goal_radius is not None:
        check_range("--goal-radius", options.goal_radius, 0.2, 50.0)
    if isinstance(speed, float):
        check_range("--speed", speed, *LOCKSTEP_SPEEDS)
    return RemotePlan(
        transport_us=round(options.transport_ms * US_PER_MS),
        tokens=TokenSettings(options.turn_us, options.companion_timeout),
        speed=speed if isinstance(speed, float) else None,
        goal_radius_m=options.goal_radius,
        time_limit_s=options.time_limit,
    )


@dataclass(frozen=True)
class Sockets:
    """Where the companion is reached; they outlive a flight."""

    endpoint: UdpEndpoint
    camera: CameraServer

    @classmethod
    def open(cls, ports: Ports, bind: str, companion_host: str, *, insecure: bool) -> Sockets:
        """Bind the onboard link's port and the camera's. Raises UsageError when they are taken."""
        check_ports(ports, free=True)
        endpoint = UdpEndpoint(
            (bind, ports.api_local_port),
            (companion_host, ports.api_port),
            local_option="--api-local-port",
            remote_option="--api-port",
            insecure=insecure,
        )
        try:
            return cls(endpoint, CameraServer(f"tcp://{bind}:{ports.camera_port or '*'}"))
        except UsageError:
            endpoint.close()
            raise

    def stage(self, plan: RemotePlan, broken_off: Callable[[], bool]) -> RemoteStage:
        """Return the stage of one flight; see there."""
        return RemoteStage(self.endpoint, self.camera, plan, broken_off=broken_off)

    def close(self) -> None:
        """Release the ports."""
        self.endpoint.close()
        self.camera.close()


class LockstepBench:
    """Every episode a flight from scratch. Implements `firmware_service.Bench`."""

    slipped_us = 0

    def __init__(self, sockets: Sockets, plan: RemotePlan, broken_off: Callable[[], bool]) -> None:
        """Take where the companion is, how to fly, and what ends the wait for it."""
        self._sockets = sockets
        self._plan = plan
        self._broken_off = broken_off
        self._stage: RemoteStage | None = None

    @property
    def camera_endpoint(self) -> str:
        """Where frames are published."""
        return self._sockets.camera.endpoint

    @property
    def time_us(self) -> int:
        """Simulated time [µs]."""
        return 0 if self._stage is None else self._stage.time_us

    @property
    def idle(self) -> bool:
        """Whether the flight is over: nothing moves before the next request."""
        return self._stage is None or self._stage.ended

    def load(
        self,
        setup: EpisodeSetup,
        tlog: Path | None,
        tick: Callable[[Simulation], None],
        text: Callable[[Message], None],
    ) -> Loaded:
        """Set up an episode; see `firmware_service.Bench`."""
        self._leave()
        self._stage = stage = self._sockets.stage(self._plan, self._broken_off)
        stage.on_tick = tick
        stage.firmware.on_message = text
        return stage.load(setup, tlog)

    def step(self) -> None:
        """Fly a tick. Raises LockstepError when the companion does not keep to the turns."""
        if self._stage is not None:
            self._stage.step()

    def finish(self, record: Path) -> dict[str, str]:
        """Save the episode's arrays and forget it; return its fingerprint."""
        if self._stage is None:
            return {}
        lanes = self._stage.lanes()
        self._stage.firmware.save(record)
        self._leave()
        return lanes

    def close(self) -> None:
        """Release everything."""
        self._leave()
        self._sockets.close()

    def _leave(self) -> None:
        if self._stage is not None:
            self._stage.close()
            self._stage = None


def fly(stage: RemoteStage, stop: threading.Event, end_us: int | None, console: Console) -> None:
    """Fly a loaded stage until the companion has ended; say how it went, and the fingerprint.

    Args:
        stage: The flight.
        stop: Set from outside to end it.
        end_us: Simulated time at which it ends in any case [µs].
        console: Where to print.

    Raises:
        LockstepError: The companion is gone, or does not keep to the turns.
    """
    start_us, stopwatch = stage.time_us, WallClock()
    stage.on_phase = lambda phase, time_us: console.print(f"{time_us / US_PER_S:8.2f} s  {phase}")
    stage.on_verdict = lambda verdict: console.print(
        f"{verdict.time_us / US_PER_S:8.2f} s  {verdict.outcome.value}: {verdict.reason}",
        markup=False,
    )
    while not stage.ended and not stop.is_set() and (end_us is None or stage.time_us < end_us):
        alone = stage.turns == 0
        stage.step()
        if alone:
            stopwatch = WallClock()  # the wait for the companion is no part of the flight
    flown_s = (stage.time_us - start_us) / US_PER_S
    wall_s = max(stopwatch.time_us(), 1) / US_PER_S
    console.print(
        f"{flown_s:.1f} s simulated in {wall_s:.1f} s: {flown_s / wall_s:.2f} x real time; "
        f"{stage.turns} turns"
    )
    for name, sha256 in stage.lanes().items():
        console.print(f"{name:<13} {sha256}", highlight=False)

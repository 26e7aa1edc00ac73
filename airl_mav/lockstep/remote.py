"""Vehicle and flight controller on a simulated clock that a companion in another process shares.

`airl-firmware --lockstep`: simulated time waits for that companion.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.flight.judge import Referee, Task, Verdict
from airl_mav.lockstep.conductor import Conductor
from airl_mav.lockstep.digest import SEEN, FlightDigest
from airl_mav.lockstep.judging import Judge
from airl_mav.lockstep.link import BOOT_UNIX_US, lockstep_link
from airl_mav.lockstep.token_camera import TokenCamera
from airl_mav.lockstep.tokens import TokenPartner, TokenSettings
from airl_mav.lockstep.turns import COMPANION_STARTS_US
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.stand_alone import Listener, episode_of
from airl_mav.rehearsal.supervisor import Supervisor
from airl_mav.scenario.model import Ports
from airl_mav.scenario.stand_alone import StandAloneVehicle, check_vehicle
from firmware_sim.firmware import BuiltinFlightStack, Firmware, FrameServer, Loaded
from firmware_sim.mavlink.endpoint import MemoryEndpoint, UdpEndpoint
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.plant.camera_server import CameraServer
from firmware_sim.simulation import EpisodeSetup, Simulation
from firmware_sim.warm_up import warm_up


@dataclass(frozen=True)
class RemotePlan:
    """How flights go; the same for all."""

    transport_us: int
    """From a frame's exposure until the companion sees it [µs]."""
    tokens: TokenSettings
    speed: float | None = None
    """Greatest number of simulated seconds per wall second; None: as fast as it goes."""
    goal_radius_m: float | None = None
    """The referee's; None: there is none."""
    time_limit_s: float = 0.0
    """The referee's."""


class RemoteStage:
    """One flight. The sockets stay their owner's, for the next one."""

    def __init__(
        self,
        endpoint: UdpEndpoint,
        frames: FrameServer,
        plan: RemotePlan,
        *,
        broken_off: Callable[[], bool],
    ) -> None:
        """Put everything together; nothing moves yet.

        Args:
            endpoint: Where the companion is, or will be.
            frames: Where its camera's frames go.
            plan: How it flies.
            broken_off: Asked while the companion is waited for; True gives it up.
        """
        self.on_phase: Callable[[str, int], None] | None = None
        """Called with every phase that the companion enters, and the simulated time, if set."""
        self.on_verdict: Callable[[Verdict], None] | None = None
        """Called when the flight is decided, if set."""
        self.on_tick: Callable[[Simulation], None] | None = None
        """Called after every tick, if set."""
        self._plan = plan
        self._digest = FlightDigest()
        camera = TokenCamera(frames, plan.transport_us)
        self._partner = TokenPartner(
            endpoint, camera, plan.tokens, broken_off=broken_off, phase=self._enter
        )
        memory = MemoryEndpoint()
        self._conductor = Conductor(memory, self._partner, self._digest, plan.speed)
        server = MavlinkServer([lockstep_link(memory)], boot_unix_us=BOOT_UNIX_US)
        self.firmware = Firmware(BuiltinFlightStack(server), camera, self._conductor)
        self.firmware.on_tick = self._look
        self._judge = Judge(None, self._digest, order=self._partner.order)

    @property
    def ended(self) -> bool:
        """Whether the companion has ended, or was given up."""
        return self._conductor.ended

    @property
    def turns(self) -> int:
        """Turns that the companion has had."""
        return self._partner.turns

    @property
    def time_us(self) -> int:
        """Simulated time [µs]."""
        return self._conductor.clock.time_us()

    def load(self, setup: EpisodeSetup, tlog: Path | None) -> Loaded:
        """Set up the episode; the companion begins a moment later.

        Args:
            setup: The episode.
            tlog: Where its MAVLink log goes; None: no log.
        """
        plan = self._plan
        loaded = self.firmware.load(setup, tlog, BOOT_UNIX_US)
        supervisor = None
        if plan.goal_radius_m is not None and setup.arena is not None:
            goal = (float(setup.arena.goal[0]), float(setup.arena.goal[1]))
            task = Task(goal, plan.goal_radius_m, plan.time_limit_s)
            supervisor = Supervisor(Referee(task), loaded.time_us)
        self._judge = Judge(
            supervisor, self._digest, order=self._partner.order, judged=self._decide
        )
        self._conductor.begin(loaded.time_us + COMPANION_STARTS_US)
        return loaded

    def step(self) -> None:
        """Fly one tick, with whatever the companion does before it.

        Raises:
            LockstepError: The companion is gone, or does not keep to the turns.
        """
        self.firmware.step()

    def lanes(self) -> dict[str, str]:
        """Return the fingerprint of the flight by lane; call once, at its end.

        What the policy saw is not in it: that is the companion's to know.
        """
        simulation = self.firmware.simulation
        if simulation is not None and simulation.recorder is not None:
            self._digest.add_setpoints(simulation.recorder.setpoints.arrays())
        return {name: lane for name, lane in self._digest.lanes().items() if name != SEEN}

    def close(self) -> None:
        """Let the companion go and forget the flight."""
        self._partner.close()
        self.firmware.close()

    def _enter(self, phase: str, time_us: int) -> None:
        if self.on_phase is not None:
            self.on_phase(phase, time_us)
        self._judge.enter(phase, time_us)

    def _decide(self, verdict: Verdict) -> None:
        if self.on_verdict is not None:
            self.on_verdict(verdict)

    def _look(self, simulation: Simulation) -> None:
        self._judge.look(simulation)
        if self.on_tick is not None:
            self.on_tick(simulation)


@dataclass(frozen=True)
class Sockets:
    """Where the companion is reached; they outlive a flight."""

    endpoint: UdpEndpoint
    camera: CameraServer

    @classmethod
    def open(cls, ports: Ports, bind: str, companion_host: str, *, insecure: bool) -> Sockets:
        """Bind the onboard link's port and the camera's. Raises UsageError when they are taken."""
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


def fly_vehicle_in_lockstep(
    asked: StandAloneVehicle, stop: threading.Event, listener: Listener | None = None
) -> None:
    """Fly with one companion that passes turns, until it has ended.

    Args:
        asked: What flies, and where.
        stop: Set from outside to end it.
        listener: Who is told what happens.

    Raises:
        UsageError: The input cannot be used.
        LockstepError: The companion is gone, or does not keep to the turns.
    """
    listener = listener or Listener()
    check_vehicle(asked)
    vehicle = load_vehicle(asked.vehicle)
    plan = plan_of(asked)
    with closing(
        Sockets.open(asked.ports, asked.bind, asked.companion_host, insecure=asked.insecure)
    ) as sockets:
        episode, goal = episode_of(asked, vehicle)
        warm_up(vehicle)
        with closing(sockets.stage(plan, stop.is_set)) as stage:
            stage.firmware.on_message = listener.text
            started_us = stage.load(episode, asked.tlog).time_us
            listener.ready(sockets.camera.endpoint, goal)
            end_us = None
            if asked.duration is not None:
                end_us = started_us + int(asked.duration * US_PER_S)
            fly_stage(stage, stop, end_us, listener.say)


def plan_of(asked: StandAloneVehicle) -> RemotePlan:
    """Return how a flight goes that was asked for."""
    return RemotePlan(
        transport_us=round(asked.transport_ms * US_PER_MS),
        tokens=TokenSettings(asked.turn_us, asked.companion_timeout),
        speed=asked.pace,
        goal_radius_m=asked.goal_radius_m,
        time_limit_s=asked.time_limit_s,
    )


def fly_stage(
    stage: RemoteStage, stop: threading.Event, end_us: int | None, say: Callable[[str], None]
) -> None:
    """Fly a loaded stage until the companion has ended; say how it went, and the fingerprint.

    Args:
        stage: The flight.
        stop: Set from outside to end it.
        end_us: Simulated time at which it ends in any case [µs].
        say: Is told what happens, a line at a time.

    Raises:
        LockstepError: The companion is gone, or does not keep to the turns.
    """
    start_us, stopwatch = stage.time_us, WallClock()
    stage.on_phase = lambda phase, time_us: say(f"{time_us / US_PER_S:8.2f} s  {phase}")
    stage.on_verdict = lambda verdict: say(
        f"{verdict.time_us / US_PER_S:8.2f} s  {verdict.outcome.value}: {verdict.reason}",
    )
    while not stage.ended and not stop.is_set() and (end_us is None or stage.time_us < end_us):
        alone = stage.turns == 0
        stage.step()
        if alone:
            stopwatch = WallClock()  # the wait for the companion is no part of the flight
    flown_s = (stage.time_us - start_us) / US_PER_S
    wall_s = max(stopwatch.time_us(), 1) / US_PER_S
    say(
        f"{flown_s:.1f} s simulated in {wall_s:.1f} s: {flown_s / wall_s:.2f} x real time; "
        f"{stage.turns} turns"
    )
    for name, sha256 in stage.lanes().items():
        say(f"{name:<13} {sha256}")

"""Vehicle and flight controller in lockstep with a companion in another process.

`airl-firmware --lockstep`: simulated time waits for the companion.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from airl_mav.addons.remote_lockstep.token_partner import TokenCamera, TokenPartner, Wire
from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.signing import StoredSigning
from airl_mav.flight.judge import Referee, Task, Verdict
from airl_mav.lockstep.conductor import Conductor
from airl_mav.lockstep.lockstep_flight import Judge
from airl_mav.lockstep.turns import COMPANION_STARTS_US, SEEN, FlightDigest
from airl_mav.lockstep.vehicle import BOOT_UNIX_US, builtin_vehicle
from airl_mav.rehearsal.episode import EpisodeSupervisor
from airl_mav.rehearsal.firmware_process import Listener, aircraft_of, camera_server, episode_of
from airl_mav.scenario.stand_alone import StandAloneVehicle, check_vehicle
from firmware_sim.firmware import Firmware, FrameServer, LoadedEpisode
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.simulation import EpisodeSetup
from firmware_sim.warm_up import warm_up


class RemoteStage:
    """One flight. The caller owns the sockets and reuses them for the next flight."""

    def __init__(
        self,
        asked: StandAloneVehicle,
        endpoint: UdpEndpoint,
        frames: FrameServer,
        *,
        stored: StoredSigning | None = None,
        broken_off: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """Connect all parts; nothing is started.

        `stored` is the signing key of both sides; None = no signing. `broken_off` is polled while
        waiting for the companion; True ends the wait. `say` receives status lines.
        """
        self._asked = asked
        self._say = say
        self._digest = FlightDigest()
        camera = TokenCamera(frames, round(asked.transport_ms * US_PER_MS))
        self._wire = Wire(endpoint, stored, say)
        self._partner = TokenPartner(
            self._wire,
            camera,
            turn_us=asked.turn_us,
            patience_s=asked.companion_timeout,
            broken_off=broken_off,
            phase=self._enter,
        )
        clock = SimClock()
        # The conductor drives the vehicle; the partner is the link to the companion.
        vehicle = builtin_vehicle(clock, asked.faults)
        self._conductor = Conductor(vehicle.end, self._partner, self._digest, asked.pace, clock)
        self.firmware = Firmware(vehicle.stack, camera, self._conductor, failing=vehicle.failing)
        self._judge = Judge(None, self._digest, order=self._partner.order)
        self.end_us = math.inf
        """Maximum simulated time of the flight [µs]."""
        # Orders by time: the end of the flight, and the judge's deadlines.
        self._conductor.orders_us = lambda: min(self.end_us, self._judge.due_us)

    @property
    def ended(self) -> bool:
        """True if the companion has ended or the wait for it was ended."""
        return self._conductor.ended

    @property
    def turns(self) -> int:
        """Number of the companion's turns so far."""
        return self._partner.turns

    @property
    def time_us(self) -> int:
        """Simulated time [µs]."""
        return self._conductor.clock.time_us()

    def load(self, setup: EpisodeSetup, tlog: Path | None) -> LoadedEpisode:
        """Load the episode, with a MAVLink log if not None; the companion starts shortly after."""
        asked = self._asked
        loaded = self.firmware.load(setup, tlog, BOOT_UNIX_US)
        # Without a goal radius the flight has no verdict.
        if asked.goal_radius_m is not None and setup.arena is not None:
            task = Task(setup.arena.goal_point, asked.goal_radius_m, asked.time_limit_s)
            supervisor = EpisodeSupervisor(Referee(task), loaded.time_us)
            self._judge = Judge(
                supervisor, self._digest, order=self._partner.order, judged=self._decide
            )
        self.firmware.on_ticks = self._judge.look
        # The companion starts a fixed time after the vehicle.
        self._conductor.begin(loaded.time_us + COMPANION_STARTS_US)
        return loaded

    def step(self) -> None:
        """Fly one tick, after the companion's due turns. Raises LockstepError if it is lost."""
        self.firmware.step()

    def lanes(self) -> dict[str, str]:
        """Return the flight's digests by part; call once, at the end.

        The companion computes the digest of the observations.
        """
        simulation = self.firmware.simulation
        if simulation is not None and simulation.recorder is not None:
            self._digest.add_setpoints(simulation.recorder.setpoints.arrays())
        return {name: lane for name, lane in self._digest.lanes().items() if name != SEEN}

    def close(self) -> None:
        """Release the companion and discard the flight; the caller closes the sockets."""
        self._partner.close()
        self._wire.close()
        self.firmware.close()

    def _enter(self, phase: str, time_us: int) -> None:
        self._say(f"{time_us / US_PER_S:8.2f} s  {phase}")
        self._judge.enter(phase, time_us)

    def _decide(self, verdict: Verdict) -> None:
        self._say(f"{verdict.time_us / US_PER_S:8.2f} s  {verdict.outcome.value}: {verdict.reason}")


def fly_vehicle_in_lockstep(
    asked: StandAloneVehicle, stop: threading.Event, listener: Listener | None = None
) -> None:
    """Fly with one companion that passes turns, until the companion ends or `stop` is set.

    Raises:
        UsageError: The input is invalid, or a port is in use.
        LockstepError: The companion is lost or violates the protocol.
    """
    listener = listener or Listener()
    check_vehicle(asked)
    vehicle, computer_w = aircraft_of(asked)
    ports = asked.open_ports
    # A stored key makes other machines acceptable.
    stored = None if asked.signing_key is None else StoredSigning(asked.signing_key)
    with (
        closing(
            UdpEndpoint(
                (asked.bind, ports.api_local_port),
                (asked.companion_host, ports.api_port),
                local_option="--api-local-port",
                remote_option="--api-port",
                insecure=asked.insecure or stored is not None,
            )
        ) as endpoint,
        closing(camera_server(asked, asked.bind, insecure=asked.insecure)) as camera,
    ):
        episode, goal = episode_of(asked, vehicle, computer_w)
        warm_up(vehicle, asked.plant)
        stage = RemoteStage(
            asked, endpoint, camera, stored=stored, broken_off=stop.is_set, say=listener.say
        )
        with closing(stage):
            stage.firmware.on_message = listener.text
            stage.firmware.on_log_lost = listener.say
            start_us = stage.load(episode, asked.tlog).time_us
            listener.ready(camera.endpoint, goal)
            # The duration counts in simulated time from the start of the flight.
            end_us = None
            if asked.duration is not None:
                end_us = start_us + int(asked.duration * US_PER_S)
            _fly(stage, stop, end_us, listener.say)


def _fly(
    stage: RemoteStage, stop: threading.Event, end_us: int | None, say: Callable[[str], None]
) -> None:
    """Fly a loaded stage until the companion has ended, or simulated `end_us`; print a summary."""
    start_us, stopwatch = stage.time_us, WallClock()
    stage.end_us = math.inf if end_us is None else end_us
    while not stage.ended and not stop.is_set() and stage.time_us < stage.end_us:
        # Before the first turn the companion is not connected.
        alone = stage.turns == 0
        stage.step()
        if alone:
            stopwatch = WallClock()  # excludes the wait for the companion
    flown_s = (stage.time_us - start_us) / US_PER_S
    wall_s = max(stopwatch.time_us(), 1) / US_PER_S
    say(
        f"{flown_s:.1f} s simulated in {wall_s:.1f} s: {flown_s / wall_s:.2f} x real time; "
        f"{stage.turns} turns"
    )
    # Digests let two flights be compared without their logs.
    for name, sha256 in stage.lanes().items():
        say(f"{name:<13} {sha256}")

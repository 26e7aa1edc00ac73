"""Firmware process of a rehearsal, and the same vehicle alone for any client."""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.core.clock import utc_now
from airl_mav.core.compiling import heard_compiling
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import Geodetic, Goal
from airl_mav.core.signing import StoredSigning, camera_key
from airl_mav.faults import PROCESSES, Fault, link_fails
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.camera import check_noise
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile, check_spread, equipped
from airl_mav.rehearsal import channel
from airl_mav.rehearsal.channel import State
from airl_mav.rehearsal.live_view import view_part
from airl_mav.scenario import checks, resolve, stand_alone
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim import fault_timeline, interfaces
from firmware_sim.autopilot import autopilot_state, commander
from firmware_sim.external import parameters, programs
from firmware_sim.external.flight_stack import FirmwareRequest, real_firmware
from firmware_sim.firmware import BuiltinFlightStack, Firmware, FlightStack, fly
from firmware_sim.mavlink.px4_links import LinkConfig, UdpLinks, bind_gimbal_link, bind_udp_links
from firmware_sim.mavlink.server import udp_server
from firmware_sim.pacing import Pacing, Unpaced, WallPacing
from firmware_sim.plant.camera import CameraServer
from firmware_sim.simulation import CrashDetector, EpisodeSetup, HoverStart, Simulation
from firmware_sim.warm_up import warm_up

STATE_EVERY_US = 40_000
"""Period of true-state reports to the rehearsal [simulated µs]: 25 Hz."""


def build_firmware(
    aircraft: Aircraft,
    vehicle: VehicleProfile,
    pacing: Pacing,
    *,
    bind: str = LOOPBACK,
    companion_host: str = LOOPBACK,
    gcs_host: str = LOOPBACK,
    insecure: bool = False,
    log: Path | None = None,
    recording: bool = True,
    parameters_file: Path | None = None,
    bind_devices: Callable[[], Sequence[LinkConfig]] = tuple,
) -> Firmware:
    """Bind all ports and return the firmware without an episode.

    Addresses are IPv4; `insecure` allows addresses that other machines can reach. Output of real
    firmware goes to `log`, or into a file in its folder. The built-in autopilot saves user
    parameters in `parameters_file`; None = does not save them. Without `recording`, episodes have
    no maximum length. `bind_devices` binds additional links of the built-in flight controller,
    after the others. Raises UsageError if a port is taken, an address unusable, or real firmware
    missing.
    """
    ports = aircraft.open_ports

    def ends() -> UdpLinks:
        return bind_udp_links(
            bind=bind,
            api_remote=(companion_host, ports.api_port),
            api_local_port=ports.api_local_port,
            gcs_remote=(gcs_host, ports.gcs_port),
            gcs_local_port=ports.gcs_local_port,
            insecure=insecure,
        )

    signing = None if aircraft.signing_key is None else StoredSigning(aircraft.signing_key)
    open_camera, insecure = insecure, insecure or signing is not None
    flight_stack: FlightStack
    failing: fault_timeline.FailingLink | None = None
    if aircraft.firmware == "builtin":
        links = ends()
        if link_fails(aircraft.faults):
            failing = fault_timeline.failing_link(links.api, pacing.clock)
        try:
            devices = bind_devices()
        except UsageError:
            links.api.close()
            links.gcs.close()
            raise
        server = udp_server(
            links, unix_us(), pacing.clock, signing, onboard=failing, devices=devices
        )
        keeper = None if parameters_file is None else parameters.KeptParameters(parameters_file)
        flight_stack = BuiltinFlightStack(server, keeper)
    else:
        flight_stack = real_firmware(FirmwareRequest(aircraft, vehicle, log, ends))
    try:
        camera = camera_server(aircraft, bind, insecure=open_camera)
    except UsageError:
        flight_stack.close()
        raise
    return Firmware(flight_stack, camera, pacing, recording=recording, failing=failing)


def camera_server(aircraft: Aircraft, bind: str, *, insecure: bool) -> CameraServer:
    """Bind the camera's socket. Raises UsageError for a bad key, or if other machines need one."""
    endpoint = f"tcp://{bind}:{aircraft.open_ports.camera_port or '*'}"
    key = camera_key(aircraft.camera_key, endpoint, "bind", insecure=insecure)
    return CameraServer(endpoint, key=key)


class Service:
    """Flies the episodes that the rehearsal requests, one at a time."""

    def __init__(
        self,
        firmware: Firmware,
        harness: channel.ChildChannel,
        scenario: resolve.ResolvedScenario,
        tap: Any = None,
    ) -> None:
        """Store firmware, harness, scenario and view, and register callbacks."""
        self._tap = tap
        if tap is not None:
            firmware.on_frame = tap.frame
        self._firmware = firmware
        self._harness = harness
        self._scenario = scenario
        firmware.on_tick, firmware.on_message = self._report, self._tell
        firmware.on_log_lost = lambda what: harness.send(channel.LogLost(what=what))
        self._record = Path()
        self._reported = 0
        self._crash = CrashDetector()
        self._due: dict[int, Fault] = {}
        """Acting process faults reported to the rehearsal, by number."""
        self._handlers: dict[type, Callable[[Any], None]] = {
            channel.LoadEpisode: self._load,
            channel.FinishEpisode: self._finish,
        }

    def run(self, requests: queue.Queue[Any]) -> None:
        """Fly until shutdown. Raises UsageError for an invalid episode, or FirmwareLostError."""
        while self._handle_all(requests):
            self._firmware.step()

    def _handle_all(self, requests: queue.Queue[Any]) -> bool:
        """Handle all pending requests; return False on shutdown."""
        with contextlib.suppress(queue.Empty):
            while True:
                request = requests.get(block=False)
                if isinstance(request, channel.Shutdown):
                    return False
                self._handlers[type(request)](request)
        return True

    def _load(self, request: channel.LoadEpisode) -> None:
        scenario = self._scenario
        arena = scenario.arena_of(request.seed)
        episode = episode_setup(scenario, arena, request.seed)
        tlog = Path(request.tlog) if request.tlog else None
        self._crash = CrashDetector()
        self._due.clear()
        loaded = self._firmware.load(episode, tlog, unix_us())
        if self._tap is not None:
            self._tap.begin(request.seed, arena, loaded.time_us)
        self._record = Path(request.record)
        self._harness.send(
            channel.Loaded(
                time_us=loaded.time_us,
                epoch_ns=loaded.epoch_ns,
                slipped_us=self._firmware.slipped_us,
                goal=arena.goal_point,
                firmware=self._firmware.flight_stack.version,
                local_goal=self._firmware.flight_stack.local(arena.goal_point),
                poses=self._firmware.flight_stack.title(),
            )
        )

    def _finish(self, _: channel.FinishEpisode) -> None:
        self._firmware.save(self._record)
        self._firmware.discard()
        self._harness.send(channel.Saved())

    def _report(self, simulation: Simulation) -> None:
        if simulation.faults is not None:
            self._tell_faults(simulation.faults, simulation.time_us)
        period = simulation.time_us // STATE_EVERY_US
        hit = self._crash.look(simulation)
        if self._tap is not None:
            self._tap.tick(simulation, self._crash.hit)
        if not hit and period == self._reported:
            return
        self._reported = period
        self._harness.send(state_of(simulation, self._crash.hit, self._firmware.slipped_us))

    def _tell_faults(self, timeline: fault_timeline.FaultTimeline, now_us: int) -> None:
        """Report process faults that begin or end."""
        acting = {each.number: each.fault for each in timeline.acting(*PROCESSES)}
        if acting.keys() == self._due.keys():
            return
        for number in acting.keys() ^ self._due.keys():
            fault, begins = (acting | self._due)[number], number in acting
            if begins and (fault.part, fault.kind) == ("firmware", "killed"):
                # Save the true state now: a killed firmware cannot answer.
                self._firmware.save(self._record)
            self._harness.send(channel.Due(time_us=now_us, fault=str(fault), begins=begins))
        self._due = acting

    def _tell(self, message: autopilot_state.OperatorText) -> None:
        simulation = self._firmware.simulation
        time_us = 0 if simulation is None else simulation.time_us
        self._harness.send(
            channel.Text(time_us=time_us, severity=int(message.severity), text=message.text)
        )


def unix_us() -> int:
    """Return the calendar time [µs since 1970], for log headers."""
    return int(utc_now().timestamp() * US_PER_S)


def fly_requested(begin: channel.Begin, harness: channel.ChildChannel) -> None:
    """Fly episodes on request until the pipe closes."""
    requests: queue.Queue[Any] = queue.Queue()
    harness.listen(requests.put, lambda: requests.put(channel.Shutdown()))
    scenario = begin.scenario
    firmware = build_firmware(
        scenario.scenario,
        scenario.vehicle,
        WallPacing(scenario.speed or 1.0, programs.behind_us(scenario.scenario)),
        log=None if begin.log is None else Path(begin.log),
    )
    with ExitStack() as held:
        held.enter_context(closing(firmware))
        tap: Any = None
        if begin.view is not None:
            tap = held.enter_context(closing(view_part("simulation")(begin.view, scenario)))
        with heard_compiling(lambda begins: harness.send(channel.Compiling(begins=begins))):
            warm_up(scenario.vehicle, scenario.scenario.plant)
        harness.send(channel.Ready())
        Service(firmware, harness, scenario, tap).run(requests)


@dataclass
class Listener:
    """Callbacks of a stand-alone vehicle. All calls come from the flying thread."""

    waiting: Callable[[str], None] = field(default=lambda _what: None)
    """Called while real firmware must be started by the user, with instructions."""
    ready: Callable[[str, Goal], None] = field(default=lambda _camera, _goal: None)
    """Called when the vehicle is ready, with the ZeroMQ address of its camera and the goal."""
    text: Callable[[autopilot_state.OperatorText], None] = field(default=lambda _message: None)
    """Called for a text of the autopilot."""
    say: Callable[[str], None] = field(default=lambda _line: None)
    """Called for each line of progress."""


def fly_vehicle(
    asked: stand_alone.StandAloneVehicle, stop: threading.Event, listener: Listener | None = None
) -> None:
    """Fly client commands until `stop`. Raises UsageError or FirmwareLostError."""
    listener = listener or Listener()
    stand_alone.check_vehicle(asked)
    vehicle, computer_w = aircraft_of(asked)
    ports: list[str] = []

    def bind_devices() -> list[LinkConfig]:
        insecure = asked.insecure or asked.signing_key is not None
        host, instance = asked.companion_host, asked.real.instance
        return bind_gimbal_link(asked.bind, host, instance, insecure=insecure, say=ports.append)

    # Before binding ports, so that an arena error is reported first.
    episode, goal = episode_of(asked, vehicle, computer_w)
    firmware = build_firmware(
        asked,
        vehicle,
        Unpaced() if asked.pace is None else WallPacing(asked.pace, programs.behind_us(asked)),
        bind=asked.bind,
        companion_host=asked.companion_host,
        gcs_host=asked.gcs_host,
        insecure=asked.insecure,
        log=asked.firmware_log,
        # Flights may last for days, and their recording is not used.
        recording=False,
        parameters_file=asked.parameters_file,
        bind_devices=bind_devices,
    )
    with closing(firmware):
        firmware.on_message = listener.text
        firmware.on_log_lost = listener.say
        warm_up(vehicle, asked.plant)
        if (hint := programs.how_to_start(asked, vehicle)) is not None:
            listener.waiting(hint)
        firmware.load(episode, asked.tlog, unix_us())
        listener.ready(firmware.camera_endpoint, firmware.flight_stack.local(goal))
        for line in ports:
            listener.say(line)
        fly(firmware, stop, asked.duration, listener.say)


def aircraft_of(asked: stand_alone.StandAloneVehicle) -> tuple[VehicleProfile, float]:
    """Return the loaded vehicle and its computer's power [W]. Raises UsageError."""
    vehicle, computer = equipped(asked.vehicle, asked.computer, asked.payload, asked.px4_release)
    check_spread(vehicle, asked.spread)
    further = vehicle.cameras.values()
    check_noise(vehicle.camera, asked.sensors, asked.faults, further=further)
    checks.check_fitted(vehicle.sensors, asked.faults)
    return vehicle, computer.onboard_watts


def episode_of(
    asked: stand_alone.StandAloneVehicle, vehicle: VehicleProfile, computer_w: float
) -> tuple[EpisodeSetup, Goal]:
    """Return the episode of a loaded vehicle, and its goal. Raises UsageError without an arena."""
    spec = load_profile("arenas", asked.arena, ArenaSpec)
    width_m = vehicle.body.width_m
    arena = generate(spec, asked.seed, name=asked.arena, vehicle_width_m=width_m)
    return EpisodeSetup(vehicle, arena, asked.seed, asked, computer_w), arena.goal_point


def episode_setup(resolved: resolve.ResolvedScenario, arena: Arena, seed: int) -> EpisodeSetup:
    """Return the setup of an episode in the arena of a seed."""
    hover = None
    if resolved.scenario.start == "hover":
        place = None if resolved.vehicle.uses_gps else resolved.companion_pilot.origin
        origin = None if place is None else Geodetic(*place)
        hover = HoverStart(resolved.pilot.altitude_m, origin)
    return EpisodeSetup(
        resolved.vehicle,
        arena,
        seed,
        resolved.scenario,
        resolved.computer.onboard_watts,
        hover,
    )


def state_of(simulation: Simulation, collision: str | None, slipped_us: int = 0) -> State:
    """Return the state after the newest tick, with collision and skipped time [µs]."""
    truth, flight = simulation.truth, simulation.autopilot.flight
    x, y, z = (float(c) for c in truth.position)
    return State(
        time_us=truth.time_us,
        position=(x, y, z),
        speed_m_s=float(np.linalg.norm(truth.velocity)),
        battery=truth.battery_remaining,
        collision=collision,
        armed=flight.phase >= commander.FlightPhase.GROUND,
        slipped_us=slipped_us,
    )


if __name__ == "__main__":
    sys.exit(channel.serve(fly_requested, interfaces.FirmwareLostError))

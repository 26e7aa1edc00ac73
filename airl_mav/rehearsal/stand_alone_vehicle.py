"""Vehicle without a companion: flight controller, plant and camera, for any client."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field

from airl_mav.arena.generate import generate
from airl_mav.core.frames import Goal
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.camera import check_noise, check_renderer
from airl_mav.profiles.conditions import check_spread, equipped
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.firmware_process import build_firmware, unix_us
from airl_mav.scenario.checks import check_fitted
from airl_mav.scenario.stand_alone import StandAloneVehicle, check_vehicle
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.external.programs import how_to_start
from firmware_sim.firmware import fly
from firmware_sim.mavlink.px4_links import LinkConfig, bind_device_links
from firmware_sim.pacing import Unpaced, WallPacing
from firmware_sim.simulation import EpisodeSetup
from firmware_sim.warm_up import warm_up


@dataclass
class Listener:
    """Callbacks of a stand-alone vehicle. All calls come from the flying thread."""

    waiting: Callable[[str], None] = field(default=lambda _what: None)
    """Called while real firmware must be started by the user, with instructions."""
    ready: Callable[[str, Goal], None] = field(default=lambda _camera, _goal: None)
    """Called when the vehicle is ready, with the ZeroMQ address of its camera and the goal."""
    text: Callable[[OperatorText], None] = field(default=lambda _message: None)
    """Called for a text of the autopilot."""
    say: Callable[[str], None] = field(default=lambda _line: None)
    """Called for each line of progress."""


def fly_vehicle(
    asked: StandAloneVehicle, stop: threading.Event, listener: Listener | None = None
) -> None:
    """Fly client commands until `stop`. Raises UsageError or FirmwareLostError."""
    listener = listener or Listener()
    check_vehicle(asked)
    vehicle, computer_w = aircraft_of(asked)
    ports: list[str] = []

    def bind_devices() -> list[LinkConfig]:
        insecure = asked.insecure or asked.signing_key is not None
        host, instance = asked.companion_host, asked.real.instance
        return bind_device_links(asked.bind, host, instance, insecure=insecure, say=ports.append)

    # Before binding ports, so that an arena error is reported first.
    episode, goal = episode_of(asked, vehicle, computer_w)
    firmware = build_firmware(
        asked,
        vehicle,
        Unpaced() if asked.pace is None else WallPacing(asked.pace),
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
        if (hint := how_to_start(asked, vehicle)) is not None:
            listener.waiting(hint)
        firmware.load(episode, asked.tlog, unix_us())
        listener.ready(firmware.camera_endpoint, goal)
        for line in ports:
            listener.say(line)
        fly(firmware, stop, asked.duration, listener.say)


def aircraft_of(asked: StandAloneVehicle) -> tuple[VehicleProfile, float]:
    """Return the loaded vehicle and its computer's power [W]. Raises UsageError."""
    vehicle, computer = equipped(asked.vehicle, asked.computer, asked.payload)
    check_spread(vehicle, asked.spread)
    further = vehicle.cameras.values()
    check_noise(vehicle.camera, asked.sensors, asked.faults, further=further)
    check_fitted(vehicle.sensors, asked.faults)
    return vehicle, computer.onboard_watts


def episode_of(
    asked: StandAloneVehicle, vehicle: VehicleProfile, computer_w: float
) -> tuple[EpisodeSetup, Goal]:
    """Return the episode of a loaded vehicle, and its goal. Raises UsageError without an arena."""
    spec = load_profile("arenas", asked.arena, ArenaSpec)
    check_renderer(vehicle.camera, asked.renderer, spec, vehicle.cameras.values())
    width_m = vehicle.body.width_m
    arena = generate(spec, asked.seed, name=asked.arena, vehicle_width_m=width_m)
    return EpisodeSetup(vehicle, arena, asked.seed, asked, computer_w), arena.goal_point

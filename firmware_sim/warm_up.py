"""Warm-up: load or compile all kernels before the first paced tick, which has 4 ms.

The first start after an install compiles in the processes of `airl_mav.core.first_start`; later
starts load the compiled code from disk.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.control.demand import AttitudeDemand, Gains, RateDemand, TrajectoryDemand
from airl_mav.core import clock, constants
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import DEFAULT_PLANT, Aircraft, PlantName
from firmware_sim.autopilot import climb, yaw_estimator
from firmware_sim.autopilot.estimator import aiding
from firmware_sim.autopilot.failsafes.watch import is_calm
from firmware_sim.engine import record, ticks
from firmware_sim.engine.controller import Controller
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.telemetry import Packer, TickContext
from firmware_sim.plant.camera import SimulatedCamera
from firmware_sim.simulation import EpisodeSetup, Simulation, builtin_autopilot

LONGEST_TICKS = 1300
"""Maximum number of ticks; the vehicle is ready to arm after 200, without GPS after 400."""

ARMED_TICKS = 60
"""Number of ticks for the rotors to spin up and every stream to be sent."""

HIGH_M = 20.0
"""Altitude above all obstacles [m]."""

HOVER = np.array([0.0, 0.0, -constants.GRAVITY_M_S2])
"""Specific force (3,) in level hover, FRD [m/s²]."""


def warm_up(vehicle: VehicleProfile, plant: PlantName = DEFAULT_PLANT) -> None:
    """Fly briefly in simulated time, through all code that a real flight on a plant uses."""
    _fly(vehicle, plant, _arena(vehicle))


def compile_flight(vehicle: str, plant: PlantName) -> None:
    """Compile everything for a vehicle profile in JSON."""
    warm_up(VehicleProfile.model_validate_json(vehicle), plant)


def compile_ticks(vehicle: str, plant: PlantName) -> None:
    """Compile plant and flight controller, without arena and cameras."""
    _fly(VehicleProfile.model_validate_json(vehicle), plant, None)


def compile_others(vehicle: str) -> None:
    """Compile MAVLink streams, auxiliary estimators, arenas and cameras."""
    profile = VehicleProfile.model_validate_json(vehicle)
    # First what the ticks of the other process need: it finds it in the cache.
    none = np.zeros(1, np.int64)
    flown, context = np.zeros(1, record.FLOWN_TICK), np.zeros(TickContext.SIZE)
    Packer().pack(flown, 0, context, none, none.copy(), none.copy(), 1, 0, 1)
    _fuse_in_the_air()
    aiding().warm_up(builtin_autopilot(EpisodeSetup(profile, None, 0)).parameters.value)
    SimulatedCamera(profile.camera, _arena(profile), further=profile.cameras)


def _arena(vehicle: VehicleProfile) -> Arena:
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    return generate(spec, 1, name="warm-up", vehicle_width_m=vehicle.body.width_m)


def _fly(vehicle: VehicleProfile, plant: PlantName, arena: Arena | None) -> None:
    setup = EpisodeSetup(vehicle, arena, 0, Aircraft(plant=plant))
    autopilot = builtin_autopilot(setup)
    if (origin := vehicle.told_origin) is not None:
        autopilot.set_origin(origin)  # required for the take-off
    simulation = Simulation(setup, start_us=0, clock=clock.SimClock(), autopilot=autopilot)
    links = [onboard_link(MemoryEndpoint()), gcs_link(MemoryEndpoint())]
    server = MavlinkServer(links, autopilot, boot_unix_us=0)
    try:
        armed = 0
        for _ in range(LONGEST_TICKS):
            simulation.tick()
            server.send(simulation.time_us)
            simulation.capture_due(simulation.time_us, lambda _frame: None)
            if autopilot.arm(force=False) == 0:
                autopilot.takeoff(2.0)
                armed += 1
            if armed == ARMED_TICKS:
                break
        # Away from all obstacles.
        simulation.plant.put((0.0, 0.0, -HIGH_M))
        for _ in range(ARMED_TICKS):
            simulation.tick()
    finally:
        simulation.close()
    _fly_every_kind(autopilot.parameters.value)
    _fuse_in_the_air()
    ticks.detect_record(autopilot.record)
    is_calm(autopilot.record, np.zeros(6))
    climb.Climb(autopilot.record).fly(record.RISING, 0)
    aiding().warm_up(autopilot.parameters.value)


def _fly_every_kind(value: Callable[[str], float]) -> None:
    """Run the cascade once per kind of demand; some modes demand attitudes or rates."""
    controller = Controller(Gains.from_parameters(value))
    state = np.zeros(13)
    state[6] = 1.0
    nothing = (0.0, 0.0, 0.0)
    controller.fly(state, TrajectoryDemand(nothing, nothing, nothing, 0.0, 0.0))
    controller.fly(state, AttitudeDemand((1.0, 0.0, 0.0, 0.0), 0.0, 0.5))
    controller.fly(state, RateDemand(nothing, 0.5))


def _fuse_in_the_air() -> None:
    """Fuse a velocity in flight into the yaw estimator; a real climb takes ten times as long."""
    estimator = yaw_estimator.YawEstimator(record.new_controller())
    estimator.feel(np.zeros(3), HOVER)
    estimator.observe(np.zeros(3), 0.5, np.zeros(3), flying=True)

"""The example of snapshots: a restored simulation flies on bit-identically."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.camera.frame import Frame
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import US_PER_S
from airl_mav.faults import Fault
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import WindSettings, load_vehicle
from airl_mav.scenario.aircraft import HAS_PYBULLET, Aircraft
from examples.snapshot import Snapshot
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.simulation import EpisodeSetup, HoverStart, Simulation
from tests.support.flight_rig import velocity_setpoint

PLANTS = [
    "kernel",
    pytest.param("pybullet", marks=pytest.mark.skipif(not HAS_PYBULLET, reason="no pybullet")),
]
TICKS = 750


@pytest.fixture
def held() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def hovering(held: ExitStack, vehicle: str = "quad", **aircraft: Any) -> Simulation:
    """Return a vehicle that hovers among moving obstacles."""
    profile = load_vehicle(vehicle)
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    arena = generate(spec, 5, name="dynamic-obstacles", vehicle_width_m=profile.body.width_m)
    setup = EpisodeSetup(profile, arena, 5, Aircraft(**aircraft))
    simulation = held.enter_context(closing(Simulation(setup, start_us=0, clock=SimClock())))
    assert HoverStart(2.5, profile.told_origin).fly(simulation)
    simulation.begin()
    return simulation


def built_in(simulation: Simulation) -> BuiltinAutopilot:
    assert simulation.autopilot.internals is not None
    return simulation.autopilot.internals


def flown(simulation: Simulation, *, land: bool = False) -> list[bytes]:
    """Fly north in offboard, or land; return all that is known of every tick, and the images."""
    autopilot = built_in(simulation)
    images: list[Frame] = []
    seen: list[bytes] = []
    if land:
        autopilot.set_mode(Mode.LAND)
    for tick in range(TICKS):
        if tick % 10 == 0 and not land:
            autopilot.offer_setpoint(velocity_setpoint(1.0, 0.2, 0.0), simulation.time_us)
            autopilot.set_mode(Mode.OFFBOARD)
        simulation.tick()
        state = autopilot.state()
        seen += [simulation.plant.motion.tobytes(), state.accel.tobytes(), state.mag.tobytes()]
        seen += [each.tobytes() for each in state.estimate if isinstance(each, np.ndarray)]
        seen += [repr((state.status, state.battery, state.motors, state.health)).encode()]
        simulation.capture_due(simulation.time_us, images.append)
    seen += [frame.image.tobytes() for frame in images]
    return seen + [array.tobytes() for array in simulation.arrays().values()]


@pytest.mark.parametrize("plant", PLANTS)
def test_a_restored_simulation_flies_on_bit_identically(held: ExitStack, plant: str) -> None:
    faults = (
        Fault.model_validate("motor1 weak 10% at 1s"),
        Fault.model_validate("baro noise 3"),
    )
    wind = WindSettings(north_m_s=2.0, gust_m_s=1.0)
    simulation = hovering(held, plant=plant, wind=wind, faults=faults)
    snapshot = Snapshot(simulation)
    went_on = flown(simulation)
    one = held.enter_context(closing(snapshot.restore()))
    assert flown(one) == went_on
    assert one.autopilot.flight.mode is Mode.OFFBOARD
    other = held.enter_context(closing(snapshot.restore()))
    assert flown(other, land=True) != went_on
    assert flown(held.enter_context(closing(snapshot.restore()))) == went_on


@pytest.mark.parametrize("plant", PLANTS)
def test_contacts_are_restored(held: ExitStack, plant: str) -> None:
    simulation = hovering(held, plant=plant)
    built_in(simulation).set_mode(Mode.LAND)
    while not simulation.plant.body.touch.pressed:
        simulation.tick()
    snapshot = Snapshot(simulation)
    went_on = flown(simulation, land=True)
    assert simulation.autopilot.flight.phase < FlightPhase.AIR
    assert flown(held.enter_context(closing(snapshot.restore())), land=True) == went_on


@pytest.mark.parametrize("vehicle", ["quad-flow", "quad-lidar", "quad-vio"])
def test_optional_sensors_are_restored(held: ExitStack, vehicle: str) -> None:
    simulation = hovering(held, vehicle, plant="kernel")
    snapshot = Snapshot(simulation)
    went_on = flown(simulation)
    assert flown(held.enter_context(closing(snapshot.restore()))) == went_on


def test_a_snapshot_changes_nothing_and_keeps_the_time(held: ExitStack) -> None:
    with ExitStack() as undisturbed:
        expected = flown(hovering(undisturbed, plant="kernel"))
    simulation = hovering(held, plant="kernel")
    texts: list[Any] = []
    simulation.autopilot.on_message = texts.append
    snapshot = Snapshot(simulation)
    begin_us = simulation.time_us
    assert flown(simulation) == expected
    restored = held.enter_context(closing(snapshot.restore()))
    assert (restored.start_us, restored.time_us) == (begin_us, begin_us)
    built_in(simulation).set_mode(Mode.LAND)
    assert restored.autopilot.flight.mode is Mode.HOLD
    assert simulation.time_us - begin_us == TICKS * US_PER_S // 250


def test_a_linked_flight_has_no_snapshot() -> None:
    with LockstepStage() as stage:
        stage.firmware.load(EpisodeSetup(load_vehicle("quad"), None, 1), None, 0)
        assert stage.firmware.simulation is not None
        with pytest.raises(ValueError, match="without links and logs"):
            Snapshot(stage.firmware.simulation)

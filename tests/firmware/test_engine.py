"""Compiled ticks fly what ticks in Python fly, however many of them are flown at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.control.demand import AttitudeDemand
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Setpoint
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.failsafes.watch import Watch
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import PositionYaw, Reposition
from firmware_sim.engine.record import FLOWN_TICK, TRUE_TICK, Record
from firmware_sim.mavlink.codec import message_id
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import ONBOARD_HZ, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.telemetry import FIELDS, NUMBERS
from firmware_sim.plant.plant import Plant
from firmware_sim.simulation import EpisodeSetup, Simulation

STEP_US = 100_000
"""Request period [µs]."""

UNALIGNED_US = 68_000
"""Request period that is not aligned with the failsafe checks [µs]."""

NAN3 = np.full(3, math.nan)


def new_simulation(seed: int = 1) -> Simulation:
    vehicle = load_vehicle("quad")
    spec = load_profile("arenas", "crowded", ArenaSpec)
    arena = generate(spec, seed, name="crowded", vehicle_width_m=vehicle.body.width_m)
    gusts = {"north_m_s": 1.0, "gust_m_s": 1.0}
    setup = EpisodeSetup(vehicle, arena, seed, Aircraft.model_validate({"wind": gusts}))
    return Simulation(setup, start_us=0, clock=SimClock())


def flown(simulation: Simulation, fly: Callable[[Simulation, int], None]) -> tuple[Record, Record]:
    """Take off, fly by setpoints, land; return the logs of all ticks."""
    truths, logs = [], []
    autopilot = simulation.autopilot.internals
    assert autopilot is not None
    for step in range(240):
        at_us = step * STEP_US
        if step == 20:
            assert autopilot.arm(force=False) == 0
            autopilot.takeoff(2.5)
        if 100 <= step < 130:
            velocity = np.array([1.0, 0.5 * math.sin(step), 0.0])
            autopilot.offer_setpoint(Setpoint(NAN3, velocity, math.nan, 0.2), simulation.time_us)
        if step == 100:
            assert autopilot.set_mode(Mode.OFFBOARD) == 0
        if step == 130:
            assert autopilot.set_mode(Mode.LAND) == 0
        while simulation.time_us < at_us + STEP_US:
            fly(simulation, at_us + STEP_US)
            truths.append(simulation.truths.copy())
            logs.append(simulation.flown.copy())
    assert autopilot.flight.phase is FlightPhase.STANDBY
    return np.concatenate(truths), np.concatenate(logs)


def in_one_go(simulation: Simulation, until_us: int) -> None:
    simulation.advance(until_us)


def tick_by_tick(simulation: Simulation, _until_us: int) -> None:
    simulation.tick()


@pytest.fixture(scope="module")
def logs() -> Iterator[tuple[Record, Record]]:
    with closing(new_simulation()) as simulation:
        yield flown(simulation, in_one_go)


def test_every_tick_is_logged_once(logs: tuple[Record, Record]) -> None:
    truths, ticks = logs
    assert truths.dtype == TRUE_TICK
    assert ticks.dtype == FLOWN_TICK
    assert (np.diff(truths["time_us"]) == TICK_US).all()
    assert (truths["time_us"] == ticks["time_us"] + TICK_US).all()


def test_how_many_ticks_are_flown_at_a_time_changes_no_bit(logs: tuple[Record, Record]) -> None:
    with closing(new_simulation()) as simulation:
        one_by_one = flown(simulation, tick_by_tick)
    for together, single in zip(logs, one_by_one, strict=True):
        assert together.tobytes() == single.tobytes()


def test_python_flies_the_same_to_rounding(
    logs: tuple[Record, Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ticks whose parts are called from Python, as where sensors fail or vision is fused."""
    monkeypatch.setattr(Plant, "compiled", False)
    with closing(new_simulation()) as simulation:
        truths, ticks = flown(simulation, tick_by_tick)
    np.testing.assert_allclose(truths["motion"], logs[0]["motion"], atol=1e-5)
    np.testing.assert_allclose(truths["charge"], logs[0]["charge"], atol=1e-9)
    np.testing.assert_allclose(ticks["state"][:, :20], logs[1]["state"][:, :20], atol=1e-5)


def eventful(simulation: Simulation) -> tuple[bytes, list[tuple[int, str]]]:
    """Fly with a lost ground station, setpoints of two kinds, silence and a low battery.

    Returns the log of the flight controller, and the texts with their times.
    """
    ticks, texts = [], []
    autopilot = simulation.autopilot.internals
    assert autopilot is not None
    for step in range(340):
        end_us = (step + 1) * UNALIGNED_US
        while simulation.time_us < end_us:
            simulation.advance(end_us)
            ticks.append(simulation.flown.tobytes())
            texts += [(simulation.time_us, each.text) for each in autopilot.take_messages()]
            autopilot.take_events()
        now_us = simulation.time_us
        if step < 85 or step > 260:
            autopilot.gcs_heartbeat(now_us)
        if step == 28:
            assert autopilot.arm(force=False) == 0
            autopilot.takeoff(2.5)
        if 140 <= step < 215 and step % 10 == 0:
            velocity = np.array([0.5 * math.sin(step), 0.5, 0.0])
            autopilot.offer_setpoint(Setpoint(NAN3, velocity, math.nan, 0.2), now_us)
        elif 140 <= step < 215 and step % 10 == 5:
            level = AttitudeDemand((1.0, 0.0, 0.0, 0.0), 0.1, 0.5)
            autopilot.offer_attitude(level, now_us)
        if step == 143:
            assert autopilot.set_mode(Mode.OFFBOARD) == 0
        if step == 200:
            simulation.plant.battery_remaining = 0.12
    return b"".join(ticks), texts


def test_what_finds_nothing_new_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looks of the failsafes that are compiled, and setpoints that are followed without them."""
    with closing(new_simulation()) as simulation:
        ticks, texts = eventful(simulation)
    asked = []

    def judge_all(watch: Watch, now_us: int) -> bool:
        asked.append(now_us)
        return False

    monkeypatch.setattr(Watch, "is_unchanged", judge_all)
    monkeypatch.setattr(BuiltinAutopilot, "_follow", lambda _: False)
    with closing(new_simulation()) as simulation:
        assert (ticks, texts) == eventful(simulation)
    assert len(asked) > 50
    told = " ".join(text for _, text in texts)
    for word in ("Connection to ground station lost", "GCS connection regained", "battery"):
        assert word in told, texts


def test_telemetry_does_not_depend_on_it_either() -> None:
    """Compare the fast streams; the others are sent after the newest tick."""
    fast = {kind: name for name, kind in _ids().items()}
    sent = []
    for fly in (in_one_go, tick_by_tick):
        endpoint, frames = MemoryEndpoint(), []
        with closing(new_simulation()) as simulation:
            autopilot = simulation.autopilot.internals
            assert autopilot is not None
            server = MavlinkServer([onboard_link(endpoint)], autopilot, boot_unix_us=0)
            simulation.tick()
            server.send(simulation.time_us, simulation.flown)
            while simulation.time_us < TICK_US + 3_000_000:  # where stretches end
                fly(simulation, simulation.time_us + STEP_US)
                server.send(simulation.time_us, simulation.flown)
                frames += endpoint.take()
        payloads: dict[str, list[bytes]] = {name: [] for name in NUMBERS}
        for frame in frames:
            name = fast.get(int.from_bytes(frame[7:10], "little"))
            if name is not None:
                payloads[name].append(frame[10:-2])
        sent.append(payloads)
    assert sent[0] == sent[1]
    for name in FIELDS:
        count = len(sent[0][name])
        if "POSITION" not in name:  # those are sent once the position, or a goal, is known
            assert abs(count - 3.0 * ONBOARD_HZ[name]) <= 1.0, name


def _ids() -> dict[str, int]:
    return {name: message_id(name) for name in NUMBERS}


def test_room_never_exceeds_the_distance_to_what_is_hit() -> None:
    """Thrown at walls and obstacles, the vehicle touches none before its room is used up."""
    with closing(new_simulation(3)) as simulation:
        plant, rng = simulation.plant, np.random.default_rng(0)
        for _ in range(20):
            heading = rng.uniform(-math.pi, math.pi)
            ahead = (8.0 * math.cos(heading), 8.0 * math.sin(heading), -2.0)
            plant.put((0.0, 0.0, -2.5), ahead)
            before = len(plant.collisions)
            for _ in range(700):
                clear = plant._measure_room()
                plant._move((0.0, 0.0, 0.0, 0.0), np.zeros(3))
                if len(plant.collisions) > before or plant._touching:
                    assert not clear
                    break
            assert plant._touching


def fly_to(simulation: Simulation, end_us: int) -> None:
    while simulation.time_us < end_us:
        simulation.advance(end_us)


def test_a_reposition_takes_off() -> None:
    simulation = new_simulation()
    autopilot = simulation.autopilot.internals
    assert autopilot is not None
    fly_to(simulation, 5_000_000)
    north, east = simulation.truth.position[:2].tolist()
    above = Reposition(PositionYaw((north, east, -5.0), math.nan))
    # As in PX4, a disarmed vehicle does not take off later.
    assert autopilot.set_mode(Mode.HOLD, above) == 0
    assert autopilot.arm(force=False) == 0
    fly_to(simulation, 8_000_000)
    assert simulation.truth.position[2] > -0.5
    assert autopilot.set_mode(Mode.HOLD, above) == 0
    fly_to(simulation, 20_000_000)
    assert abs(simulation.truth.position[2] + 5.0) < 0.5


def test_a_position_setpoint_takes_off() -> None:
    simulation = new_simulation()
    autopilot = simulation.autopilot.internals
    assert autopilot is not None
    fly_to(simulation, 5_000_000)
    north, east = simulation.truth.position[:2].tolist()
    assert autopilot.arm(force=False) == 0
    for step in range(120):
        above = np.array([north, east, -3.0])
        autopilot.offer_setpoint(Setpoint(above, NAN3, 0.0, math.nan), simulation.time_us)
        if step == 0:
            assert autopilot.set_mode(Mode.OFFBOARD) == 0
        fly_to(simulation, simulation.time_us + STEP_US)
    assert simulation.truth.position[2] < -2.0

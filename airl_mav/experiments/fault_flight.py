"""One flight of the fault matrix: a scripted pilot on plant and autopilot, in simulated time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.frames import local_to_geodetic
from airl_mav.faults.catalogue import End
from airl_mav.faults.kinds import Phase
from airl_mav.faults.model import Fault
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Mode, Result, Setpoint
from firmware_sim.autopilot.commander import Phase as Commander
from firmware_sim.autopilot.navigation.plan import Frame, Kind, NavCommand, PlanItem
from firmware_sim.crash_detector import TOUCHDOWN_M_S
from firmware_sim.simulation import EpisodeSetup, Simulation, builtin_autopilot

AFTER_S = 0.5
"""A fault begins so long after its phase [s]."""

ALTITUDE_M = 5.0
FENCE_M = 100.0
"""Further from home, or higher, is flown away [m]."""

LONGEST_S = 75.0
OPERATOR_S = 10.0
"""So long after the flight controller has taken over, an operator commands to land [s]."""

_REPEAT_US = 50_000
_LOOK_TICKS = 25
"""Numbers are looked at so often."""


@dataclass(frozen=True)
class FaultFlight:
    """How a flight with a fault went."""

    fault: str
    phase: Phase
    seed: int
    end: End
    touchdown_m_s: float | None
    """Fastest contact with the floor; None: there was none."""
    farthest_m: float
    """Greatest distance from home."""
    mode: str
    """What was flown last."""
    said: tuple[str, ...]
    """Texts for the operator after the fault had begun."""


def fly_fault(vehicle: VehicleProfile, fault: str, phase: Phase, seed: int) -> FaultFlight:
    """Fly to 5 m, hold, fly north in offboard or by a mission, land; something fails on the way.

    The same arguments give the same flight. Arming is asked for; the flight controller's own
    decisions stand: a pilot who sees another mode than the one asked for leaves it alone, and
    commands to land after `OPERATOR_S`. The plant is the compiled one: there is nothing to hit but
    the floor, and a whole matrix takes four fifths of the time that it takes on pybullet.

    Args:
        vehicle: What flies, on an endless floor.
        fault: In words, without a time.
        phase: When it begins.
        seed: Of sensors, wind and the fault.
    """
    words = Fault.model_validate(fault).model_copy(update={"phase": phase, "at_s": AFTER_S})
    setup = EpisodeSetup(vehicle, None, seed, Aircraft(faults=(words,), plant="kernel"))
    autopilot = builtin_autopilot(setup)
    if (origin := vehicle.told_origin) is not None:
        autopilot.set_origin(origin)
    simulation = Simulation(
        setup, start_us=0, clock=SimClock(), recording=False, autopilot=autopilot
    )
    try:
        return _Flight(simulation, autopilot, fault, phase, seed).fly()
    finally:
        simulation.close()


class _Flight:
    """The parts of one flight."""

    def __init__(
        self,
        simulation: Simulation,
        autopilot: BuiltinAutopilot,
        fault: str,
        phase: Phase,
        seed: int,
    ) -> None:
        self._simulation, self._autopilot = simulation, autopilot
        self._told = fault, phase, seed
        self._said: list[str] = []
        self._streams = False
        self._farthest_m = 0.0
        self._touchdowns: list[float] = []
        self._ticks = 0
        self._autopilot.on_message = lambda message: self._hear(message.text)

    def _hear(self, text: str) -> None:
        faults = self._simulation.faults
        if faults is not None and faults.acted(self._simulation.time_us):
            self._said.append(text)

    def fly(self) -> FaultFlight:
        simulation = self._simulation
        pilot, end = self._pilot(), None
        while end is None and simulation.time_us < LONGEST_S * US_PER_S:
            try:
                end = next(pilot, None) or self._tick()
            except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError) as error:
                self._said.append(f"{type(error).__name__}: {error}")
                end = "broken"
        fault, phase, seed = self._told
        return FaultFlight(
            fault,
            phase,
            seed,
            end or "flying",
            max(self._touchdowns, default=None),
            round(self._farthest_m, 3),
            Mode(self._autopilot.flight.mode).name,
            tuple(dict.fromkeys(self._said)),
        )

    def _tick(self) -> End | None:
        """Fly a tick; return the end where this is one."""
        simulation, flight = self._simulation, self._autopilot.flight
        if self._streams and simulation.time_us % _REPEAT_US < TICK_US:
            self._offer()
        flown = flight.phase is Commander.AIR
        simulation.tick()
        self._ticks += 1
        if self._ticks % _LOOK_TICKS == 0 and not (
            np.isfinite(simulation.plant.motion).all()
            and np.isfinite(self._autopilot.estimator.state).all()
        ):
            return "broken"
        distance_m = math.dist((0.0, 0.0, 0.0), simulation.plant.position)
        self._farthest_m = max(self._farthest_m, distance_m)
        if distance_m > FENCE_M:
            return "flown away"
        for hit in simulation.plant.collisions:  # those of this tick: nothing is recorded
            self._touchdowns.append(hit.speed_m_s)
            if hit.speed_m_s >= TOUCHDOWN_M_S and flown:
                return "crashed"
        return None

    def _offer(self) -> None:
        """Give an offboard setpoint: to the north."""
        north = np.array([2.0, 0.0, 0.0])
        setpoint = Setpoint(np.full(3, math.nan), north, 0.0, math.nan)
        self._autopilot.offer_setpoint(setpoint, self._simulation.time_us)

    def _waypoint(self) -> PlanItem:
        """Return a mission item: farther to the north than is flown."""
        origin = self._autopilot.estimator.origin
        if origin is None:
            raise ValueError("a mission without a position")
        place = local_to_geodetic(np.array([FENCE_M, 0.0, 0.0]), origin)
        return PlanItem(
            NavCommand.WAYPOINT,
            Frame.GLOBAL_RELATIVE_ALT_INT,
            (0.0, 0.0, 0.0, math.nan),
            place.latitude_deg,
            place.longitude_deg,
            ALTITUDE_M,
        )

    def _pilot(self) -> Iterator[End | None]:
        """Say what a pilot does, a tick at a time; yield the end where that is known."""
        autopilot = self._autopilot
        while autopilot.flight.phase is Commander.BOOT:
            if self._simulation.time_us > 20 * US_PER_S:
                yield "not armed"
            yield None
        yield from self._wait(2.0)
        for _ in range(5):
            if autopilot.arm(force=False) is Result.ACCEPTED:
                break
            yield from self._wait(1.0)
        else:
            yield "not armed"
        autopilot.takeoff(ALTITUDE_M)
        yield from self._fly_as(Mode.TAKEOFF, 30.0, until=Mode.HOLD)
        yield from self._fly_as(Mode.HOLD, 2.0)
        north = Mode.MISSION if self._told[1] == "mission" else Mode.OFFBOARD
        if autopilot.flight.mode is Mode.HOLD:
            if north is Mode.MISSION:
                autopilot.plans.store(Kind.MISSION, (self._waypoint(),), 1, 0)
            else:
                self._streams = True
                self._offer()
                yield None
            autopilot.set_mode(north)
        yield from self._fly_as(north, 3.0)
        self._streams = False
        if autopilot.flight.mode is north:
            autopilot.set_mode(Mode.LAND)
        else:
            yield from self._until_down(OPERATOR_S)
            autopilot.set_mode(Mode.LAND)
        yield from self._until_down(LONGEST_S)

    def _fly_as(
        self, mode: Mode, limit_s: float, until: Mode | None = None
    ) -> Iterator[End | None]:
        """Wait while a mode is flown, at most so long."""
        end_us = self._simulation.time_us + limit_s * US_PER_S
        flight = self._autopilot
        while flight.flight.mode is mode and self._simulation.time_us < end_us:
            if flight.flight.phase < Commander.GROUND:
                yield "landed"
            yield None
        if until is not None and flight.flight.mode is mode:
            flight.set_mode(until)

    def _until_down(self, limit_s: float) -> Iterator[End | None]:
        """Wait until the motors are off, at most so long."""
        end_us = self._simulation.time_us + limit_s * US_PER_S
        while self._simulation.time_us < end_us:
            if self._autopilot.flight.phase < Commander.GROUND:
                yield "landed" if self._simulation.plant.position[2] > -0.5 else "crashed"
            yield None

    def _wait(self, seconds: float) -> Iterator[None]:
        for _ in range(round(seconds * US_PER_S / TICK_US)):
            yield None

"""Flights in simulated time for the tests: plant and autopilot, no MAVLink, no wall clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile, WindSettings
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.addons.auxiliary_estimation.auxiliary_aids import AuxiliaryAids
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Result, Setpoint
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.interfaces import ActuatorControls, SensorSample, TrueState
from firmware_sim.simulation import EpisodeSetup, Simulation

SETPOINT_US = 50_000
"""MAVSDK repeats its setpoint at 20 Hz."""

LOOK_US = 20_000
"""Polling interval of a flight that waits for a condition."""

CALM = WindSettings()
NAN = math.nan


@cache
def _shipped() -> VehicleProfile:
    return load_profile("vehicles", "quad", VehicleProfile)


def quad(**changes: Any) -> VehicleProfile:
    """Return the shipped vehicle, parts of it replaced: `quad(battery={"capacity_mah": 50.0})`."""
    data = _shipped().model_dump()
    for part, values in changes.items():
        data[part] = {**data[part], **values}
    return VehicleProfile.model_validate(data)


def velocity_setpoint(
    north: float, east: float, down: float, *, yaw: float = 0.0, yaw_rate: float = NAN
) -> Setpoint:
    """Return what MAVSDK's set_velocity_ned sends; with a yaw rate pass yaw=NaN."""
    return Setpoint(np.full(3, NAN), np.array([north, east, down]), yaw, yaw_rate)


class Rig:
    """One simulated flight under test."""

    def __init__(
        self,
        seed: int = 0,
        *,
        arena: Arena | None = None,
        wind: WindSettings = CALM,
        vehicle: VehicleProfile | None = None,
        parameters: dict[str, float] | None = None,
        faults: tuple[str, ...] = (),
    ) -> None:
        vehicle = vehicle or quad()
        merged = {**vehicle.parameters, **(parameters or {})}
        vehicle = vehicle.model_copy(update={"parameters": merged})
        asked = Aircraft.model_validate({"wind": wind, "faults": faults})
        self.sim = Simulation(
            EpisodeSetup(vehicle, arena, seed, asked), start_us=0, clock=SimClock()
        )
        self.texts: list[tuple[int, str]] = []
        """Time [µs] and text of every message until now."""
        assert isinstance(self.sim.autopilot, BuiltinAutopilot)
        self.ap = self.sim.autopilot
        self.ap.on_message = lambda m: self.texts.append((self.sim.time_us, m.text))
        self._setpoint: Setpoint | None = None
        self._next_us = 0

    @property
    def time_s(self) -> float:
        return self.sim.time_us / US_PER_S

    @property
    def truth(self) -> TrueState:
        return self.sim.truth

    @property
    def height(self) -> float:
        """True height of the body's underside above the floor [m]."""
        return -float(self.truth.position[2]) - 0.5 * _shipped().body.height_m

    @property
    def mode(self) -> Mode:
        return self.ap.flight.mode

    def stream(self, setpoint: Setpoint | None) -> None:
        """Offer a setpoint now and at 20 Hz from now on; None = fall silent."""
        self._setpoint, self._next_us = setpoint, self.sim.time_us

    def tick(self) -> None:
        self._advance(self.sim.time_us)

    def _advance(self, until_us: float) -> None:
        """Fly a tick, and further ticks until an event, a due setpoint or `until_us`.

        Compiled ticks cost a fraction of ticks in Python, and fly the same.
        """
        if self._setpoint is not None:
            if self.sim.time_us >= self._next_us:
                self.ap.offer_setpoint(self._setpoint, self.sim.time_us)
                self._next_us += SETPOINT_US
            until_us = min(until_us, self._next_us)
        self.sim.advance(until_us)

    def step_through(self, step: Callable[[SensorSample], ActuatorControls]) -> None:
        """Let the autopilot be stepped by this from now on, as a test that listens in does."""
        self.ap.step = step  # type: ignore[method-assign, assignment]  # a test listens in
        self.sim._fly = step

    def run(self, seconds: float, each: Callable[[], None] | None = None) -> None:
        """Fly on for some time, calling `each` after every tick."""
        end_us = self.sim.time_us + round(seconds * US_PER_S / TICK_US) * TICK_US
        while self.sim.time_us < end_us:
            self._advance(end_us if each is None else self.sim.time_us)
            if each is not None:
                each()

    def until(self, reached: Callable[[], bool], limit_s: float) -> float:
        """Fly until `reached` returns True; return the time [s] it took. Fails after `limit_s`.

        Conditions without an event are detected up to `LOOK_US` late.
        """
        began = self.sim.time_us
        while not reached():
            if self.sim.time_us - began > limit_s * US_PER_S:
                raise AssertionError(f"not within {limit_s} s; said: {self.texts}")
            self._advance(self.sim.time_us + LOOK_US)
        return (self.sim.time_us - began) / US_PER_S

    def said(self, text: str) -> float:
        """Return the time [s] of the last message with a text; NaN without one."""
        return max((t / US_PER_S for t, said in self.texts if text in said), default=NAN)

    def boot(self) -> None:
        """Wait until the vehicle may be armed."""
        self.until(lambda: self.ap.flight.phase > 0, 30.0)

    def arm(self) -> None:
        self.boot()
        assert self.ap.arm(force=False) is Result.ACCEPTED

    def take_off(self, altitude_m: float = 5.0, settle_s: float = 4.0) -> None:
        """Arm, climb and come to rest in hold."""
        self.arm()
        assert self.ap.takeoff(altitude_m) is Result.ACCEPTED
        self.until(lambda: self.mode is Mode.HOLD, 60.0)
        # Hold climbs the rest: PX4's take-off is over within NAV_MC_ALT_RAD of its altitude.
        self.until(lambda: self.height > altitude_m - 0.35, 20.0)
        self.run(settle_s)

    def go_offboard(self, setpoint: Setpoint) -> None:
        self.stream(setpoint)
        self.tick()
        assert self.ap.set_mode(Mode.OFFBOARD) is Result.ACCEPTED

    def close(self) -> None:
        self.sim.close()


def aids_of(rig: Rig) -> AuxiliaryAids:
    """Return the fusion of vision, ranges and flow in a rig's autopilot."""
    aiding = rig.ap.estimator.aiding
    assert isinstance(aiding, AuxiliaryAids)
    return aiding


@contextmanager
def flight(seed: int = 0, **settings: Any) -> Iterator[Rig]:
    """Make a Rig and release it afterwards."""
    rig = Rig(seed, **settings)
    try:
        yield rig
    finally:
        rig.close()

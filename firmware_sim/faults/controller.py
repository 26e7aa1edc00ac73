"""A flight controller behind failing sensors and motors: there only where faults are asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.faults.kinds import MOTORS, SENSORS
from airl_mav.faults.schedule import gust_share
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import Airframe
from firmware_sim.engine.dynamics import Speeds
from firmware_sim.faults.actuation import misread, slowed, slowness, thrust_left, weakened
from firmware_sim.faults.sensors import Effect, effect_of, failed
from firmware_sim.faults.timeline import Acting, FaultTimeline
from firmware_sim.flight_controller import FlightController
from firmware_sim.interfaces import ActuatorControls, SensorSample
from firmware_sim.plant.plant import Blowing, Plant


def gust_at(acting: Sequence[Acting], time_us: int) -> Vector:
    """Return the wind (3,) NED [m/s] that faults add at a time [µs]."""
    total = np.zeros(3)
    for each in acting:
        share = 1.0
        if each.fault.kind == "gust":
            elapsed_us, whole_us = time_us - each.since_us, each.until_us - each.since_us
            share = gust_share(elapsed_us / US_PER_S, whole_us / US_PER_S)
        total += share * np.array(each.fault.value)
    return total


class Gusts:
    """A wind, and what faults add to it."""

    def __init__(self, wind: Blowing) -> None:
        """Take the wind that blows anyway."""
        self.more: Vector | None = None
        """(3,) NED [m/s], set for the tick that comes; None: nothing."""
        self._wind = wind

    def step(self) -> Vector:
        """Advance one tick and return the wind (3,) NED [m/s]."""
        wind = self._wind.step()
        return wind if self.more is None else wind + self.more


class FailingParts:
    """Failing parts between the plant and the flight controller.

    It works on any flight controller: the built-in one, or real firmware behind its simulator
    interface.
    """

    def __init__(
        self,
        controller: FlightController,
        plant: Plant,
        vehicle: VehicleProfile,
        timeline: FaultTimeline,
    ) -> None:
        """Put it between controller and plant; nothing fails yet.

        Gusts are added to the plant's wind, and its charge drops. The profile has the noise of the
        sensors, the battery, and the motors' curve.
        """
        self._controller = controller
        self._plant = plant
        self._vehicle = vehicle
        self._curve = Airframe.from_profile(vehicle).thrust_curve
        self._tick_s = 1.0 / controller.rate_hz
        self._timeline = timeline
        self._memories: dict[int, Effect] = {}
        self._effects: list[tuple[str, Effect]] = []
        self._battery: list[Acting] = []
        self._left: dict[int, float] = {}
        self._slow: dict[int, float] = {}
        self._turning: Speeds | None = None
        """What the motors were last told in effect; None: what the flight controller told them."""
        self._gusts = Gusts(plant.wind)
        plant.wind = self._gusts
        self._wind: list[Acting] = []
        self._dropped: set[int] = set()
        timeline.on_change(self._rearrange)

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Advance the flight controller by what it is let to measure; return what motors do."""
        self._timeline.update(sample.time_us, self._controller.flight)
        if self._effects:
            sample = failed(sample, self._effects)
        if self._battery:
            reading = misread(sample.battery, self._battery, self._vehicle.battery)
            sample = sample._replace(battery=reading)
        if self._wind:
            self._gusts.more = gust_at(self._wind, sample.time_us)
        if self._turning is not None:
            sample = sample._replace(esc_outputs=self._turning)
        controls = self._controller.step(sample)
        if not (self._left or self._slow):
            self._turning = None
            return controls
        if self._left:
            controls = weakened(controls, self._left, self._curve)
        if self._slow:
            plant = self._plant
            controls = slowed(
                controls, self._slow, plant.rotor_speeds, plant.rotor_lag, self._curve
            )
        self._turning = controls.motors
        return controls

    def _rearrange(self) -> None:
        timeline, before = self._timeline, self._memories
        sensors = timeline.acting(*SENSORS)
        self._memories = {
            each.number: before.get(each.number) or self._effect_of(each) for each in sensors
        }
        self._effects = [(each.fault.part, self._memories[each.number]) for each in sensors]
        motors = timeline.acting(*MOTORS)
        self._left, self._slow = thrust_left(motors), slowness(motors)
        battery = timeline.acting("battery")
        for each in battery:
            if each.fault.kind == "drop" and each.number not in self._dropped:
                self._dropped.add(each.number)
                left = self._plant.battery_remaining - each.fault.amount
                self._plant.battery_remaining = max(0.0, left)
        self._battery = [each for each in battery if each.fault.kind != "drop"]
        self._wind = timeline.acting("wind")
        if not self._wind:
            self._gusts.more = None

    def _effect_of(self, acting: Acting) -> Effect:
        rng = self._timeline.generator(acting.number)
        return effect_of(acting, self._vehicle.sensors, self._tick_s, rng)

"""The plant: a body with rotors, drag, battery and sensors, in an arena."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import TICK_HZ, US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.streams import sensors_and_gusts
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.power import PowerModel, standing_power_w
from airl_mav.vehicle.rotation import Quat, Vec
from airl_mav.vehicle.rotor import lag
from airl_mav.vehicle.wind import Wind
from firmware_sim.interfaces import ActuatorControls, BatterySample, SensorSample, Truth
from firmware_sim.plant.bodies import new_body
from firmware_sim.plant.body import FLOOR, Body, Touch
from firmware_sim.plant.dynamics import (
    Speeds,
    absorb,
    actuate,
    pack_row,
    supply,
)
from firmware_sim.plant.kinematics import POSITION, QUATERNION, RATES, VELOCITY
from firmware_sim.plant.optical_flow import PlantOpticalFlow
from firmware_sim.plant.rangefinder import PlantRangefinder
from firmware_sim.plant.sensors import SensorSuite

REST_SPEED_M_S = 0.1
"""Touching the floor slower than this is resting, no collision (AirSim's kRestingVelocityMax)."""

STOPPED: Speeds = (0.0, 0.0, 0.0, 0.0)


class Blowing(Protocol):
    """Where the wind comes from; `vehicle.wind.Wind` is one."""

    def step(self) -> Vector:
        """Advance one tick and return the wind (3,) NED [m/s]; not to be written to."""
        ...


class Collision(NamedTuple):
    """The vehicle began to touch something; the floor only when faster than REST_SPEED_M_S."""

    time_us: int
    what: str
    speed_m_s: float
    """Speed just before the contact."""


class Plant:
    """The vehicle in its arena. Time starts at the clock value given and moves by ticks."""

    def __init__(
        self,
        profile: VehicleProfile,
        arena: Arena | None,
        rng: np.random.Generator,
        *,
        start_us: int = 0,
        aircraft: Aircraft | None = None,
        airframe: Airframe | None = None,
        rate_hz: int = TICK_HZ,
        computer_w: float = 0.0,
    ) -> None:
        """Put the vehicle at rest on the floor at the start, facing north.

        Args:
            profile: The vehicle.
            arena: Where; None = an endless floor.
            rng: All randomness of sensors and wind.
            start_us: Simulated time of the first state [µs].
            aircraft: What was asked of it: wind as `wind_of_episode` returns it, sensors, charge of
                the battery, which body; None = the defaults.
            airframe: This vehicle's own; None = that of the profile.
            rate_hz: Ticks a second.
            computer_w: What the onboard computer draws from the pack [W].
        """
        tick_s = 1.0 / rate_hz
        asked = aircraft or Aircraft()
        self.collisions: list[Collision] = []
        """Latched collision events, oldest first."""
        airframe = airframe or Airframe.from_profile(profile)
        noise, gusts = sensors_and_gusts(rng)
        self._sensors = SensorSuite(profile.sensors, noise, tick_s, asked.sensors.navigation_noise)
        self.wind: Blowing = Wind(asked.wind, gusts, tick_s)
        """Asked once a tick for what blows; to be replaced between two ticks."""
        fitted, times = profile.sensors.rangefinder, asked.sensors.navigation_noise
        self._rangefinder = None
        if fitted is not None:
            # A further child: the streams of the other sensors stay what they are.
            self._rangefinder = PlantRangefinder(fitted, arena, noise.spawn(1)[0], times)
        flow = profile.sensors.optical_flow
        self._flow = None
        if flow is not None:
            self._flow = PlantOpticalFlow(flow, arena, noise.spawn(1)[0], times, tick_s)
        self._start_us = start_us
        self._moves_us = start_us
        """When moving obstacles set out."""
        self.time_us = start_us
        """Simulated time of the newest tick [µs]."""
        self._rate_hz, self._tick_s, self._ticks = rate_hz, tick_s, 0
        # What kernels take, as arrays: names would cost their callers a microsecond each.
        self._airframe = np.array(airframe)
        model = PowerModel.from_profile(profile)
        self._power = np.array(model)
        self._computer_w = computer_w
        self._pack = np.array(pack_row(profile.battery))
        self.rotor_lag = lag(airframe, tick_s)
        """Share of an error of its speed that a rotor keeps over a tick."""
        self._speeds = STOPPED
        self.battery_remaining = asked.battery_charge
        """State of charge, 1 to 0."""
        self.power_w = standing_power_w(0.0, airframe, model)
        """Electrical power over the newest tick, without the onboard computer's [W]."""
        self._felt: Vec = (0.0, 0.0, 0.0)
        self.body: Body = new_body(asked.plant, arena, profile.body, airframe, tick_s)
        """What is moved among the bodies of the arena."""
        self._touching: frozenset[int] = frozenset()
        self.motion = self.body.rest()
        """Motion (16,) as `plant.kinematics`; another array after every tick, not to be changed."""
        load_w = self.power_w + computer_w
        self._battery = BatterySample(*supply(load_w, self.battery_remaining, self._pack))

    def begin(self) -> None:
        """Let what moves set out now; contacts so far are forgotten."""
        self._moves_us = self.time_us
        self.collisions.clear()

    def close(self) -> None:
        """Release what the body holds."""
        self.body.close()

    @property
    def position(self) -> tuple[float, float, float]:
        """Where the vehicle is, NED [m]."""
        at = self.motion.item
        return at(0), at(1), at(2)

    @property
    def rotor_speeds(self) -> Speeds:
        """Speeds of the rotors, as shares of that at full command, in the order of the motors."""
        return self._speeds

    def step(self, controls: ActuatorControls) -> SensorSample:
        """Apply motor commands for one tick and return what the sensors then measure."""
        body, before, wind = self.body, self.motion, self.wind.step()
        # An empty battery turns no motor.
        motors = controls.motors if self.battery_remaining > 0.0 else STOPPED
        speeds, here, force, torque = actuate(
            self._speeds, motors, before, wind, self._airframe, self.rotor_lag
        )
        self._ticks += 1
        # Of the count: not every rate has a period of whole microseconds.
        self.time_us = self._start_us + self._ticks * US_PER_S // self._rate_hz
        self.motion = body.move(here, force, torque, before, self.time_us - self._moves_us)
        if body.touch.close or self._touching:
            self._watch(body.touch, before)
        self.power_w, self._felt, reading, self.battery_remaining = absorb(
            before,
            self.motion,
            wind,
            speeds,
            bool(self._touching),
            self._felt,
            self.battery_remaining,
            self._airframe,
            self._power,
            self._pack,
            self._computer_w,
            self._tick_s,
        )
        self._speeds, self._battery = speeds, BatterySample(*reading)
        return self.sense()

    def sense(self) -> SensorSample:
        """Return a sensor sample of the present state."""
        sample = self._sensors.sample(self.time_us, self.motion, self._battery)
        finder, flow = self._rangefinder, self._flow
        elapsed_us = self.time_us - self._moves_us
        if finder is not None and finder.rate.due(self.time_us):
            sample = sample._replace(distance=finder.read(self.motion, elapsed_us))
        if flow is not None:
            flow.pass_tick(self.motion)
            if flow.rate.due(self.time_us):
                sample = sample._replace(flow=flow.read(self.motion, elapsed_us))
        return sample

    def truth(self) -> Truth:
        """Return the true state."""
        row = self.motion.copy()
        return Truth(
            self.time_us,
            row[POSITION],
            row[VELOCITY],
            row[QUATERNION],
            row[RATES],
            self.power_w,
            self.battery_remaining,
        )

    def put(
        self,
        position: Vec,
        velocity: Vec = (0.0, 0.0, 0.0),
        quaternion: Quat = (1.0, 0.0, 0.0, 0.0),
        rates: Vec = (0.0, 0.0, 0.0),
    ) -> None:
        """Put the vehicle somewhere; what it touched and hit so far is forgotten.

        Args:
            position: NED [m].
            velocity: NED [m/s].
            quaternion: Body -> NED.
            rates: Angular velocity FRD [rad/s].
        """
        self.motion = self.body.put(position, velocity, quaternion, rates)
        self._touching = frozenset()
        self.collisions.clear()

    def _watch(self, touch: Touch, before: Vector) -> None:
        """Latch every new contact; a contact that lasts is one event."""
        # Contacts flicker: one has ended when the bodies are no longer close.
        touching = touch.pressed | (self._touching & touch.close)
        if touching - self._touching:
            speed = math.sqrt(sum(v * v for v in before[VELOCITY].tolist()))
            for other in sorted(touching - self._touching):
                name = self.body.names[other]
                if name != FLOOR or speed > REST_SPEED_M_S:
                    self.collisions.append(Collision(self.time_us, name, speed))
        self._touching = touching

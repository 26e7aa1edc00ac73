"""The plant: a pybullet body with rotors, drag, battery and sensors, in an arena."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import TICK_HZ, US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.streams import sensors_and_gusts
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.power import PowerModel, standing_power_w
from airl_mav.vehicle.rotation import Vec
from airl_mav.vehicle.rotor import lag
from airl_mav.vehicle.wind import Wind
from firmware_sim.interfaces import ActuatorControls, BatterySample, SensorSample, Truth
from firmware_sim.plant.bullet import pybullet
from firmware_sim.plant.dynamics import (
    Speeds,
    absorb,
    actuate,
    pack_row,
    supply,
)
from firmware_sim.plant.kinematics import POSITION, QUATERNION, RATES, VELOCITY, WIDTH, from_bullet
from firmware_sim.plant.sensors import SensorSuite
from firmware_sim.plant.world import FLOOR, World

REST_SPEED_M_S = 0.1
"""Touching the floor slower than this is resting, no collision (AirSim's kRestingVelocityMax)."""

STOPPED: Speeds = (0.0, 0.0, 0.0, 0.0)

_ANY_LINK = -2
"""pybullet's filter of contacts that lets all links pass."""


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
                the battery; None = the defaults.
            airframe: This vehicle's own; None = that of the profile.
            rate_hz: Ticks a second.
            computer_w: What the onboard computer draws from the pack [W].
        """
        tick_s = 1.0 / rate_hz
        asked = aircraft or Aircraft()
        body = profile.body
        diagonal_m = math.hypot(body.width_m, body.width_m, body.height_m)
        self.world = World(arena, 0.5 * diagonal_m, tick_s)
        self.collisions: list[Collision] = []
        """Latched collision events, oldest first."""
        airframe = airframe or Airframe.from_profile(profile)
        noise, gusts = sensors_and_gusts(rng)
        self._sensors = SensorSuite(profile.sensors, noise, tick_s, asked.sensors.navigation_noise)
        self.wind: Blowing = Wind(asked.wind, gusts, tick_s)
        """Asked once a tick for what blows; to be replaced between two ticks."""
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
        self._left = lag(airframe, tick_s)
        self._speeds = STOPPED
        self.battery_remaining = asked.battery_charge
        """State of charge, 1 to 0."""
        self.power_w = standing_power_w(0.0, airframe, model)
        """Electrical power over the newest tick, without the onboard computer's [W]."""
        self._felt: Vec = (0.0, 0.0, 0.0)
        self._body = self._build_body(profile, airframe)
        self._touching: set[int] = set()
        self.motion = self._read()
        """Motion (16,) as `plant.kinematics`; another array after every tick, not to be changed."""
        load_w = self.power_w + computer_w
        self._battery = BatterySample(*supply(load_w, self.battery_remaining, self._pack))

    def begin(self) -> None:
        """Let what moves set out now; contacts so far are forgotten."""
        self._moves_us = self.time_us
        self.collisions.clear()

    def close(self) -> None:
        """Release the physics server."""
        self.world.close()

    @property
    def position(self) -> tuple[float, float, float]:
        """Where the vehicle is, NED [m]."""
        at = self.motion.item
        return at(0), at(1), at(2)

    def step(self, controls: ActuatorControls) -> SensorSample:
        """Apply motor commands for one tick and return what the sensors then measure."""
        world, body, before = self.world, self._body, self.motion
        client, wind = world.number, self.wind.step()
        # An empty battery turns no motor.
        motors = controls.motors if self.battery_remaining > 0.0 else STOPPED
        speeds, here, force, torque = actuate(
            self._speeds, motors, before, wind, self._airframe, self._left
        )
        pybullet.applyExternalForce(body, -1, force, here, pybullet.WORLD_FRAME, client)
        pybullet.applyExternalTorque(body, -1, torque, pybullet.WORLD_FRAME, client)
        self._ticks += 1
        # Of the count: not every rate has a period of whole microseconds.
        self.time_us = self._start_us + self._ticks * US_PER_S // self._rate_hz
        world.move_obstacles(self.time_us - self._moves_us, before)
        pybullet.stepSimulation(client)
        contacts = pybullet.getContactPoints(body, -1, _ANY_LINK, _ANY_LINK, client)
        if contacts or self._touching:
            self._watch(contacts, before)
        at, orientation = pybullet.getBasePositionAndOrientation(body, client)
        linear, angular = pybullet.getBaseVelocity(body, client)
        self.motion = np.empty(WIDTH)
        self.power_w, self._felt, reading, self.battery_remaining = absorb(
            at,
            orientation,
            linear,
            angular,
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
        return self._sensors.sample(self.time_us, self.motion, self._battery)

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

    def _build_body(self, profile: VehicleProfile, airframe: Airframe) -> int:
        client, body = self.world.client, profile.body
        half = (0.5 * body.width_m, 0.5 * body.width_m, 0.5 * body.height_m)
        shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
        number = client.createMultiBody(
            baseMass=airframe.mass,
            baseCollisionShapeIndex=shape,
            basePosition=(0.0, 0.0, half[2]),
            # Facing north: forward = +y of ENU, a quarter turn about up.
            baseOrientation=(0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)),
        )
        client.changeDynamics(
            number,
            -1,
            localInertiaDiagonal=(
                airframe.inertia_xx,
                airframe.inertia_yy,
                airframe.inertia_zz,
            ),
            linearDamping=0.0,
            angularDamping=0.0,
            restitution=0.0,
            lateralFriction=0.8,
            rollingFriction=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        return int(number)

    def _read(self) -> Vector:
        """Return pybullet's state as a row, the vehicle taken to be at rest or in steady flight."""
        client = self.world.number
        at, orientation = pybullet.getBasePositionAndOrientation(self._body, client)
        linear, angular = pybullet.getBaseVelocity(self._body, client)
        row = np.empty(WIDTH)
        from_bullet(at, orientation, linear, angular, (0.0, 0.0, 0.0), row)
        return row

    def _watch(self, contacts: tuple[tuple[Any, ...], ...], before: Vector) -> None:
        """Latch every new contact; a contact that lasts is one event."""
        # Index 2 is body B, index 9 the normal force: 0 = close but not touching. Contacts flicker:
        # one has ended when the bodies are no longer close.
        close = {contact[2] for contact in contacts}
        pressed = {contact[2] for contact in contacts if contact[9] > 0.0}
        touching = pressed | (self._touching & close)
        if touching - self._touching:
            speed = math.sqrt(sum(v * v for v in before[VELOCITY].tolist()))
            for other in sorted(touching - self._touching):
                name = self.world.names[other]
                if name != FLOOR or speed > REST_SPEED_M_S:
                    self.collisions.append(Collision(self.time_us, name, speed))
        self._touching = touching

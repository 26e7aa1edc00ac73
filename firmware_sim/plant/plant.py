"""The plant: a pybullet body with rotors, drag, battery and sensors, in an arena."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.constants import GRAVITY_M_S2, TICK_S, TICK_US
from airl_mav.frames import Vector
from airl_mav.kernels import kernel
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.battery import drain, open_circuit, terminal_voltage
from airl_mav.vehicle.power import coefficients, power_w
from airl_mav.vehicle.rigid_body import drag_force
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate
from airl_mav.vehicle.rotor import spin, wrench
from firmware_sim.interfaces import ActuatorControls, BatterySample, SensorSample
from firmware_sim.plant.bullet import pybullet
from firmware_sim.plant.sensors import Kinematics, SensorSuite
from firmware_sim.plant.wind import Wind, WindSettings
from firmware_sim.plant.world import FLOOR, World

REST_SPEED_M_S = 0.1
"""Touching the floor slower than this is resting, no collision (AirSim's kRestingVelocityMax)."""

IDLE_POWER_W = 5.0
"""Avionics on the ground, motors off [W]."""

Speeds = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Truth:
    """What really is; never shown to the autopilot."""

    time_us: int
    position: Vector  # (3,) NED [m]
    velocity: Vector  # (3,) NED [m/s]
    quaternion: Vector  # (4,) body -> NED
    angular_velocity: Vector  # (3,) FRD [rad/s]
    power_w: float
    battery_remaining: float


@dataclass(frozen=True, slots=True)
class Collision:
    """The vehicle began to touch something; the floor only when faster than REST_SPEED_M_S."""

    time_us: int
    what: str
    speed_m_s: float
    """Speed just before the contact."""


class _Motion:
    """One tick's kinematics in NED / FRD as plain tuples, for the kernels."""

    __slots__ = ("omega", "position", "q", "velocity")

    def __init__(self, position: Vec, velocity: Vec, q: Quat, omega: Vec) -> None:
        self.position, self.velocity, self.q, self.omega = position, velocity, q, omega


@kernel
def _actuate(
    speeds: Speeds, motors: Speeds, q: Quat, velocity: Vec, omega: Vec, wind: Vec, a: Airframe
) -> tuple[Speeds, Vec, Vec]:
    """Return rotor speeds after a tick, force NED [N] without gravity, torque NED [N m]."""
    s = (
        spin(speeds[0], motors[0], a, TICK_S),
        spin(speeds[1], motors[1], a, TICK_S),
        spin(speeds[2], motors[2], a, TICK_S),
        spin(speeds[3], motors[3], a, TICK_S),
    )
    thrust, torque = wrench(s[0], s[1], s[2], s[3], a)
    lift = rotate(q, (0.0, 0.0, -thrust))
    drag = drag_force(velocity, wind, a)
    force = (lift[0] + drag[0], lift[1] + drag[1], lift[2] + drag[2])
    k = a.drag_angular
    damped = (torque[0] - k * omega[0], torque[1] - k * omega[1], torque[2] - k * omega[2])
    return s, force, rotate(q, damped)


@kernel
def _to_ned_frd(orientation: Quat, velocity: Vec, angular: Vec) -> tuple[Quat, Vec, Vec]:
    """Turn pybullet's state (xyzw quaternion, world-frame rates) into NED / FRD, FRD rates.

    The attitude NED <- FRD is (half a turn about (1,1,0)) q_enu_flu (half a turn about x); the
    products are written out.
    """
    x, y, z, w = orientation
    h = math.sqrt(0.5)
    q = (h * (w + z), h * (x + y), h * (x - y), h * (w - z))
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    rates_ned = (angular[1], angular[0], -angular[2])
    return q, (velocity[1], velocity[0], -velocity[2]), rotate(conjugate(q), rates_ned)


class Plant:
    """The vehicle in its arena. Time starts at the clock value given and moves by ticks."""

    def __init__(
        self,
        profile: VehicleProfile,
        arena: Arena | None,
        rng: np.random.Generator,
        *,
        start_us: int = 0,
        wind: WindSettings | None = None,
    ) -> None:
        """Put the vehicle at rest on the floor at the start, facing north.

        Args:
            profile: The vehicle.
            arena: Where; None = an endless floor.
            rng: All randomness of sensors and wind.
            start_us: Simulated time of the first state [µs].
            wind: None = calm.
        """
        self.world = World(arena)
        self.collisions: list[Collision] = []
        """Latched collision events, oldest first."""
        self._profile = profile
        self._airframe = Airframe.from_profile(profile)
        sensor_rng, wind_rng = rng.spawn(2)
        self._sensors = SensorSuite(profile.sensors, sensor_rng)
        self._wind = Wind(wind or WindSettings(), wind_rng)
        self._start_us = start_us
        self._time_us = start_us
        self._speeds: Speeds = (0.0, 0.0, 0.0, 0.0)
        self._remaining = 1.0
        self._power_w = IDLE_POWER_W
        self._coefficients = coefficients(profile.power)
        self._body = self._build_body()
        self._touching: set[int] = set()
        self._motion = self._read()
        self._specific_force = np.array([0.0, 0.0, -GRAVITY_M_S2])
        self._battery = self._battery_sample()

    def close(self) -> None:
        """Release the physics server."""
        self.world.close()

    def step(self, controls: ActuatorControls) -> SensorSample:
        """Apply motor commands for one tick and return what the sensors then measure."""
        client, m = self.world.client, self._motion
        wind_ned = self._wind.step()
        wind = (float(wind_ned[0]), float(wind_ned[1]), float(wind_ned[2]))
        # An empty battery turns no motor.
        motors = controls.motors if self._remaining > 0.0 else (0.0, 0.0, 0.0, 0.0)
        self._speeds, force, torque = _actuate(
            self._speeds, motors, m.q, m.velocity, m.omega, wind, self._airframe
        )
        here = (m.position[1], m.position[0], -m.position[2])
        client.applyExternalForce(
            self._body, -1, (force[1], force[0], -force[2]), here, pybullet.WORLD_FRAME
        )
        client.applyExternalTorque(
            self._body, -1, (torque[1], torque[0], -torque[2]), pybullet.WORLD_FRAME
        )
        self._time_us += TICK_US
        self.world.move_obstacles(self._time_us - self._start_us)
        client.stepSimulation()
        after = self._read()
        before, now = m.velocity, after.velocity
        accel = (
            (now[0] - before[0]) / TICK_S,
            (now[1] - before[1]) / TICK_S,
            (now[2] - before[2]) / TICK_S,
        )
        self._watch_contacts(m.velocity)
        self._use_power(accel, now, wind)
        self._motion = after
        felt = (accel[0], accel[1], accel[2] - GRAVITY_M_S2)
        self._specific_force = np.array(rotate(conjugate(after.q), felt))
        return self.sense()

    def sense(self) -> SensorSample:
        """Return a sensor sample of the present state."""
        m = self._motion
        truth = Kinematics(
            np.array(m.position),
            np.array(m.velocity),
            self._specific_force,
            np.array(m.omega),
            np.array(m.q),
        )
        return self._sensors.sample(self._time_us, truth, self._battery)

    def truth(self) -> Truth:
        """Return the true state."""
        m = self._motion
        return Truth(
            self._time_us,
            np.array(m.position),
            np.array(m.velocity),
            np.array(m.q),
            np.array(m.omega),
            self._power_w,
            self._remaining,
        )

    def _build_body(self) -> int:
        client, body = self.world.client, self._profile.body
        half = (0.5 * body.width_m, 0.5 * body.width_m, 0.5 * body.height_m)
        shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
        number = client.createMultiBody(
            baseMass=body.mass_kg,
            baseCollisionShapeIndex=shape,
            basePosition=(0.0, 0.0, half[2]),
            # Facing north: forward = +y of ENU, a quarter turn about up.
            baseOrientation=(0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)),
        )
        client.changeDynamics(
            number,
            -1,
            localInertiaDiagonal=(
                body.inertia_xx_kg_m2,
                body.inertia_yy_kg_m2,
                body.inertia_zz_kg_m2,
            ),
            linearDamping=0.0,
            angularDamping=0.0,
            restitution=0.0,
            lateralFriction=0.8,
            rollingFriction=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        return int(number)

    def _read(self) -> _Motion:
        client = self.world.client
        position, orientation = client.getBasePositionAndOrientation(self._body)
        velocity, angular = client.getBaseVelocity(self._body)
        q, v, omega = _to_ned_frd(orientation, velocity, angular)
        return _Motion((position[1], position[0], -position[2]), v, q, omega)

    def _watch_contacts(self, velocity_before: Vec) -> None:
        """Latch every new contact; a contact that lasts is one event."""
        points = self.world.client.getContactPoints(bodyA=self._body)
        if not points and not self._touching:
            return
        # Index 2 is body B, index 9 the normal force: 0 = close but not touching. Contacts flicker:
        # one has ended when the bodies are no longer close.
        close = {point[2] for point in points}
        touching = {point[2] for point in points if point[9] > 0.0} | (self._touching & close)
        speed = math.sqrt(sum(v * v for v in velocity_before))
        for other in sorted(touching - self._touching):
            name = self.world.names[other]
            if name != FLOOR or speed > REST_SPEED_M_S:
                self.collisions.append(Collision(self._time_us, name, speed))
        self._touching = touching

    def _use_power(self, accel: Vec, velocity: Vec, wind: Vec) -> None:
        """Draw this tick's power from the battery."""
        power = self._profile.power
        if self._touching:
            # The model is one of flight, and an impact is no electrical load. Standing, rotors
            # take the induced power of their thrust, P ~ T^1.5 (momentum theory).
            a = self._airframe
            thrust, _ = wrench(*self._speeds, a)
            share = float(thrust / (a.mass * GRAVITY_M_S2))
            self._power_w = IDLE_POWER_W + power.b9_hover * share**1.5
        else:
            flown = power_w(velocity, accel, wind, power.payload_g, self._coefficients)
            self._power_w = flown
        sample = self._battery_sample()
        self._remaining = drain(
            self._remaining, sample.current_a, self._profile.battery.capacity_mah, TICK_S
        )
        self._battery = sample

    def _battery_sample(self) -> BatterySample:
        b = self._profile.battery
        rest_v = open_circuit(self._remaining, b.cells * b.cell_empty_v, b.cells * b.cell_full_v)
        voltage = terminal_voltage(rest_v, b.resistance_ohm, self._power_w)
        used = (1.0 - self._remaining) * b.capacity_mah
        return BatterySample(voltage, self._power_w / voltage, used, self._remaining)

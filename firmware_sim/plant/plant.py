"""Plant: a body with rotors, drag, battery and sensors, in an arena."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core import addons, constants, errors, frames, streams
from airl_mav.profiles.vehicle import BodyProfile as BodyProfile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft, PlantName
from airl_mav.vehicle.airframe import Airframe, lag
from airl_mav.vehicle.atmosphere import Wind
from airl_mav.vehicle.power import PowerModel, standing_power_w
from airl_mav.vehicle.rotation import Quat, Vec
from firmware_sim import interfaces, sensor_table
from firmware_sim.autopilot.climb import climb_record
from firmware_sim.engine import dynamics
from firmware_sim.engine.record import Record, new_aircraft
from firmware_sim.engine.ticks import (
    CLIMBED,
    COLLIDED,
    DETECTED,
    EVENT_BITS,
    EVENT_MASK,
    FUSE,
    NOISE,
    NONE,
    ROOM,
    begin_touch,
    end_touch,
    finish_record,
    is_clear_record,
    push_record,
    rest_record,
    stretch,
)
from firmware_sim.plant.body import BREAKING_SHARE, FLOOR, PlantBody, Room, Touch
from firmware_sim.plant.sensors import SensorSuite, SimulatedSensor, Site

BODIES = {"pybullet": "firmware_sim.plant.bullet_body:BulletBody"}
"""Classes of bodies by name; add-ons have more. Imported on first use: pybullet is not available
everywhere, and numba compiles on import."""


def new_body(
    name: PlantName, arena: Arena | None, body: BodyProfile, airframe: Airframe, tick_s: float
) -> PlantBody:
    """Return a vehicle's body at rest on the floor at the start, facing north.

    Without an arena the floor is endless. Raises UsageError for an unknown name.
    """
    place = BODIES.get(name) or addons.entries("firmware_sim", "BODIES").get(name)
    if place is None:
        raise errors.UsageError(f"--plant {name}: no add-on of firmware_sim has this plant")
    made: PlantBody = addons.load(place)(arena, body, airframe, tick_s)
    return made


REST_SPEED_M_S = 0.1
"""Maximum speed of a floor contact that is not a collision (AirSim's kRestingVelocityMax) [m/s]."""

STILL = 1e-4
"""Maximum speed [m/s] and turn rate [rad/s] of a vehicle at rest."""

CLEAR_M = 0.03
"""Minimum gap without contacts in a tick [m], in addition to the distance at which the physics
starts contacts (`BREAKING_SHARE`)."""

NEVER_US = 1 << 61
"""Start time of the tours of held obstacles [µs]."""

STOPPED: dynamics.Speeds = (0.0, 0.0, 0.0, 0.0)


class Blowing(Protocol):
    """Source of wind; see `vehicle.atmosphere.Wind`."""

    def step(self) -> frames.Vector:
        """Advance one tick and return the wind (3,) NED [m/s]; read-only."""


class Collision(NamedTuple):
    """Start of a contact. Floor contacts count only above REST_SPEED_M_S."""

    time_us: int
    what: str
    speed_m_s: float
    """Speed just before the contact [m/s]."""


class Plant:
    """Vehicle in its arena. Time starts at a given value and advances by ticks."""

    def __init__(
        self,
        profile: VehicleProfile,
        arena: Arena | None,
        rng: np.random.Generator,
        *,
        start_us: int = 0,
        aircraft: Aircraft | None = None,
        airframe: Airframe | None = None,
        rate_hz: int = constants.TICK_HZ,
        computer_w: float = 0.0,
        body_by: Callable[..., PlantBody] | None = None,
    ) -> None:
        """Place the vehicle at rest on the floor at the start, facing north.

        Args:
            profile: Vehicle profile.
            arena: Arena; None = an endless floor.
            rng: Random generator of sensors and wind.
            start_us: Simulated time of the first state [µs].
            aircraft: Scenario settings, with the wind of `wind_of_episode`; None = the defaults.
            airframe: Airframe of this vehicle; None = from the profile.
            rate_hz: Tick rate [Hz].
            computer_w: Power of the onboard computer from the pack [W].
            body_by: Factory of a body that moves elsewhere; None = a simulated one.
        """
        tick_s = 1.0 / rate_hz
        asked = aircraft or Aircraft()
        self.collisions: list[Collision] = []
        """Latched collision events, oldest first."""
        airframe = airframe or Airframe.from_profile(profile)
        self.record = record = new_aircraft()
        """Record of body, rotors, battery and sensors."""
        # Separate streams: wind does not depend on the sensors.
        noise, gusts = streams.sensors_and_gusts(rng)
        self._sensors = SensorSuite(
            profile.sensors, noise, tick_s, asked.sensors.navigation_noise, record
        )
        self.wind: Blowing = Wind(asked.wind, gusts, tick_s)
        """Source of wind; may be replaced between two ticks."""
        self._winds = np.zeros((0, 3))
        """Wind NED [m/s] of the coming ticks. A single row is constant wind."""
        self._auxiliary: list[tuple[str, SimulatedSensor]] = []
        """Sensors that measure in Python, with the names of their readings."""
        for kind, settings in sensor_table.fitted(profile.sensors).values():
            # An additional child leaves the random streams of the other sensors unchanged.
            own = self._sensors.spare if kind.draws_always else noise.spawn(1)[0]
            site = Site(arena, own, asked.sensors.navigation_noise, tick_s)
            self._auxiliary.append((kind.reading, addons.load(kind.simulation)(settings, site)))
        model = PowerModel.from_profile(profile)
        self.rotor_lag = lag(airframe, tick_s)
        """Fraction of a rotor speed error that remains after a tick."""
        pack, power_w = dynamics.pack_row(profile.battery), standing_power_w(0.0, airframe, model)
        make = body_by or partial(new_body, asked.plant)
        self.body: PlantBody = make(arena, profile.body, airframe, tick_s)
        """Vehicle body among the bodies of the arena."""
        self._room = Room(arena, profile.body)
        # All names are fields of `engine.record.AIRCRAFT`.
        for name, value in (
            ("airframe", airframe),
            ("power_model", model),
            ("pack", pack),
            ("rotor_lag", self.rotor_lag),
            ("computer_w", computer_w),
            ("tick_s", tick_s),
            ("rate_hz", rate_hz),
            ("start_us", start_us),
            ("moves_us", start_us),
            ("closing_m_s", self._room.closing_m_s),
            ("reach_m", self._room.reach_m),
            ("clear_m", CLEAR_M + BREAKING_SHARE * self._room.reach_m),
            ("footing_m", 0.5 * profile.body.width_m),
            ("held", 1),
            ("time_us", start_us),
            ("charge", asked.battery_charge),
            ("power_w", power_w),
            ("motion", self.body.rest()),
            (
                "battery",
                dynamics.supply(power_w + computer_w, asked.battery_charge, np.array(pack)),
            ),
        ):
            record[name] = value
        self._motion = record["motion"][0]
        self._touching: frozenset[int] = frozenset()
        self._away = False
        """True if the body is outdated: compiled ticks have moved the vehicle since."""

    @property
    def time_us(self) -> int:
        """Simulated time of the newest tick [µs]."""
        return self.record["time_us"].item(0)

    @property
    def motion(self) -> frames.Vector:
        """Copy of the motion (16,), see `engine.dynamics`."""
        return self._motion.copy()

    @property
    def battery_remaining(self) -> float:
        """State of charge, 1 to 0."""
        return self.record["charge"].item(0)

    @battery_remaining.setter
    def battery_remaining(self, charge: float) -> None:
        self.record["charge"] = charge

    @property
    def power_w(self) -> float:
        """Electrical power over the newest tick [W], without the onboard computer."""
        return self.record["power_w"].item(0)

    @property
    def _battery(self) -> interfaces.BatterySample:
        return interfaces.BatterySample(*self.record["battery"][0].tolist())

    @property
    def _elapsed_us(self) -> int:
        """Time since the moving obstacles started [µs]."""
        # Before the start, and while obstacles are held, the tours stay at their start.
        return max(0, self.record["time_us"].item(0) - self.record["moves_us"].item(0))

    def hold_obstacles(self) -> None:
        """Hold moving obstacles at the start of their tours until `begin`."""
        self.record["moves_us"] = NEVER_US

    def begin(self) -> None:
        """Start the moving obstacles and clear the collisions."""
        self.record["moves_us"] = self.time_us
        self._measure_room()
        self.collisions.clear()

    def close(self) -> None:
        """Release the resources of the body."""
        self.body.close()

    @property
    def position(self) -> tuple[float, float, float]:
        """Position of the vehicle, NED [m]."""
        north, east, down = self._motion[dynamics.POSITION].tolist()
        return north, east, down

    @property
    def rotor_speeds(self) -> dynamics.Speeds:
        """Rotor speeds as fractions of the speed at full command, in motor order."""
        a, b, c, d = self.record["speeds"][0].tolist()
        return a, b, c, d

    # --- compiled ticks

    @property
    def compiled(self) -> bool:
        """True if compiled ticks give the same motion and measurements as `step`."""
        return not self._auxiliary and isinstance(self.wind, Wind)

    def glide(
        self, controller: Record, ticks: int, truths: Record, flown: Record
    ) -> tuple[int, int]:
        """Fly up to `ticks` compiled ticks with the record of a flight controller.

        Writes the logs of aircraft and flight controller (ticks,). Returns the number of complete
        ticks, and the event that ended them (`engine.ticks`).
        """
        done = flew = 0
        while True:
            # Read the blocks again: `_refill` replaces them.
            inertial, compass, barometer, gps = self._sensors.noise
            if done:
                truths, flown = truths[flew:], flown[flew:]
            told = stretch(
                *(self.record, self._sensors.record, controller, ticks - done),
                *(inertial, compass, barometer, gps, self._winds, truths, flown),
            )
            flew, event = told >> EVENT_BITS, told & EVENT_MASK
            done += flew
            if not self.record["resting"][0]:
                # Compiled ticks move only the record; the body must follow before its next step.
                self._away = self._away or flew > 0 or event == FUSE
            if event == NOISE:
                self._refill()
            # NOISE and ROOM are handled here; other events need the caller.
            elif event != ROOM:
                return done, event
            elif not self._measure_room():
                # Complete ticks are reported first; contacts follow in the next call.
                if done:
                    return done, NONE
                return self.touch(controller, ticks, truths, flown)

    def touch(
        self, controller: Record, ticks: int, truths: Record, flown: Record
    ) -> tuple[int, int]:
        """Fly up to `ticks` ticks in which contacts are possible; see `glide`.

        The body in the arena moves the vehicle. Returns after a collision, and when contacts become
        impossible.
        """
        record, sensors, before = self.record, self._sensors, len(self.collisions)
        for k in range(ticks):
            if climb_record(controller):
                return k, CLIMBED
            wind = self._wind_now()
            pushed = begin_touch(controller, record, flown[k : k + 1], wind)
            after = self._moved(*pushed)
            sensors.refill()
            event = end_touch(
                *(record, sensors.record, controller, after, wind, bool(self._touching)),
                *(*sensors.noise, truths[k : k + 1]),
            )
            if event == FUSE:
                return k, FUSE
            if controller["detected"][0]:
                return k + 1, DETECTED
            if len(self.collisions) > before:
                return k + 1, COLLIDED
            if event:
                return k + 1, event
            # Out of reach of everything: compiled ticks can take over.
            if not self._touching and self._measure_room():
                return k + 1, NONE
            if record["held"][0] and self._has_come_to_rest():
                return k + 1, NONE
        return ticks, NONE

    def newest(self) -> interfaces.SensorSample:
        """Return the newest sample of the compiled sensors."""
        return self._sensors.newest(self._battery)

    def _refill(self) -> None:
        self._sensors.refill()
        at = self.record["noise_at"][0]
        if isinstance(self.wind, Wind) and at[4] >= len(self._winds):
            self._winds, at[4] = self.wind.ahead(), 0

    def _wind_now(self) -> frames.Vector:
        at = self.record["noise_at"][0]
        if len(self._winds) == 1:
            return self._winds[0]
        if at[4] >= len(self._winds):
            self._refill()
        at[4] += 1
        return self._winds[at[4] - 1]

    def _measure_room(self) -> bool:
        """Measure the distance to all solids; return True if contacts are impossible."""
        record = self.record
        # The vehicle may have been moved: rest must be proven again.
        record["resting"] = 0
        record["room_m"] = -math.inf if self._touching else self._room.above_floor_m(self._motion)
        # Floor first: it is cheap, and decides near the ground.
        if not is_clear_record(record):
            return False
        solids_m = self._room.among_solids_m(self._motion, self._elapsed_us)
        record["room_m"] = min(record["room_m"].item(0), solids_m)
        return is_clear_record(record)

    # --- ticks by Python

    def step(self, controls: interfaces.ActuatorControls) -> interfaces.SensorSample:
        """Apply motor commands for one tick and return the sensor sample after it."""
        wind = self._wind_now() if isinstance(self.wind, Wind) else self.wind.step()
        self._move(controls.motors, wind)
        return self.sense()

    def _move(self, motors: dynamics.Speeds, wind: frames.Vector) -> None:
        record = self.record
        # An empty battery stops the motors.
        motors = motors if record["charge"][0] > 0.0 else STOPPED
        if record["resting"][0] and record["held"][0] and is_clear_record(record):
            rest_record(record, motors, wind)
            return
        after = self._moved(*push_record(record, motors, wind))
        finish_record(record, after, wind, bool(self._touching))
        if record["held"][0]:
            self._has_come_to_rest()

    def _moved(self, here: Vec, force: Vec, torque: Vec) -> frames.Vector:
        """Move the body by a tick; return the motion after it (16,), and update its contacts."""
        body, record, before = self.body, self.record, self._motion
        # `before` comes from compiled ticks, which the body has not seen.
        if self._away:
            body.follow(before)
            self._away = False
        elif record["resting"][0]:
            body.look_around()
        # From the tick count: periods of some rates are not whole microseconds.
        ticks, rate_hz = record["ticks"].item(0) + 1, record["rate_hz"].item(0)
        time_us = record["start_us"].item(0) + ticks * constants.US_PER_S // rate_hz
        after = body.move(here, force, torque, before, max(0, time_us - record["moves_us"].item(0)))
        if body.touch.close or self._touching:
            self._watch(body.touch, before, time_us)
        # Contact physics has moved the body: room and rest are unknown.
        record["room_m"], record["resting"] = -math.inf, 0
        return after

    def _has_come_to_rest(self) -> bool:
        """Mark the vehicle as resting if it is at rest on the floor alone; return the result."""
        record, motion = self.record, self._motion
        names = [self.body.names[other] for other in self._touching]
        # Only the floor holds a vehicle at rest: obstacles may move.
        if names != [FLOOR]:
            return False
        # Velocity and rates; position and attitude do not matter.
        if np.maximum.reduce(np.abs(motion[[3, 4, 5, 10, 11, 12]])) > STILL:
            return False
        record["room_m"] = self._room.among_solids_m(self._motion, self._elapsed_us)
        record["resting"] = resting = is_clear_record(record)
        return resting

    def sense(self) -> interfaces.SensorSample:
        """Return a sensor sample of the current state."""
        time_us = self.time_us
        sample, readings = self._sensors.sample(time_us, self._motion, self._battery), {}
        for name, sensor in self._auxiliary:
            reading = sensor.sense(time_us, self.motion, self._elapsed_us)
            if reading is not None:
                readings[name] = reading
        return sensor_table.add_readings(sample, readings) if readings else sample

    def truth(self) -> interfaces.TrueState:
        """Return the true state."""
        row = self.motion.copy()
        return interfaces.TrueState(
            self.time_us,
            row[dynamics.POSITION],
            row[dynamics.VELOCITY],
            row[dynamics.QUATERNION],
            row[dynamics.RATES],
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
        """Place the vehicle in a motion (`PlantBody.put`); clears contacts and collisions."""
        self._motion[:] = self.body.put(position, velocity, quaternion, rates)
        self._touching, self._away = frozenset(), False
        self.record["room_m"] = -math.inf
        self.collisions.clear()

    def _watch(self, touch: Touch, before: frames.Vector, time_us: int) -> None:
        """Latch every new contact at the end of a tick [µs]. A lasting contact is one event."""
        # Contacts flicker: a contact ends when the bodies are no longer close.
        touching = touch.pressed | (self._touching & touch.close)
        if touching - self._touching:
            speed = math.sqrt(sum(v * v for v in before[dynamics.VELOCITY].tolist()))
            for other in sorted(touching - self._touching):
                name = self.body.names[other]
                if name != FLOOR or speed > REST_SPEED_M_S:
                    self.collisions.append(Collision(time_us, name, speed))
        self._touching = touching

"""Sensors that fail: what becomes of a sample between the sensors and the flight controller.

A sensor that is off is None in the sample. Accelerometer and gyro are never None: flight
controllers count time by their samples, so that one which is off repeats its last sample, as one
that is stuck.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Protocol

import numpy as np

from airl_mav.core.constants import TICK_S, US_PER_S
from airl_mav.core.frames import Vector, local_to_geodetic
from airl_mav.profiles.sensors import Sensors
from firmware_sim.engine.ticks import PA_PER_HPA
from firmware_sim.faults.timeline import Acting
from firmware_sim.interfaces import (
    DistanceReading,
    FlowReading,
    GpsFix,
    Odometry,
    SensorSample,
)

FIELDS = {
    "accel": "accel",
    "gyro": "gyro",
    "mag": "mag",
    "baro": "pressure_hpa",
    "gps": "gps",
    "vision": "odometry",
    "rangefinder": "distance",
    "flow": "flow",
}
"""Field of a sample, by the sensor's name."""

INERTIAL = ("accel", "gyro")


class Effect(Protocol):
    """Effect of a fault on one sensor; has a memory of its own."""

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return what is measured instead of `value` at a time; None: nothing is, in this tick."""
        ...


def _off(value: Any, time_us: int) -> None:
    """Return nothing."""


class Stuck:
    """The sample that it has when the fault begins, again and again, at the sensor's rate."""

    def __init__(self) -> None:
        self._held: Any = None

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return the held sample wherever there is one."""
        del time_us
        if self._held is None:
            self._held = value
        return None if value is None else self._held


class Late:
    """Samples that come later. A sensor that must give something gives its oldest one meanwhile."""

    def __init__(self, delay_s: float, *, always: bool) -> None:
        self._delay_us = round(delay_s * US_PER_S)
        self._always = always
        self._queue: deque[tuple[int, Any]] = deque()
        self._newest: Any = None

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return what is due now."""
        queue = self._queue
        if value is not None:
            queue.append((time_us + self._delay_us, value))
            if self._newest is None:
                self._newest = value
        arrived = None
        while queue and queue[0][0] <= time_us:
            arrived = self._newest = queue.popleft()[1]
        return self._newest if self._always else arrived


class Biased:
    """A constant error."""

    def __init__(self, offset: Vector) -> None:
        self._offset = offset

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return the value with its error."""
        del time_us
        return None if value is None else shifted(value, self._offset)


class Drifting:
    """A position that moves away."""

    def __init__(self, velocity: Vector, since_us: int) -> None:
        self._velocity, self._since_us = velocity, since_us

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return the fix with its error."""
        if value is None:
            return None
        return shifted(value, self._velocity * ((time_us - self._since_us) / US_PER_S))


class Noisy:
    """White noise on top of what the sensor has."""

    def __init__(self, sd: Vector, rng: np.random.Generator) -> None:
        self._sd, self._rng = sd, rng

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return the value with more noise."""
        del time_us
        if value is None:
            return None
        error = self._sd * self._rng.standard_normal(len(self._sd))
        moved = shifted(value, error[:3])
        if isinstance(moved, GpsFix):
            return moved._replace(velocity_ned=moved.velocity_ned + error[3:])
        if isinstance(moved, Odometry) and moved.velocity is not None:
            return moved._replace(velocity=moved.velocity + error[3:])
        return moved


def shifted(value: Any, offset: Vector) -> Any:
    """Return a measured value with an error: of a fix, its position NED; of a pose, its own."""
    if isinstance(value, GpsFix):
        return value._replace(position=local_to_geodetic(offset, value.position))
    if isinstance(value, Odometry):
        return value if value.position is None else value._replace(position=value.position + offset)
    if isinstance(value, DistanceReading):
        return farther(value, offset.item(0))
    if isinstance(value, FlowReading):
        error = offset * value.interval_s if value.quality > 0 else 0.0
        return value._replace(flow=value.flow + error)
    if isinstance(value, float):
        return value + offset.item(0)
    return value + offset


def farther(told: DistanceReading, error_m: float) -> DistanceReading:
    """Return a range with an error; beyond what the sensor measures it says so, as any other."""
    if told.quality == 0:
        return told
    distance_m = max(0.0, told.distance_m + error_m)
    within = told.least_m <= distance_m <= told.greatest_m
    return told._replace(distance_m=distance_m, quality=told.quality if within else 0)


def noise_sd(part: str, profile: Sensors, tick_s: float) -> Vector:
    """Return the sd of a sensor's noise: of a fix or a pose, position (3) and velocity (3)."""
    white = math.sqrt(TICK_S / tick_s)
    gps = profile.gps
    horizontal, speed = gps.horizontal_noise_m, gps.velocity_noise_m_s
    vision = profile.vision
    seen = (0.0, 0.0) if vision is None else (vision.position_noise_m, vision.velocity_noise_m_s)
    ranges, flow = profile.rangefinder, profile.optical_flow
    known: dict[str, list[float]] = {
        "accel": [profile.imu.accel_noise_m_s2 * white] * 3,
        "gyro": [profile.imu.gyro_noise_rad_s * white] * 3,
        "mag": [profile.magnetometer.noise_gauss] * 3,
        "baro": [profile.barometer.noise_pa / PA_PER_HPA],
        "gps": [horizontal, horizontal, gps.vertical_noise_m, speed, speed, speed],
        "vision": [seen[0]] * 3 + [seen[1]] * 3,
        "rangefinder": [0.0 if ranges is None else ranges.noise_m],
        "flow": [0.0 if flow is None else flow.noise_rad_s] * 2,
    }
    return np.array(known[part])


def effect_of(acting: Acting, profile: Sensors, tick_s: float, rng: np.random.Generator) -> Effect:
    """Return the effect of a sensor's fault; `rng` is the fault's own."""
    fault = acting.fault
    part, kind = fault.part, fault.kind
    if kind == "off" and part not in INERTIAL:
        return _off
    if kind in ("off", "stuck"):
        return Stuck()
    if kind == "delay":
        return Late(fault.amount, always=part in INERTIAL)
    if kind == "bias":
        return Biased(np.array(fault.value))
    if kind == "drift":
        return Drifting(np.array(fault.value), acting.since_us)
    # Noise of that many times the sensor's own, together with its own.
    more = math.sqrt(max(0.0, fault.amount**2 - 1.0))
    return Noisy(more * noise_sd(part, profile, tick_s), rng)


def failed(sample: SensorSample, effects: list[tuple[str, Effect]]) -> SensorSample:
    """Return a sample after all effects, given by the sensor's name, in their order."""
    changed: dict[str, Any] = {}
    for part, effect in effects:
        name = FIELDS[part]
        value = changed[name] if name in changed else getattr(sample, name)
        changed[name] = effect(value, sample.time_us)
    return sample._replace(**changed)

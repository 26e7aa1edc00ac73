"""Table of the vehicle's sensors beside IMU, compass, barometer and GPS, one object each.

An add-on lists its sensors in the table SENSORS of its `__init__`, by their names in a vehicle
profile (`profiles.vehicle.Sensors`). The plant simulates the sensors that a vehicle has, and the
flight controller keeps their newest readings in its state (`AutopilotState.readings`), where
MAVLink streams and flight log find them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

from airl_mav.core.addons import entries, load
from airl_mav.core.errors import UsageError
from firmware_sim.interfaces import SensorSample

if TYPE_CHECKING:
    from airl_mav.profiles.vehicle import Sensors
    from firmware_sim.autopilot.snapshot import AutopilotState

Values = tuple[Any, ...]
"""Values of a message's or a topic's fields, in their order."""


class SensorStream(NamedTuple):
    """MAVLink message of a sensor."""

    build: Callable[[AutopilotState], Values | None]
    """Returns the fields from the flight controller's state; None = no content."""
    onboard_hz: float = 0.0
    """Default rate on the onboard link; 0 = only on request."""
    gcs_hz: float = 0.0
    """Default rate on the link to the ground station."""


class SensorTopic(NamedTuple):
    """uORB topic of a sensor in the flight log."""

    interval_ms: int
    fields: str
    """ULog types and names: "type name ...; type name ..."."""
    values: Callable[[AutopilotState], Values | None]
    """Returns the values from the flight controller's state; None = nothing to log."""


@dataclass(frozen=True)
class Sensor:
    """Sensor of a vehicle profile."""

    reading: str
    """Name of its readings: a field of `SensorSample`, or a name in `SensorSample.further`."""
    simulation: str
    """`module:class` of its `plant.sensors.SimulatedSensor`, imported only for a plant."""
    streams: Mapping[str, SensorStream] = field(default_factory=dict)
    """MAVLink messages by name."""
    topics: Mapping[str, SensorTopic] = field(default_factory=dict)
    """Topics of the flight log by name."""
    draws_always: bool = False
    """True: its random stream is drawn for every vehicle. Others are drawn only for vehicles with
    the sensor, so that a new kind of sensor does not change the noise of other vehicles."""


@cache
def sensors() -> dict[str, Sensor]:
    """Return the sensors of all add-ons by their names in a vehicle profile."""
    return {name: load(place) for name, place in entries("firmware_sim", "SENSORS").items()}


def streams() -> dict[str, SensorStream]:
    """Return the MAVLink messages of all sensors by name."""
    return {name: each for s in sensors().values() for name, each in s.streams.items()}


def fitted(profile: Sensors) -> dict[str, tuple[Sensor, Any]]:
    """Return the sensors of the table in a vehicle profile, and their profiles, by name.

    Raises UsageError for a sensor that no installed add-on simulates.
    """
    found = {}
    for name in type(profile).model_fields:
        kind, asked = sensors().get(name), getattr(profile, name)
        if kind is not None and asked is not None:
            found[name] = kind, asked
        elif kind is None and asked is not None and name not in _COMPILED:
            raise UsageError(f"vehicle: sensors.{name} needs an add-on that simulates this sensor")
    return found


_COMPILED = ("imu", "magnetometer", "barometer", "gps")
"""Sensors of every vehicle, simulated in compiled ticks."""


def add_readings(sample: SensorSample, readings: Mapping[str, Any]) -> SensorSample:
    """Return a sample with readings by name."""
    own = {name: each for name, each in readings.items() if name in SensorSample._fields}
    further = {name: each for name, each in readings.items() if name not in own}
    return sample._replace(**own, further=further)

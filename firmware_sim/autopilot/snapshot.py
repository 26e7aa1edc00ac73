"""State of the built-in autopilot for clients, the recorder and tests."""

# ruff: noqa: D102 (properties are documented in `AutopilotState`)
from __future__ import annotations

import math
from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple

from airl_mav.control.demand import AnyDemand
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.autopilot_state import (
    NO_MISSION,
    CommanderStatus,
    Health,
    MissionProgress,
    OrbitStatus,
    Setpoint,
)
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.failsafes.supervisor import Supervisor
from firmware_sim.autopilot.flight_commander import FlightCommander
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.guidance import Guidance, Home
from firmware_sim.autopilot.navigation.navigator import Navigator
from firmware_sim.autopilot.navigation.plan import MissionType, Plans
from firmware_sim.autopilot.sensor_monitor import NewestSensors
from firmware_sim.engine.controller import Controller, ControlSetpoints
from firmware_sim.engine.record import POSITION, TRAJECTORY
from firmware_sim.interfaces import SensorSample


def progress(plans: Plans) -> MissionProgress:
    """Return the mission progress and the ids of the stored lists."""
    mission, fence, rally = (plans.stored(kind) for kind in MissionType)
    if not (mission.items or fence.items or rally.items):
        return NO_MISSION
    return MissionProgress(
        plans.current, len(mission.items), mission.identity, fence.identity, rally.identity
    )


def setpoint_of(tick: Any, velocity: Vector) -> Setpoint:
    """Return the controller's setpoint in a tick.

    Args:
        tick: Element of the record of the flight controller or of its log (`engine.record`).
        velocity: Setpoint of the velocity loop (3,) NED [m/s].
    """
    kind, demand = tick["demand_kind"], tick["demand"].copy()
    # Other kinds have no position setpoint: log the present position instead.
    if kind not in (POSITION, TRAJECTORY):
        return Setpoint(tick["state"][:3].copy(), velocity, math.nan, 0.0)
    # The two layouts of `demand` hold yaw and yaw rate at different places.
    yaw = 6 if kind == POSITION else 9
    return Setpoint(demand[:3], velocity, float(demand[yaw]), float(demand[yaw + 1]))


class Parts(NamedTuple):
    """Components of the autopilot that the snapshot reads."""

    estimator: Estimator
    commander: FlightCommander
    supervisor: Supervisor
    guidance: Guidance
    navigator: Navigator
    controller: Controller
    newest: NewestSensors
    home: Home
    plans: Plans
    value: Callable[[str], float]
    """Look-up for parameters by name."""


class Snapshot:
    """Implementation of `AutopilotState` that reads components on access."""

    load = 0.0

    __slots__ = ("_controlled", "_demand", "_health", "_parts", "revision", "status", "time_us")

    def __init__(
        self, parts: Parts, time_us: int, demand: AnyDemand | None, revision: object
    ) -> None:
        """Take a snapshot after a tick.

        Args:
            parts: Components of the autopilot.
            time_us: Time of the tick [µs].
            demand: Active demand; None = the motors are stopped.
            revision: See `AutopilotState`.
        """
        # No copies: most snapshots are read only in part.
        self._parts, self.time_us, self._demand = parts, time_us, demand
        self.revision = revision
        self.status: CommanderStatus = parts.commander.status
        self._controlled: ControlSetpoints | None = None
        self._health: Health | None = None

    motors = property(attrgetter("_parts.controller.motors"))
    estimate = property(lambda self: self._parts.estimator.estimate())

    @property
    def setpoint(self) -> Setpoint:
        return setpoint_of(self._parts.estimator.record[0], self._setpoints.velocity)

    attitude_setpoint = property(attrgetter("_setpoints.attitude"))
    rate_setpoint = property(attrgetter("_setpoints.rates"))
    thrust_setpoint = property(attrgetter("_setpoints.thrust"))
    accel = property(attrgetter("_sample.accel"))
    gyro = property(attrgetter("_sample.gyro"))
    mag = property(attrgetter("_parts.newest.mag"))
    pressure_hpa = property(attrgetter("_parts.newest.pressure_hpa"))
    temperature_c = property(attrgetter("_sample.temperature_c"))
    battery = property(attrgetter("_sample.battery"))
    gps = property(attrgetter("_parts.newest.gps"))
    home = property(attrgetter("_parts.home.place"))
    origin = property(attrgetter("_parts.estimator.origin"))
    armed_us = property(attrgetter("_parts.commander.armed_us"))
    takeoff_us = property(attrgetter("_parts.commander.takeoff_us"))
    mission = property(lambda self: progress(self._parts.plans))
    fence = property(attrgetter("_parts.navigator.fence.status"))

    @property
    def orbit(self) -> OrbitStatus | None:
        flies = self._parts.commander.flight.mode is Mode.ORBIT
        return self._parts.guidance.context.orbit if flies else None

    @property
    def health(self) -> Health:
        if self._health is None:
            self._health = self._parts.supervisor.health(self.time_us)
        return self._health

    hover_thrust = property(lambda self: self._parts.value("MPC_THR_HOVER"))

    @property
    def destination(self) -> tuple[float, float, float] | None:
        return None if self._demand is None else self._parts.guidance.destination

    home_yaw = property(attrgetter("_parts.guidance.context.home_yaw"))
    sticks = property(attrgetter("_parts.guidance.context.sticks"))
    esc_outputs = property(attrgetter("_parts.newest.esc_outputs"))
    readings = property(attrgetter("_parts.estimator.readings"))
    clearance = property(attrgetter("_parts.estimator.aiding.ground"))

    @property
    def _sample(self) -> SensorSample:
        sample = self._parts.newest.sample
        assert sample is not None  # noqa: S101 (a snapshot is taken after a tick)
        return sample

    @property
    def _setpoints(self) -> ControlSetpoints:
        if self._controlled is None:
            self._controlled = self._parts.controller.setpoints()
        return self._controlled

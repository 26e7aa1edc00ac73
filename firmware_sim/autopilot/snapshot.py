"""What clients, the recorder and tests get of the built-in autopilot."""

# ruff: noqa: D102 (what the properties are says `AutopilotState`)

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from airl_mav.control.demand import AnyDemand, AttitudeDemand, RateDemand
from airl_mav.control.mixer import Motors
from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.autopilot_state import (
    Clearance,
    CommanderStatus,
    Estimate,
    FenceStatus,
    Health,
    MissionProgress,
    Mode,
    OrbitStatus,
    Setpoint,
    Vector,
)
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.failsafes.supervisor import Supervisor
from firmware_sim.autopilot.flight_commander import FlightCommander
from firmware_sim.autopilot.guidance import Guidance
from firmware_sim.autopilot.home import Home
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.autopilot.navigation.navigator import Navigator
from firmware_sim.autopilot.navigation.plan import Plans
from firmware_sim.autopilot.navigation.progress import progress
from firmware_sim.autopilot.newest_sensors import NewestSensors
from firmware_sim.engine.controller import Controller, ControlSetpoints
from firmware_sim.interfaces import (
    BatterySample,
    DistanceReading,
    FlowReading,
    GpsFix,
    Odometry,
    SensorSample,
)


class Parts(NamedTuple):
    """What of the autopilot the snapshot is taken of."""

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
    """Looks up a parameter by its name."""


class Snapshot:
    """Implements `AutopilotState` by asking the parts, each when somebody asks for it."""

    load = 0.0

    __slots__ = ("_controlled", "_demand", "_health", "_parts", "status", "time_us")

    def __init__(self, parts: Parts, time_us: int, demand: AnyDemand | None) -> None:
        """Take it after a tick.

        Args:
            parts: Of the autopilot.
            time_us: Of the tick [µs].
            demand: What is flown; None = the motors are stopped.
        """
        self._parts, self.time_us, self._demand = parts, time_us, demand
        self.status: CommanderStatus = parts.commander.status
        self._controlled: ControlSetpoints | None = None
        self._health: Health | None = None

    @property
    def motors(self) -> Motors:
        return self._parts.controller.motors

    @property
    def estimate(self) -> Estimate:
        return self._parts.estimator.estimate()

    @property
    def setpoint(self) -> Setpoint:
        demand, velocity = self._demand, self._setpoints.velocity
        if demand is None or isinstance(demand, AttitudeDemand | RateDemand):
            return Setpoint(self.estimate.position, velocity, math.nan, 0.0)
        return Setpoint(np.array(demand.position), velocity, demand.yaw, demand.yaw_rate)

    @property
    def attitude_setpoint(self) -> Vector:
        return self._setpoints.attitude

    @property
    def rate_setpoint(self) -> Vector:
        return self._setpoints.rates

    @property
    def thrust_setpoint(self) -> float:
        return self._setpoints.thrust

    @property
    def accel(self) -> Vector:
        return self._sample.accel

    @property
    def gyro(self) -> Vector:
        return self._sample.gyro

    @property
    def mag(self) -> Vector:
        return self._parts.newest.mag

    @property
    def pressure_hpa(self) -> float:
        return self._parts.newest.pressure_hpa

    @property
    def temperature_c(self) -> float:
        return self._sample.temperature_c

    @property
    def battery(self) -> BatterySample:
        return self._sample.battery

    @property
    def gps(self) -> GpsFix | None:
        return self._parts.newest.gps

    @property
    def home(self) -> Geodetic | None:
        return self._parts.home.place

    @property
    def origin(self) -> Geodetic | None:
        return self._parts.estimator.origin

    @property
    def armed_us(self) -> int:
        return self._parts.commander.armed_us

    @property
    def takeoff_us(self) -> int:
        return self._parts.commander.takeoff_us

    @property
    def mission(self) -> MissionProgress:
        return progress(self._parts.plans)

    @property
    def fence(self) -> FenceStatus:
        return self._parts.navigator.fence.status

    @property
    def orbit(self) -> OrbitStatus | None:
        flies = self._parts.commander.flight.mode is Mode.ORBIT
        return self._parts.guidance.context.orbit if flies else None

    @property
    def health(self) -> Health:
        if self._health is None:
            self._health = self._parts.supervisor.health(self.time_us)
        return self._health

    @property
    def hover_thrust(self) -> float:
        return self._parts.value("MPC_THR_HOVER")

    @property
    def destination(self) -> tuple[float, float, float] | None:
        return None if self._demand is None else self._parts.guidance.destination

    @property
    def home_yaw(self) -> float:
        return self._parts.guidance.context.home_yaw

    @property
    def sticks(self) -> Sticks | None:
        return self._parts.guidance.context.sticks

    @property
    def esc_outputs(self) -> tuple[float, float, float, float] | None:
        return self._parts.newest.esc_outputs

    @property
    def odometry(self) -> Odometry | None:
        return self._parts.estimator.odometry

    @property
    def odometry_us(self) -> int:
        return self._parts.estimator.odometry_us

    @property
    def distance(self) -> DistanceReading | None:
        finder = self._parts.estimator.range
        return None if finder is None else finder.reading

    @property
    def distance_us(self) -> int:
        finder = self._parts.estimator.range
        return 0 if finder is None else finder.reading_us

    @property
    def flow(self) -> FlowReading | None:
        flow = self._parts.estimator.flow
        return None if flow is None else flow.reading

    @property
    def flow_us(self) -> int:
        flow = self._parts.estimator.flow
        return 0 if flow is None else flow.reading_us

    @property
    def clearance(self) -> Clearance | None:
        finder = self._parts.estimator.range
        return None if finder is None else finder.clearance()

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

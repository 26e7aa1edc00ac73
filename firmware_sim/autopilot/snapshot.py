"""The snapshot that MAVLink, the recorder and tests get of the built-in autopilot."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from airl_mav.control.controller import Controller
from airl_mav.control.demand import AnyDemand, AttitudeDemand, RateDemand
from airl_mav.control.mixer import Motors
from firmware_sim.autopilot.autopilot_state import AutopilotState, Mode, Setpoint
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.failsafes.supervisor import Supervisor
from firmware_sim.autopilot.flight_commander import FlightCommander
from firmware_sim.autopilot.guidance import Guidance
from firmware_sim.autopilot.home import Home
from firmware_sim.autopilot.navigation.navigator import Navigator
from firmware_sim.autopilot.navigation.plan import Plans
from firmware_sim.autopilot.navigation.progress import progress
from firmware_sim.autopilot.newest_sensors import NewestSensors
from firmware_sim.interfaces import SensorSample


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


def snapshot(
    parts: Parts, sample: SensorSample, demand: AnyDemand | None, motors: Motors, hover: float
) -> AutopilotState:
    """Take it after a tick.

    Args:
        parts: Of the autopilot.
        sample: The tick's sensors.
        demand: What is flown; None = the motors are stopped.
        motors: Their commands, 0..1.
        hover: Collective that hovers (MPC_THR_HOVER), 0..1.
    """
    estimate = parts.estimator.estimate()
    attitude, rates, velocity, thrust = parts.controller.setpoints()
    if demand is None or isinstance(demand, AttitudeDemand | RateDemand):
        setpoint = Setpoint(estimate.position, velocity, math.nan, 0.0)
    else:
        position = np.array(demand.position)
        setpoint = Setpoint(position, velocity, demand.yaw, demand.yaw_rate)
    finder = parts.estimator.range
    flight, context, newest = parts.commander.flight, parts.guidance.context, parts.newest
    return AutopilotState(
        time_us=sample.time_us,
        estimate=estimate,
        status=parts.commander.status,
        setpoint=setpoint,
        attitude_setpoint=attitude,
        rate_setpoint=rates,
        thrust_setpoint=thrust,
        motors=motors,
        accel=sample.accel,
        gyro=sample.gyro,
        mag=newest.mag,
        pressure_hpa=newest.pressure_hpa,
        temperature_c=sample.temperature_c,
        battery=sample.battery,
        gps=newest.gps,
        home=parts.home.place,
        origin=parts.estimator.origin,
        orbit=context.orbit if flight.mode is Mode.ORBIT else None,
        armed_us=parts.commander.armed_us,
        takeoff_us=parts.commander.takeoff_us,
        mission=progress(parts.plans),
        fence=parts.navigator.fence.status,
        hover_thrust=hover,
        destination=None if demand is None else parts.guidance.destination,
        home_yaw=context.home_yaw,
        health=parts.supervisor.health(sample.time_us),
        sticks=context.sticks,
        esc_outputs=sample.esc_outputs,
        odometry=parts.estimator.odometry,
        odometry_us=parts.estimator.odometry_us,
        distance=None if finder is None else finder.reading,
        distance_us=0 if finder is None else finder.reading_us,
        clearance=None if finder is None else finder.clearance(),
    )

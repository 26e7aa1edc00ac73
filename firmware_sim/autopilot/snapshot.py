"""State of the autopilot for MAVLink, the recorder and tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from airl_mav.control.demand import AnyDemand
from airl_mav.core.frames import Geodetic, Vector
from firmware_sim.autopilot import autopilot_state
from firmware_sim.autopilot.failsafes.failsafe_conditions import Conditions
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import OffboardSetpoint, Sticks
from firmware_sim.autopilot.navigation.plan import MissionType, Plans
from firmware_sim.engine.record import POSITION, TRAJECTORY
from firmware_sim.interfaces import BatterySample, GpsFix, Received

if TYPE_CHECKING:
    from firmware_sim.autopilot.autopilot import BuiltinAutopilot
    from firmware_sim.engine.controller import ControlSetpoints


def progress(plans: Plans, mode: Mode) -> autopilot_state.MissionProgress:
    """Return the mission progress in the active mode, and the ids of the stored lists."""
    mission, fence, rally = (plans.stored(kind).identity for kind in MissionType)
    known = autopilot_state.MissionProgress(
        plans.current, len(plans.mission), mission, fence, rally
    )
    if not plans.has_state:
        return known
    # As in PX4's MavlinkMissionManager::update_mission_state.
    active, kind = mode in (Mode.MISSION, Mode.TAKEOFF, Mode.LAND), autopilot_state.MissionState
    if not plans.valid:
        state = kind.NO_MISSION
    elif plans.finished:
        state = kind.COMPLETE
    elif active:
        state = kind.ACTIVE
    else:
        state = kind.PAUSED if plans.reached >= 0 or plans.current > 0 else kind.NOT_STARTED
    return known._replace(state=state, mode=1 if active else 2)


def setpoint_of(tick: Any, velocity: Vector) -> autopilot_state.Setpoint:
    """Return the controller's setpoint in a tick of its record or log (`engine.record`).

    `velocity` is the setpoint of the velocity loop (3,) NED [m/s].
    """
    kind, demand = tick["demand_kind"], tick["demand"].copy()
    # Other kinds have no position setpoint: log the present position instead.
    if kind not in (POSITION, TRAJECTORY):
        return autopilot_state.Setpoint(tick["state"][:3].copy(), velocity, math.nan, 0.0)
    # The two layouts of `demand` hold yaw and yaw rate at different places.
    yaw = 6 if kind == POSITION else 9
    return autopilot_state.Setpoint(
        demand[:3], velocity, float(demand[yaw]), float(demand[yaw + 1])
    )


class AutopilotState:
    """State of the autopilot after its newest tick; valid until the next tick.

    Values are computed when they are read (`_READ`), as most ticks need only a few.
    """

    __slots__ = ("_autopilot", "_demand", "_health", "_loops", "revision", "status", "time_us")

    time_us: int
    """Simulated time of the tick [µs]."""
    revision: object
    """Same object while log data outside the tick's log is unchanged; None = unknown."""
    estimate: autopilot_state.StateEstimate
    """The estimator's output."""
    status: autopilot_state.CommanderStatus
    """State of the commander."""
    setpoint: autopilot_state.Setpoint
    """Setpoint of the position controller, in every mode."""
    attitude_setpoint: Vector
    """(4,) body -> NED."""
    rate_setpoint: Vector
    """(3,) FRD [rad/s]."""
    thrust_setpoint: float
    """Collective, 0..1."""
    motors: tuple[float, float, float, float]
    """Motor commands, 0..1."""
    accel: Vector
    """(3,) newest raw sample, FRD [m/s²]."""
    gyro: Vector
    """(3,) newest raw sample, FRD [rad/s]."""
    mag: Vector
    """(3,) newest raw sample, FRD [gauss]."""
    pressure_hpa: float
    """Newest static pressure [hPa]."""
    temperature_c: float
    """Air temperature [°C]."""
    battery: BatterySample
    """Report of the power module."""
    gps: GpsFix | None
    """Newest fix; None before the first."""
    home: Geodetic | None
    """Home position; set with the estimator's origin and at arming, None before."""
    origin: Geodetic | None
    """Geodetic origin of local NED; None before the first fix."""
    load: float
    """Share of the tick spent computing, 0..1."""
    armed_us: int
    """Time of arming [µs], 0 while disarmed."""
    takeoff_us: int
    """Time of take-off [µs], 0 before."""
    mission: autopilot_state.MissionProgress
    """Progress of the mission."""
    fence: autopilot_state.FenceStatus
    """Violated limits of the geofence."""
    orbit: autopilot_state.OrbitStatus | None
    """Active circle in Orbit mode."""
    health: autopilot_state.Health
    """Usability of sensors and estimates."""
    hover_thrust: float
    """Collective thrust in hover, 0..1."""
    destination: tuple[float, float, float] | None
    """Destination of an automatic mode, local NED [m]; None in other modes."""
    home_yaw: float
    """Heading at home [rad]."""
    sticks: Sticks | None
    """Pilot's sticks; None = no pilot."""
    esc_outputs: tuple[float, float, float, float] | None
    """Motor outputs reported by the speed controllers; None: outputs equal commands."""
    readings: Mapping[str, Received]
    """Newest readings of further sensors by name (`sensor_table.Sensor.reading`)."""
    clearance: autopilot_state.Clearance | None
    """Height above the ground; None before the first range."""
    conditions: Conditions
    """Failsafe conditions at the newest check."""
    offboard: OffboardSetpoint | None
    """Newest offboard setpoint; None before the first."""
    offboard_us: int | None
    """Time of the newest offboard setpoint [µs]."""
    mixing: tuple[float, float]
    """Shares of a roll and of a pitch torque in each motor's command."""

    def __init__(
        self,
        autopilot: BuiltinAutopilot,
        status: autopilot_state.CommanderStatus,
        time_us: int,
        demand: AnyDemand | None,
        revision: object,
    ) -> None:
        """Take a snapshot after a tick at `time_us`; demand None = the motors are stopped."""
        # No copies: most snapshots are read only in part.
        self._autopilot, self._demand = autopilot, demand
        self.status, self.time_us, self.revision = status, time_us, revision
        self._loops: ControlSetpoints | None = None
        self._health: autopilot_state.Health | None = None

    @property
    def _setpoints(self) -> ControlSetpoints:
        if self._loops is None:
            self._loops = self._autopilot._controller.setpoints()
        return self._loops

    def _checked(self) -> autopilot_state.Health:
        if self._health is None:
            self._health = self._autopilot.supervisor.health(self.time_us)
        return self._health

    def _circle(self) -> autopilot_state.OrbitStatus | None:
        autopilot = self._autopilot
        return autopilot._guidance.context.orbit if autopilot.flight.mode is Mode.ORBIT else None


_READ: dict[str, Callable[[Any], Any]] = {
    "estimate": lambda state: state._autopilot.estimator.estimate(),
    "setpoint": lambda state: setpoint_of(state._autopilot.record[0], state._setpoints.velocity),
    "attitude_setpoint": attrgetter("_setpoints.attitude"),
    "rate_setpoint": attrgetter("_setpoints.rates"),
    "thrust_setpoint": attrgetter("_setpoints.thrust"),
    "motors": attrgetter("_autopilot._controller.motors"),
    "accel": attrgetter("_autopilot._newest.sample.accel"),
    "gyro": attrgetter("_autopilot._newest.sample.gyro"),
    "mag": attrgetter("_autopilot._newest.mag"),
    "pressure_hpa": attrgetter("_autopilot._newest.pressure_hpa"),
    "temperature_c": attrgetter("_autopilot._newest.sample.temperature_c"),
    "battery": attrgetter("_autopilot._newest.sample.battery"),
    "gps": attrgetter("_autopilot._newest.gps"),
    "home": attrgetter("_autopilot._home.place"),
    "origin": attrgetter("_autopilot.estimator.origin"),
    "load": lambda _state: 0.0,
    "armed_us": attrgetter("_autopilot._commander.armed_us"),
    "takeoff_us": attrgetter("_autopilot._commander.takeoff_us"),
    "mission": lambda state: progress(state._autopilot.plans, state.status.mode),
    "fence": attrgetter("_autopilot._navigator.fence.status"),
    "orbit": AutopilotState._circle,
    "health": AutopilotState._checked,
    "hover_thrust": lambda state: state._autopilot.parameters.value("MPC_THR_HOVER"),
    "destination": lambda state: (
        None if state._demand is None else state._autopilot._guidance.destination
    ),
    "home_yaw": attrgetter("_autopilot._guidance.context.home_yaw"),
    "sticks": attrgetter("_autopilot._guidance.context.sticks"),
    "esc_outputs": attrgetter("_autopilot._newest.esc_outputs"),
    "readings": attrgetter("_autopilot.estimator.readings"),
    "clearance": attrgetter("_autopilot.estimator.aiding.ground"),
    "conditions": attrgetter("_autopilot.supervisor.conditions"),
    "offboard": attrgetter("_autopilot._guidance.context.setpoint"),
    "offboard_us": attrgetter("_autopilot.supervisor.watch.setpoint_us"),
    "mixing": lambda state: state._autopilot.record["gains"][["mix_roll", "mix_pitch"]].item(),
}
"""Sources of the values of `AutopilotState`."""

for _name, _read in _READ.items():
    setattr(AutopilotState, _name, property(_read))

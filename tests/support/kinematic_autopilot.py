"""An autopilot for wire-level tests: perfect knowledge, no dynamics worth the name.

It answers as `BuiltinAutopilot` with PX4's refusals and texts, so that MAVLink services can be
tested without an estimator, a controller or a plant.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from airl_mav.control.demand import AttitudeDemand, RateDemand
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S, TICK_US, US_PER_S
from airl_mav.core.frames import Geodetic, local_to_geodetic, quat_from_euler, wrap_pi
from airl_mav.profiles.px4_release import px4_release
from firmware_sim.autopilot.autopilot_state import (
    UNTOLD,
    Arming,
    Clearance,
    CommanderStatus,
    FenceStatus,
    Health,
    Landed,
    MissionProgress,
    OperatorText,
    OrbitStatus,
    Result,
    Setpoint,
    Severity,
    StateEstimate,
    Vector,
    Wire,
)
from firmware_sim.autopilot.events.definition import MavlinkEvent
from firmware_sim.autopilot.failsafes.failsafe_conditions import Conditions
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import (
    FollowedTarget,
    LandingTarget,
    ModeRequest,
    ObstacleBins,
    OffboardSetpoint,
    Source,
    Sticks,
)
from firmware_sim.autopilot.navigation.plan import Plans
from firmware_sim.autopilot.parameter_store import ParameterValue
from firmware_sim.autopilot.snapshot import progress
from firmware_sim.fault_timeline import ClientFaults
from firmware_sim.interfaces import BatterySample, GpsFix, LogStore, Received, SensorSample

if TYPE_CHECKING:
    # Stands in for it without its parts.
    from firmware_sim.autopilot.autopilot import BuiltinAutopilot
else:
    BuiltinAutopilot = object

ORIGIN = Geodetic(47.397743, 8.545594, 489.4)
READY_US = 100_000
VELOCITY_GAIN = 5.0
LAND_SPEED_M_S = 4.0
FALLBACK_SPEED_M_S = 0.75
NOTHING = np.full(3, math.nan)

DEFAULT_PARAMETERS: dict[str, int | float] = {
    "COM_OBL_RC_ACT": 0,
    "COM_OF_LOSS_T": 1.0,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_XY_VEL_MAX": 12.0,
    "NAV_DLL_ACT": 0,
    "SYS_AUTOSTART": 4001,
    "TEST_NEGATIVE": -1,
    "TEST_SIGNALLING": -5_000_000,  # as a float: a signalling NaN
}


class KnownState(NamedTuple):
    """Answers as `AutopilotState` with plain values."""

    time_us: int
    estimate: StateEstimate
    status: CommanderStatus
    setpoint: Setpoint
    attitude_setpoint: Vector
    rate_setpoint: Vector
    thrust_setpoint: float
    motors: tuple[float, float, float, float]
    accel: Vector
    gyro: Vector
    mag: Vector
    pressure_hpa: float
    temperature_c: float
    battery: BatterySample
    gps: GpsFix | None
    home: Geodetic | None
    origin: Geodetic | None
    load: float = 0.0
    armed_us: int = 0
    takeoff_us: int = 0
    mission: MissionProgress = MissionProgress()
    fence: FenceStatus = FenceStatus()
    orbit: OrbitStatus | None = None
    health: Health = Health()
    hover_thrust: float = 0.5
    destination: tuple[float, float, float] | None = None
    home_yaw: float = 0.0
    sticks: Sticks | None = None
    esc_outputs: tuple[float, float, float, float] | None = None
    readings: Mapping[str, Received] = MappingProxyType({})
    clearance: Clearance | None = None
    conditions: Conditions = Conditions()
    offboard: OffboardSetpoint | None = None
    offboard_us: int | None = None
    mixing: tuple[float, float] = (math.sqrt(0.5), math.sqrt(0.5))
    revision: None = None


class Parameters:
    """A parameter store: names sorted, values as given."""

    release = px4_release()

    def __init__(self, values: dict[str, int | float] | None = None) -> None:
        self.values = dict(sorted((DEFAULT_PARAMETERS if values is None else values).items()))
        self.history: list[tuple[str, float, float]] = []

    @property
    def value(self) -> Callable[[str], float]:
        defaults = {spec.name: float(spec.default) for spec in px4_release().specs}
        return (defaults | self.values).__getitem__

    @property
    def revision(self) -> int:
        return hash(tuple(self.values.items()))

    @property
    def _names(self) -> list[str]:
        return sorted(self.values)

    def __len__(self) -> int:
        return len(self.values)

    def by_name(self, name: str) -> ParameterValue | None:
        if name not in self.values:
            return None
        return ParameterValue(name, self.values[name], self._names.index(name))

    def by_index(self, index: int) -> ParameterValue | None:
        if not 0 <= index < len(self._names):
            return None
        return self.by_name(self._names[index])

    def set(self, name: str, value: int | float) -> ParameterValue | None:
        if name not in self.values:
            return None
        before, self.values[name] = self.values[name], type(self.values[name])(value)
        if self.values[name] != before:
            self.history.append((name, before, self.values[name]))
        return self.by_name(name)

    def reset(self, names: Iterable[str] | None = None) -> None:
        for name in DEFAULT_PARAMETERS if names is None else names:
            self.set(name, DEFAULT_PARAMETERS[name])

    def changed(self) -> dict[str, int | float]:
        return {n: v for n, v in self.values.items() if v != DEFAULT_PARAMETERS.get(n)}

    def load(self) -> bool:
        return True

    def save(self) -> bool:
        return True


class KinematicAutopilot(BuiltinAutopilot):
    """Velocity follows the setpoint with a first-order lag; attitude is level."""

    def __init__(self, parameters: Parameters | None = None, start_us: int = 0) -> None:
        self.parameters: Any = parameters or Parameters()
        self.plans = Plans()
        self.failures: ClientFaults | None = None
        self.logs = LogStore()
        self.time_us = start_us
        self.ready_us = start_us + READY_US
        self.position = np.zeros(3)
        self.velocity = np.zeros(3)
        self.acceleration = np.zeros(3)
        self.roll = self.pitch = self.yaw = 0.0
        self.yaw_rate = 0.0
        self.arming = Arming.BOOT
        self.mode = Mode.HOLD
        self.landed = Landed.ON_GROUND
        self.failsafe = False
        self.home: Geodetic | None = None
        self.origin: Geodetic | None = None
        self.destination: tuple[float, float, float] | None = None
        self.battery = BatterySample(15.8, 12.34, 456.0, 0.83)
        self.mag = np.array([0.21, 0.01, 0.43])
        self.accel = np.array([0.1, -0.2, -GRAVITY_M_S2])
        self.gyro = np.zeros(3)
        self.setpoints: list[tuple[Setpoint, int]] = []
        self.received: defaultdict[str, list[Any]] = defaultdict(list)
        self.obstacles: list[ObstacleBins] = []
        self.gcs_heartbeats: list[int] = []
        self.takeoffs: list[float | None] = []
        self.takeoff_place: tuple[float, float] | None = None
        self.commands: list[str] = []
        self.looked_at: Geodetic | None = None
        self.requests: list[ModeRequest | None] = []
        self.sticks: list[tuple[Sticks, Source, int]] = []
        self.landing_targets: list[LandingTarget] = []
        self.followed: list[FollowedTarget] = []
        self.attitudes: list[tuple[AttitudeDemand | RateDemand, int]] = []
        self.wires: list[Wire] = []
        self.refusals: list[tuple[str, int]] = []
        self.messages: list[OperatorText] = []
        self.said: deque[OperatorText] = deque()
        self.events: list[MavlinkEvent] = []
        self.offboard_loss_us = US_PER_S
        self.frozen = False
        """Only time passes: lets a test read what it has set."""
        self._target_height = 0.0

    # --- the port ---

    @property
    def sample(self) -> SensorSample:
        return SensorSample(self.time_us, self.accel, self.gyro, 25.31, self.battery)

    def take_messages(self) -> list[OperatorText]:
        taken, self.messages = self.messages, []
        return taken

    def take_events(self) -> list[MavlinkEvent]:
        taken, self.events = self.events, []
        return taken

    def tell_checks(self) -> None:
        self.commands.append("tell checks")

    def arm(self, *, force: bool) -> Result:
        self.commands.append(f"arm force={force}")
        if self.arming is Arming.BOOT or (self.mode is Mode.OFFBOARD and not self._fresh()):
            self._text(Severity.CRITICAL, "Arming denied: Resolve system health failures first")
            return Result.TEMPORARILY_REJECTED
        if self.arming is not Arming.ARMED:
            self.arming = Arming.ARMED
            self._text(Severity.INFO, "Armed by external command")
        return Result.ACCEPTED

    def disarm(self, *, force: bool) -> Result:
        self.commands.append(f"disarm force={force}")
        if self.landed is not Landed.ON_GROUND and not force:
            self._text(Severity.CRITICAL, "Disarming denied: not landed")
            return Result.TEMPORARILY_REJECTED
        if self.arming is Arming.ARMED:
            self.arming = Arming.STANDBY
        return Result.ACCEPTED

    def terminate(self) -> Result:
        self.commands.append("terminate")
        if self.arming is not Arming.ARMED:
            return Result.DENIED
        self.mode = Mode.TERMINATION
        return Result.ACCEPTED

    def takeoff(self, altitude_m: float | None, place: tuple[float, float] | None = None) -> Result:
        self.takeoffs.append(altitude_m)
        self.takeoff_place = place
        default = float(self.parameters.values["MIS_TAKEOFF_ALT"])
        self._target_height = default if altitude_m is None else altitude_m
        self.mode = Mode.TAKEOFF
        return Result.ACCEPTED

    def change_speed(self, speed_m_s: float) -> None:
        self.commands.append(f"speed {speed_m_s}")

    def set_mode(
        self, mode: Mode, request: ModeRequest | None = None, *, commanded: bool = False
    ) -> Result:
        self.requests.append(request)
        self.commands.append(f"mode {mode.name}")
        in_air = self.landed is not Landed.ON_GROUND
        if mode is Mode.POSITION or (mode is Mode.OFFBOARD and in_air and not self._fresh()):
            name = "Offboard" if mode is Mode.OFFBOARD else "Position"
            self._text(Severity.CRITICAL, f"Switching to {name} is currently not available")
            return Result.TEMPORARILY_REJECTED
        self.mode = mode
        self.failsafe = False
        return Result.ACCEPTED

    def set_home(self, place: Geodetic | None) -> Result:
        if self.origin is None:
            return Result.TEMPORARILY_REJECTED
        self.home = place or local_to_geodetic(self.position, self.origin)
        return Result.ACCEPTED

    def set_origin(self, place: Geodetic) -> Result:
        self.origin = place
        return Result.ACCEPTED

    def start_mission(self, index: int) -> Result:
        self.commands.append(f"mission from {index}")
        return Result.ACCEPTED if self.plans.mission else Result.DENIED

    def look_at(self, place: Geodetic | None) -> None:
        self.looked_at = place

    def offer_setpoint(self, setpoint: Setpoint, time_us: int) -> None:
        self.setpoints.append((setpoint, time_us))

    def offer_attitude(
        self, demand: AttitudeDemand | RateDemand, time_us: int, wire: Wire = UNTOLD
    ) -> None:
        self.attitudes.append((demand, time_us))
        self.wires.append(wire)

    def refuse_setpoint(self, reason: str, time_us: int) -> None:
        self.refusals.append((reason, time_us))

    def manual_control(self, sticks: Sticks, source: Source, time_us: int) -> None:
        self.sticks.append((sticks, source, time_us))

    def see_obstacles(self, obstacles: ObstacleBins) -> None:
        self.obstacles.append(obstacles)

    def receive(self, name: str, reading: Any) -> None:
        self.received[name].append(reading)

    def landing_target(self, target: LandingTarget) -> None:
        self.landing_targets.append(target)

    def follow(self, target: FollowedTarget) -> None:
        self.followed.append(target)

    def gcs_heartbeat(self, time_us: int) -> None:
        self.gcs_heartbeats.append(time_us)

    @property
    def attitude(self) -> Vector:
        return quat_from_euler(self.roll, self.pitch, self.yaw)

    def state(self) -> Any:
        zero = np.zeros(3)
        estimate = StateEstimate(
            time_us=self.time_us,
            position=self.position,
            velocity=self.velocity,
            acceleration=self.acceleration,
            quaternion=quat_from_euler(self.roll, self.pitch, self.yaw),
            angular_velocity=np.array([0.0, 0.0, self.yaw_rate]),
            gyro_bias=np.array([0.001, 0.002, 0.003]),
            accel_bias=np.array([0.01, 0.02, 0.03]),
            sigma=np.arange(1.0, 17.0) / 100.0,
            innovation_ratio=np.array([0.1, 0.2, 0.3, 0.4]),
            healthy=self.arming is not Arming.BOOT,
        )
        fix = None
        if self.origin is not None:
            here = local_to_geodetic(self.position, self.origin)
            fix = GpsFix(here, self.velocity, eph_m=0.9, epv_m=1.8, satellites=10)
        return KnownState(
            time_us=self.time_us,
            estimate=estimate,
            status=CommanderStatus(
                self.arming, self.mode, self.mode, self.landed, failsafe=self.failsafe
            ),
            setpoint=self._tracked(),
            attitude_setpoint=estimate.quaternion,
            rate_setpoint=zero,
            thrust_setpoint=0.5,
            motors=(0.0, 0.25, 0.5, 1.0),
            accel=self.accel,
            gyro=self.gyro,
            mag=self.mag,
            pressure_hpa=954.61,
            temperature_c=25.31,
            battery=self.battery,
            gps=fix,
            home=self.home,
            origin=self.origin,
            load=0.123,
            mission=progress(self.plans, self.mode),
            home_yaw=0.6,
            destination=self.destination,
        )

    # --- flying ---

    def step(self, _sample: Any = None, /) -> Any:
        """Advance by one tick."""
        self.time_us += TICK_US
        if self.frozen:
            return
        if self.arming is Arming.BOOT and self.time_us >= self.ready_us:
            self.arming = Arming.STANDBY
            self.origin = self.home = ORIGIN
        if self.mode is Mode.OFFBOARD and self.arming is Arming.ARMED and not self._fresh():
            self.mode, self.failsafe = Mode.POSITION, True
            self._text(Severity.CRITICAL, "Failsafe activated")
        elif self.failsafe and self._fresh():
            self.mode, self.failsafe = Mode.OFFBOARD, False
        wanted = self._velocity() if self.arming is Arming.ARMED else np.zeros(3)
        self.acceleration = VELOCITY_GAIN * (wanted - self.velocity)
        self.velocity = self.velocity + self.acceleration * TICK_S
        self.position = self.position + self.velocity * TICK_S
        self.yaw = wrap_pi(self.yaw + self.yaw_rate * TICK_S)
        self._update_landed()

    def _velocity(self) -> Vector:
        height = -float(self.position[2])
        self.yaw_rate = 0.0
        if self.mode is Mode.TAKEOFF:
            if height > self._target_height - 0.1:
                self.mode = Mode.HOLD
            return np.array([0.0, 0.0, -3.0 * min(1.0, self._target_height - height + 0.1)])
        if self.mode in (Mode.LAND, Mode.RETURN):
            return np.array([0.0, 0.0, LAND_SPEED_M_S])
        if self.mode is Mode.POSITION:
            return np.array([0.0, 0.0, FALLBACK_SPEED_M_S])
        if self.mode is Mode.OFFBOARD:
            setpoint = self.setpoints[-1][0]
            if math.isfinite(setpoint.yaw_rate):
                self.yaw_rate = setpoint.yaw_rate
            if math.isfinite(setpoint.yaw):
                self.yaw = setpoint.yaw
            error = np.nan_to_num(setpoint.position - self.position)
            return np.asarray(np.nan_to_num(setpoint.velocity) + np.clip(error, -5.0, 5.0))
        return np.zeros(3)

    def _update_landed(self) -> None:
        if self.position[2] >= 0.0 and self.velocity[2] >= 0.0:
            self.position[2], self.velocity[2] = 0.0, 0.0
            if self.landed is not Landed.ON_GROUND:
                self.landed = Landed.ON_GROUND
                self.arming = Arming.STANDBY
                self._text(Severity.INFO, "Disarmed by landing")
        elif self.mode is Mode.TAKEOFF:
            self.landed = Landed.TAKEOFF
        elif self.mode is Mode.LAND:
            self.landed = Landed.LANDING
        else:
            self.landed = Landed.IN_AIR

    def _tracked(self) -> Setpoint:
        if self.mode is Mode.OFFBOARD and self.setpoints:
            return self.setpoints[-1][0]
        return Setpoint(NOTHING, np.zeros(3), math.nan, math.nan)

    def _fresh(self) -> bool:
        return bool(self.setpoints) and self._setpoint_age_us() < self.offboard_loss_us

    def _setpoint_age_us(self) -> int:
        return self.time_us - self.setpoints[-1][1]

    def _text(self, severity: Severity, text: str) -> None:
        self.messages.append(OperatorText(severity, text))

"""The built-in autopilot: sensors in, motor commands out, PX4's manners towards its clients."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.constants import TICK_S
from airl_mav.control.cascade import Demand, Output, cascade, new_memory, reset_integrals
from airl_mav.control.gains import Gains
from airl_mav.frames import Geodetic, Vector, local_to_geodetic
from firmware_sim.autopilot.commander import Event, Flight, Phase, transition
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.failsafe import Watch
from firmware_sim.autopilot.guidance import Guidance
from firmware_sim.autopilot.land_detector import LandDetector
from firmware_sim.autopilot.parameters import Parameters
from firmware_sim.autopilot.state import (
    Arming,
    AutopilotState,
    CommanderStatus,
    Estimate,
    Landed,
    Message,
    Mode,
    Result,
    Setpoint,
    Severity,
)
from firmware_sim.interfaces import ActuatorControls, GpsFix, SensorSample

_NAN3 = np.full(3, math.nan)
_NO_SETPOINT = Setpoint(_NAN3, _NAN3, math.nan, math.nan)
_IDLE = Output((0.0, 0.0, 0.0, 0.0), 0.0, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

_MODE_EVENT = {
    Mode.HOLD: Event.HOLD,
    Mode.TAKEOFF: Event.TAKEOFF,
    Mode.LAND: Event.LAND,
    Mode.RETURN: Event.RETURN,
    Mode.POSITION: Event.POSITION,
}


class BuiltinAutopilot:
    """Implements `interfaces.Autopilot` towards the plant and `port.AutopilotPort` to MAVLink."""

    def __init__(self, parameters: Parameters) -> None:
        """Boot: not armable until the estimator has converged."""
        self._parameters = parameters
        value = parameters.__getitem__
        self._estimator = Estimator(value)
        self._guidance = Guidance(value)
        self._watch = Watch(value)
        self._land_detector = LandDetector(value)
        self._gains = Gains.from_parameters(value)
        parameters.on_change(self._read_gains)
        self._memory = new_memory()
        self._flight = Flight()
        self._messages: list[Message] = []
        self._setpoint: Setpoint | None = None
        self._demand = Demand((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0)
        self._output = _IDLE
        self._estimate: Estimate | None = None
        self._sample: SensorSample | None = None
        self._mag = np.zeros(3)
        self._pressure_hpa = math.nan
        self._gps: GpsFix | None = None
        self._home: Geodetic | None = None
        self.on_setpoint: Callable[[Setpoint, int], None] | None = None
        """Called with every accepted setpoint and its time of receipt, if set."""
        self.on_message: Callable[[Message], None] | None = None
        """Called with every text for the operator, if set."""

    # --- towards the plant

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Take one tick's sensors and return the motor commands until the next."""
        estimate = self._estimator.step(sample)
        self._sample, self._estimate = sample, estimate
        if sample.mag is not None:
            self._mag = sample.mag
        if sample.pressure_hpa is not None:
            self._pressure_hpa = sample.pressure_hpa
        if sample.gps is not None:
            self._gps = sample.gps
        if self._home is None and self._estimator.origin is not None:
            self._set_home(estimate)
        self._handle(Event.READY if estimate.healthy else Event.NOT_READY)
        idle = self._output is _IDLE
        for due in self._watch.events(
            self._flight, sample.time_us, sample.battery.remaining, idle=idle
        ):
            if isinstance(due, Message):
                self._say(due)
            else:
                self._handle(due)
        self._output = self._control(estimate)
        self._detect_ground(estimate)
        armed = self._flight.phase >= Phase.GROUND
        return ActuatorControls(sample.time_us, self._output.motors, armed)

    def _control(self, estimate: Estimate) -> Output:
        phase, guidance = self._flight.phase, self._guidance
        if phase < Phase.GROUND:
            return self._rest(estimate)
        if phase is Phase.GROUND and not guidance.wants_to_lift(self._setpoint):
            guidance.stand()
            return self._rest(estimate)
        demand = guidance.demand(estimate, self._setpoint)
        climb = guidance.climb_limit(phase, estimate)
        if climb is not None:
            demand = _limit_climb(demand, climb)
        self._demand = demand
        return cascade(
            _triple(estimate.position),
            _triple(estimate.velocity),
            _quadruple(estimate.quaternion),
            _triple(estimate.angular_velocity),
            demand,
            self._memory,
            self._gains,
            TICK_S,
        )

    def _rest(self, estimate: Estimate) -> Output:
        """Motors at idle; nothing may wind up against the floor."""
        reset_integrals(self._memory)
        self._demand = Demand(_triple(estimate.position), (0.0, 0.0, 0.0), math.nan, 0.0)
        return _IDLE

    def _detect_ground(self, estimate: Estimate) -> None:
        if self._flight.phase is Phase.GROUND:
            if self._land_detector.lifted(estimate, self._output.thrust):
                self._handle(Event.LIFTED)
        elif self._flight.phase is Phase.AIR:
            descending = self._output.velocity[2] > 0.0
            if self._land_detector.landed(estimate, self._output.thrust, descending):
                self._handle(Event.LANDED)
            elif self._guidance.takeoff_done(estimate):
                self._handle(Event.TAKEOFF_DONE)

    # --- commander

    def _handle(self, event: Event) -> Result:
        before = self._flight
        step = transition(before, event)
        self._flight = step.flight
        if step.text is not None:
            self._say(step.text)
        if step.flight.mode is not before.mode and self._estimate is not None:
            self._guidance.enter(step.flight.mode, self._estimate)
        armed_now = before.phase < Phase.GROUND <= step.flight.phase
        if armed_now and self._estimate is not None:
            self._watch.armed()
            self._set_home(self._estimate)
            self._guidance.enter(step.flight.mode, self._estimate)
        return step.result

    def _say(self, message: Message) -> None:
        self._messages.append(message)
        if self.on_message is not None:
            self.on_message(message)

    def _set_home(self, estimate: Estimate) -> None:
        if self._estimator.origin is not None:
            self._home = local_to_geodetic(estimate.position, self._estimator.origin)
            self._guidance.at_home(estimate)

    def _read_gains(self) -> None:
        self._gains = Gains.from_parameters(self._parameters.__getitem__)

    @property
    def _now_us(self) -> int:
        return self._sample.time_us if self._sample is not None else 0

    # --- towards MAVLink (port.AutopilotPort)

    @property
    def parameters(self) -> Parameters:
        """The parameter store."""
        return self._parameters

    @property
    def estimator(self) -> Estimator:
        """The estimator, for consistency checks."""
        return self._estimator

    @property
    def flight(self) -> Flight:
        """The commander's state."""
        return self._flight

    def take_messages(self) -> list[Message]:
        """Return texts for the operator since the last call."""
        taken, self._messages = self._messages, []
        return taken

    def arm(self, *, force: bool) -> Result:
        """Ask to arm. Force skips the offboard check, never the estimator's health."""
        blind = self._flight.mode is Mode.OFFBOARD and not self._watch.setpoint_fresh(self._now_us)
        return self._handle(Event.ARM_BLIND if blind and not force else Event.ARM)

    def disarm(self, *, force: bool) -> Result:
        """Ask to disarm; force = kill, also in the air."""
        return self._handle(Event.KILL if force else Event.DISARM)

    def takeoff(self, altitude_m: float | None) -> Result:
        """Ask to climb to a height above home [m]; None = MIS_TAKEOFF_ALT."""
        default = self._parameters["MIS_TAKEOFF_ALT"]
        self._guidance.takeoff_altitude_m = default if altitude_m is None else altitude_m
        if altitude_m is None:
            text = f"Using default takeoff altitude: {default:.1f} m"
            self._say(Message(Severity.INFO, text))
        return self._handle(Event.TAKEOFF)

    def set_mode(self, mode: Mode) -> Result:
        """Ask for a mode."""
        if mode is Mode.OFFBOARD:
            fresh = self._watch.setpoint_fresh(self._now_us)
            return self._handle(Event.OFFBOARD if fresh else Event.OFFBOARD_BLIND)
        if mode is Mode.TAKEOFF:
            return self.takeoff(None)
        return self._handle(_MODE_EVENT[mode])

    def set_home_here(self) -> Result:
        """Make the present position home."""
        if self._estimate is None or self._estimator.origin is None:
            return Result.TEMPORARILY_REJECTED
        self._set_home(self._estimate)
        return Result.ACCEPTED

    def offer_setpoint(self, setpoint: Setpoint, time_us: int) -> None:
        """Hand over a valid offboard setpoint, received at `time_us` of simulated time."""
        self._setpoint = setpoint
        self._watch.setpoint(time_us)
        if self.on_setpoint is not None:
            self.on_setpoint(setpoint, time_us)

    def gcs_heartbeat(self, time_us: int) -> None:
        """A ground station was heard."""
        self._watch.gcs_heartbeat(time_us)

    def state(self) -> AutopilotState:
        """Return the snapshot after the newest tick. Raises RuntimeError before the first."""
        sample, estimate = self._sample, self._estimate
        if sample is None or estimate is None:
            raise RuntimeError("no tick yet: the autopilot has no state")
        demand, output = self._demand, self._output
        return AutopilotState(
            time_us=sample.time_us,
            estimate=estimate,
            status=self._status(),
            setpoint=Setpoint(
                np.array(demand.position),
                np.array(output.velocity),
                demand.yaw,
                demand.yaw_rate,
            ),
            attitude_setpoint=np.array(output.attitude),
            rate_setpoint=np.array(output.rates),
            thrust_setpoint=output.thrust,
            motors=output.motors,
            accel=sample.accel,
            gyro=sample.gyro,
            mag=self._mag,
            pressure_hpa=self._pressure_hpa,
            temperature_c=sample.temperature_c,
            battery=sample.battery,
            gps=self._gps,
            home=self._home,
            origin=self._estimator.origin,
        )

    def _status(self) -> CommanderStatus:
        flight = self._flight
        arming = (Arming.BOOT, Arming.STANDBY, Arming.ARMED, Arming.ARMED)[flight.phase]
        if flight.phase is Phase.AIR:
            if flight.mode is Mode.TAKEOFF:
                landed = Landed.TAKEOFF
            elif flight.mode is Mode.LAND:
                landed = Landed.LANDING
            else:
                landed = Landed.IN_AIR
        else:
            landed = Landed.ON_GROUND
        return CommanderStatus(arming, flight.mode, flight.intended, landed, flight.failsafe)


def _limit_climb(demand: Demand, limit: float) -> Demand:
    """Return the demand with its climb rate limited [m/s, up]; a height becomes that rate."""
    wanted = demand.velocity[2]
    down = -limit if math.isnan(wanted) else max(wanted, -limit)
    position = (demand.position[0], demand.position[1], math.nan)
    return Demand(
        position, (demand.velocity[0], demand.velocity[1], down), demand.yaw, demand.yaw_rate
    )


def _triple(v: Vector) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def _quadruple(v: Vector) -> tuple[float, float, float, float]:
    return float(v[0]), float(v[1]), float(v[2]), float(v[3])

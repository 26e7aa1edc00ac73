"""The built-in autopilot: sensors in, motor commands out, PX4's behaviour towards its clients."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from airl_mav.control.controller import Controller
from airl_mav.control.demand import AnyDemand, AttitudeDemand, RateDemand
from airl_mav.control.gains import Gains
from airl_mav.control.mixer import Motors
from airl_mav.core.constants import TICK_HZ, TICK_S, US_PER_S
from airl_mav.core.frames import Geodetic, geodetic_to_local, local_to_geodetic
from firmware_sim.autopilot.auto_disarm import AutoDisarm
from firmware_sim.autopilot.autopilot_state import (
    WITH_STICKS,
    Arming,
    AutopilotState,
    CommanderStatus,
    Landed,
    Message,
    Mode,
    Result,
    Setpoint,
    Severity,
)
from firmware_sim.autopilot.commander import READINESS, Ask, Event, Flight, Phase, transition
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.estimator import Estimator, NewFilter
from firmware_sim.autopilot.failsafes.conditions import FenceBreach
from firmware_sim.autopilot.failsafes.framework import NO_INTERVENTION, Intervention
from firmware_sim.autopilot.failsafes.supervisor import Supervisor
from firmware_sim.autopilot.filter_kernel import KernelFilter
from firmware_sim.autopilot.guidance import Guidance
from firmware_sim.autopilot.land_detector import LandDetector
from firmware_sim.autopilot.manual_control import ManualControl, Source, Sticks
from firmware_sim.autopilot.modes.interface import here
from firmware_sim.autopilot.navigation.flown_item import Situation
from firmware_sim.autopilot.navigation.navigator import Navigator
from firmware_sim.autopilot.navigation.plan import Plans
from firmware_sim.autopilot.navigation.progress import progress
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.autopilot.port import Failures, LogStore, NoLogs
from firmware_sim.autopilot.requests import FollowedTarget, Place, Request
from firmware_sim.interfaces import ActuatorControls, GpsFix, SensorSample, Truth

_STILL: Motors = (0.0, 0.0, 0.0, 0.0)

# Bound once: looking up a member of an enumeration at every tick is slow.
_GROUND, _AIR = Phase.GROUND, Phase.AIR

REFUSAL_US = 2 * US_PER_S
"""A setpoint that was refused within this time explains the loss of offboard [µs]."""


class BuiltinAutopilot:
    """Implements `FlightController` towards the plant and `port.AutopilotPort` to MAVLink."""

    rate_hz = TICK_HZ

    def __init__(self, parameters: Parameters, new_filter: NewFilter = KernelFilter) -> None:
        """Boot: not armable until the estimator, whose filter `new_filter` makes, has converged."""
        self.parameters = parameters
        """The parameter store."""
        self.plans = Plans()
        """The mission, the geofence and the rally points that are stored aboard."""
        value = parameters.value
        self.estimator = Estimator(value, new_filter)
        """For consistency checks."""
        self._state = self.estimator.state
        self._guidance = Guidance(value, self._say)
        self._navigator = Navigator(self.plans, value, self)
        self._guidance.context.return_place = self._return_place
        self._manual_control = ManualControl(value)
        self.supervisor = Supervisor(value, self.estimator)
        """Failsafes and pre-arm checks."""
        self._auto_disarm = AutoDisarm(value)
        self._land_detector = LandDetector(value)
        self._controller = Controller(Gains.from_parameters(value), TICK_S)
        parameters.on_change(self._parameters_changed)
        self.flight = Flight()
        """The commander's state."""
        self._status = _status(self.flight)
        self._messages: list[Message] = []
        self._refusal = ("", 0)
        """Why a setpoint was refused last, and when [µs]."""
        self._demand: AnyDemand | None = None
        """What is being flown; None = the motors are stopped."""
        self._motors = _STILL
        self.sample: SensorSample | None = None
        """The newest tick's sensors; None before the first."""
        self._mag = np.zeros(3)
        self._pressure_hpa = math.nan
        self._gps: GpsFix | None = None
        self._home: Geodetic | None = None
        self._armed_us = self._takeoff_us = 0
        self._home_is_chosen = False
        """Whether a client or a mission has placed home: arming does not move it."""
        self._snapshot: AutopilotState | None = None
        self.failures: Failures | None = None
        """What makes parts fail at a client's word; set by whoever simulates them."""
        self.logs: LogStore = NoLogs()
        """Where clients find the flight logs; whoever writes them sets it."""
        self.on_setpoint: Callable[[Setpoint, int], None] | None = None
        """Called with every accepted setpoint and its time of receipt, if set."""
        self.on_message: Callable[[Message], None] | None = None
        """Called with every text for the operator, if set."""
        self._say_all(parameters.take_texts())

    # --- towards the plant

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Take one tick's sensors and return the motor commands until the next."""
        time_us, supervisor, sensors = sample.time_us, self.supervisor, self.supervisor.sensors
        self.estimator.step(sensors.trusted(sample) if sensors.distrusted else sample)
        self.sample, self._snapshot = sample, None
        if sample.mag is not None:
            self._mag = sample.mag
            sensors.mag.take(sample)
        if sample.pressure_hpa is not None:
            self._pressure_hpa = sample.pressure_hpa
            sensors.baro.take(sample)
        if sample.gps is not None:
            self._gps = sample.gps
            sensors.gps.take(sample)
        if self._home is None and self.estimator.origin is not None:
            self._set_home()
        readiness = READINESS[self.flight.phase][self.estimator.healthy]
        if readiness is not None:
            self._handle(readiness)
        idle = self._demand is None
        if time_us >= supervisor.next_us:
            self._look()
            self._obey(NO_INTERVENTION)
        due = self._auto_disarm.event(self.flight, time_us, idle=idle)
        if due is not None:
            self._handle(due)
        if time_us >= self._navigator.due_us:
            self._navigate()
        if self._manual_control.was_heard:
            self._guidance.context.sticks = self._manual_control.sticks(time_us)
        self._demand = self._guidance.demand(self._state, self.flight.phase, time_us)
        if self._demand is not None:
            self._motors = self._controller.fly(self._state, self._demand)
        elif not idle:
            self._motors = _STILL
            self._controller.rest()
        self._detect_ground(time_us)
        return ActuatorControls(time_us, self._motors, self.flight.phase >= _GROUND)

    def _navigate(self) -> None:
        situation, flight = self._situation(), self.flight
        if situation is None:
            return
        navigator, context = self._navigator, self._guidance.context
        armed = flight.phase >= _GROUND
        navigator.step(situation, flight.mode, self._fenced_place, armed=armed)
        context.triplet, context.mission_over = navigator.triplet, navigator.mission_over
        reports = self.supervisor.watch.reports
        reports.fence = FenceBreach(*navigator.fence.status.breached)
        reports.mission_missing = not navigator.mission.valid
        reports.mission_finished = navigator.mission_over

    def _fenced_place(self) -> Geodetic:
        """Return where the vehicle is, by GF_SOURCE: the estimate, or the GPS."""
        origin = self.estimator.origin
        by_gps = self.parameters.value("GF_SOURCE") > 0.0 or origin is None
        if self._gps is not None and by_gps:
            return self._gps.position
        if origin is None:
            raise RuntimeError("no fix yet: the vehicle is nowhere on the globe")
        return local_to_geodetic(self._state[P:V], origin)

    def _return_place(self) -> Place:
        """Return where Return goes: home, or what RTL_TYPE prefers."""
        context, now = self._guidance.context, self._situation()
        if now is not None:
            goal = self._navigator.return_to(
                now.home, local_to_geodetic(self._state[P:V], now.origin)
            )
            if goal != now.home:
                return Place(now.local(goal), context.home_yaw)
        return Place(context.home, context.home_yaw)

    def _situation(self) -> Situation | None:
        """Return what missions go by; None before the first fix."""
        sample, home, origin = self.sample, self._home, self.estimator.origin
        if sample is None or home is None or origin is None:
            return None
        place = here(self._state)
        landed = self.flight.phase is not _AIR
        return Situation(sample.time_us, place.position, place.yaw, landed, home, origin)

    def _detect_ground(self, time_us: int) -> None:
        phase = self.flight.phase
        if phase is _AIR:
            control = self._controller
            if self._land_detector.landed(
                self._state, time_us, control.thrust, descending=control.descending
            ):
                self._handle(Event.LANDED)
            elif self._guidance.is_done(self._state):
                self._handle(Event.MODE_DONE)
        elif phase is _GROUND and self._land_detector.lifted(self._state, self._controller.thrust):
            self._handle(Event.LIFTED)

    # --- commander

    def _handle(self, event: Ask | Event, request: Request | None = None) -> Result:
        step = transition(self.flight, event)
        if step.text is not None:
            self._say(step.text)
        flown = self.flight.mode
        asked = isinstance(event, Ask) and step.result is Result.ACCEPTED
        if asked and step.flight.phase >= _GROUND:
            # A failsafe may insist, or yield to the user.
            self._become(step.flight, step.flight.mode)
            self._obey(Intervention(mode_chosen=True), flown, request)
        else:
            self._become(step.flight, flown, request if asked else None)
        return step.result

    def _become(self, flight: Flight, flown: Mode, request: Request | None = None) -> None:
        """Take a new state; `flown` is the mode that guidance is in, `request` the user's."""
        before = self.flight
        self.flight, self._status = flight, _status(flight)
        self._snapshot = None
        if flight.failsafe and before.mode is Mode.OFFBOARD and not before.failsafe:
            self._explain_loss()
        if self.sample is None:
            return
        if flight.mode is not flown or request is not None:
            self._navigator.due_us = 0
            self._guidance.enter(flight.mode, self._state, request)
        if flight.phase is not before.phase:
            self._note_times(flight.phase)
            self.supervisor.next_us = 0
        if before.phase < _GROUND <= flight.phase:
            self._auto_disarm.armed()
            if not self._home_is_chosen:
                self._set_home()
            self._guidance.enter(flight.mode, self._state)

    def _look(self) -> None:
        if self.sample is not None:
            self._say_all(self.supervisor.look(self.sample, self.flight))

    def _obey(
        self,
        intervention: Intervention,
        flown: Mode | None = None,
        request: Request | None = None,
    ) -> None:
        """Do what the failsafes decide; see `_become`."""
        flown, asked = self.flight.mode if flown is None else flown, self.flight.mode
        decision = self.supervisor.decide(self._now_us, self.flight, intervention)
        if decision is None:
            return
        if decision.text is not None:
            self._say(decision.text)
        flight = decision.flight
        request = request if flight.mode is asked else None
        if flight != self.flight or flight.mode is not flown or request is not None:
            self._become(flight, flown, request)
        if decision.disarm:
            self._handle(Event.FAILSAFE_DISARM)

    def _note_times(self, phase: Phase) -> None:
        """Note when it was armed and took off, and forget both once it is disarmed."""
        now_us = self._now_us
        if phase < _GROUND:
            self._armed_us = self._takeoff_us = 0
        elif self._armed_us == 0:
            self._armed_us = now_us
        if phase is _AIR and self._takeoff_us == 0:
            self._takeoff_us = now_us

    def _explain_loss(self) -> None:
        """Say which setpoints were refused lately, if any."""
        reason, refused_us = self._refusal
        if reason and self._now_us - refused_us <= REFUSAL_US:
            self._say(Message(Severity.WARNING, f"Offboard setpoints refused: {reason}"))

    def _say(self, message: Message) -> None:
        self._messages.append(message)
        if self.on_message is not None:
            self.on_message(message)

    def _set_home(self) -> None:
        origin = self.estimator.origin
        if origin is not None:
            self._home = local_to_geodetic(self._state[P:V], origin)
            self._guidance.at_home(self._state)
            self._guidance.context.home_amsl_m = self._home.altitude_m
            self._snapshot = None

    def _parameters_changed(self) -> None:
        self._controller.set_gains(Gains.from_parameters(self.parameters.value))
        self.supervisor.read_parameters()
        self._say_all(self.parameters.take_texts())

    def _say_all(self, messages: Sequence[Message]) -> None:
        for message in messages:
            self._say(message)

    @property
    def _now_us(self) -> int:
        return self.sample.time_us if self.sample is not None else 0

    # --- towards MAVLink (port.AutopilotPort)

    @property
    def ticks_to_motors(self) -> int:
        """After how many more ticks the motors reflect what is demanded in the next one."""
        return self._controller.ticks_to_motors

    @property
    def internals(self) -> BuiltinAutopilot:
        """Itself: it shows everything."""
        return self

    def use_truth(self, truth: Callable[[], Truth]) -> None:
        """Ignore the true state: it flies by its estimate alone."""

    def close(self) -> None:
        """Do nothing: it holds nothing."""

    def report(self, message: Message) -> None:
        """Say something to the operator that does not come from flying."""
        self._say(message)

    def take_messages(self) -> list[Message]:
        """Return texts for the operator since the last call."""
        taken, self._messages = self._messages, []
        return taken

    def arm(self, *, force: bool) -> Result:
        """Ask to arm. PX4 runs its checks although a client asks by force, and so do we."""
        del force
        if self.sample is None or self.flight.phase >= _GROUND:
            return self._handle(Event.ARM)
        if self.flight.mode is Mode.MISSION:
            valid = self._navigator.mission_is_valid(self._situation())
            self.supervisor.watch.reports.mission_missing = not valid
        self._look()
        self._obey(NO_INTERVENTION)
        refusals = self.supervisor.refusals(self.sample, self.flight)
        self._say_all(refusals)
        return self._handle(Event.ARM_UNREADY if refusals else Event.ARM)

    def terminate(self) -> Result:
        """Ask to stop the motors for good (MAV_CMD_DO_FLIGHTTERMINATION)."""
        return self._handle(Ask(Mode.TERMINATION))

    def disarm(self, *, force: bool) -> Result:
        """Ask to disarm; force = kill, also in the air."""
        return self._handle(Event.KILL if force else Event.DISARM)

    def takeoff(self, altitude_m: float | None) -> Result:
        """Ask to climb to a height above home [m]; None = MIS_TAKEOFF_ALT."""
        context, height = self._guidance.context, self._guidance.context.height(self._state)
        if altitude_m is None:
            default = self.parameters["MIS_TAKEOFF_ALT"]
            self._say(Message(Severity.INFO, f"Using default takeoff altitude: {default:.1f} m"))
            # In flight, PX4 climbs from where the vehicle is.
            altitude_m = default + (height if self.flight.phase is _AIR else 0.0)
        if altitude_m < (height if self.flight.phase is _AIR else 0.0):
            self._say(Message(Severity.CRITICAL, "Already higher than takeoff altitude"))
            altitude_m = height if self.flight.phase is _AIR else 0.0
        context.takeoff_altitude_m = altitude_m
        return self._ask(Mode.TAKEOFF)

    def set_mode(self, mode: Mode, request: Request | None = None) -> Result:
        """Ask for a mode, with what it takes beyond its name."""
        if mode is Mode.TAKEOFF:
            return self.takeoff(None)
        return self._ask(mode, request)

    def _ask(self, mode: Mode, request: Request | None = None) -> Result:
        if mode is Mode.MISSION:
            valid = self._navigator.mission_is_valid(self._situation())
            self.supervisor.watch.reports.mission_missing = not valid
        self._look()
        self._obey(NO_INTERVENTION)
        available = self.supervisor.available(mode)
        if mode in WITH_STICKS:
            available = available and self._manual_control.sticks(self._now_us) is not None
        return self._handle(Ask(mode, available), request)

    def change_speed(self, speed_m_s: float) -> None:
        """Set the horizontal speed of the present automatic mode [m/s]."""
        self._guidance.context.travel.speed_m_s = speed_m_s

    def set_home_here(self) -> Result:
        """Make the present position home."""
        if self.estimator.origin is None:
            return Result.TEMPORARILY_REJECTED
        self._set_home()
        self._home_is_chosen = False
        return Result.ACCEPTED

    def start_mission(self, index: int) -> Result:
        """Arm and fly the mission from an item on (MAV_CMD_MISSION_START); -1 = as it stands."""
        if not self._navigator.mission_is_valid(self._situation()):
            self.say(Message(Severity.CRITICAL, "Mission start denied! No valid mission"))
            return Result.DENIED
        if not -1 <= index < len(self.plans.mission):
            return Result.DENIED
        self._handle(Ask(Mode.MISSION))
        if self.flight.phase < _GROUND and self.arm(force=False) is not Result.ACCEPTED:
            return Result.TEMPORARILY_REJECTED
        if index >= 0:
            self.plans.set_current(index)
        return Result.ACCEPTED

    # --- towards the mission (navigation.executor.Crew)

    def say(self, message: Message) -> None:
        """Tell the operator."""
        self._say(message)

    def set_home(self, place: Geodetic | None) -> Result:
        """Move home; None = to the present place."""
        origin = self.estimator.origin
        if place is None or origin is None:
            return self.set_home_here()
        self._home, self._home_is_chosen = place, True
        north, east, down = geodetic_to_local(place, origin).tolist()
        self._guidance.context.home = north, east, down
        self._guidance.context.home_amsl_m = place.altitude_m
        self._snapshot = None
        return Result.ACCEPTED

    def look_at(self, place: Geodetic | None) -> None:
        """Turn to a place while a mission is flown; None = to none."""
        roi = self._navigator.mission.roi
        if place is None:
            roi.reset()
        else:
            roi.look_at(place)

    def return_to_launch(self) -> None:
        """End the mission and return."""
        self.say(Message(Severity.INFO, "Returning to launch"))
        self.set_mode(Mode.RETURN)

    def offer_setpoint(self, setpoint: Setpoint, time_us: int) -> None:
        """Hand over a valid offboard setpoint, received at `time_us` of simulated time."""
        self._guidance.context.setpoint = setpoint
        self.supervisor.setpoint(setpoint, time_us)
        if self.on_setpoint is not None:
            self.on_setpoint(setpoint, time_us)

    def offer_attitude(self, demand: AttitudeDemand | RateDemand, time_us: int) -> None:
        """Hand over an offboard setpoint of attitude or body rates, received at `time_us`."""
        self._guidance.context.setpoint = demand
        self.supervisor.setpoint(None, time_us)

    def refuse_setpoint(self, reason: str, time_us: int) -> None:
        """Note why an offboard setpoint was refused: the failsafe that follows names it."""
        self._refusal = reason, time_us

    def manual_control(self, sticks: Sticks, source: Source, time_us: int) -> None:
        """Hand over the pilot's sticks, received at `time_us` of simulated time."""
        moved = self._manual_control.offer(sticks, source, time_us)
        self.supervisor.watch.hear_pilot(time_us)
        flown, override = self.flight.mode, int(self.parameters["COM_RC_OVERRIDE"])
        bit = 2 if flown is Mode.OFFBOARD else 1
        takes_over = moved and override & bit and flown not in WITH_STICKS
        if takes_over and self.flight.failsafe:
            self._obey(Intervention(sticks_moved=True))
            return
        if takes_over and self.flight.phase is _AIR and flown is not Mode.ORBIT:
            self._handle(Ask(Mode.POSITION))
            self._say(Message(Severity.INFO, "Pilot took over using sticks"))

    def follow(self, target: FollowedTarget) -> None:
        """Hand over where the target is that Follow follows."""
        self._guidance.context.target = target

    def gcs_heartbeat(self, time_us: int) -> None:
        """A ground station was heard."""
        self.supervisor.gcs_heartbeat(time_us)

    def state(self) -> AutopilotState:
        """Return the snapshot after the newest tick. Raises RuntimeError before the first."""
        if self._snapshot is not None:
            return self._snapshot
        sample, demand = self.sample, self._demand
        if sample is None:
            raise RuntimeError("no tick yet: the autopilot has no state")
        estimate = self.estimator.estimate()
        attitude, rates, velocity, thrust = self._controller.setpoints()
        if demand is None or isinstance(demand, AttitudeDemand | RateDemand):
            setpoint = Setpoint(estimate.position, velocity, math.nan, 0.0)
        else:
            position = np.array(demand.position)
            setpoint = Setpoint(position, velocity, demand.yaw, demand.yaw_rate)
        self._snapshot = AutopilotState(
            time_us=sample.time_us,
            estimate=estimate,
            status=self._status,
            setpoint=setpoint,
            attitude_setpoint=attitude,
            rate_setpoint=rates,
            thrust_setpoint=thrust,
            motors=self._motors,
            accel=sample.accel,
            gyro=sample.gyro,
            mag=self._mag,
            pressure_hpa=self._pressure_hpa,
            temperature_c=sample.temperature_c,
            battery=sample.battery,
            gps=self._gps,
            home=self._home,
            origin=self.estimator.origin,
            orbit=self._guidance.context.orbit if self.flight.mode is Mode.ORBIT else None,
            armed_us=self._armed_us,
            takeoff_us=self._takeoff_us,
            mission=progress(self.plans),
            fence=self._navigator.fence.status,
        )
        return self._snapshot


def _status(flight: Flight) -> CommanderStatus:
    arming = (Arming.BOOT, Arming.STANDBY, Arming.ARMED, Arming.ARMED)[flight.phase]
    if flight.phase is not Phase.AIR:
        landed = Landed.ON_GROUND
    elif flight.mode is Mode.TAKEOFF:
        landed = Landed.TAKEOFF
    elif flight.mode is Mode.LAND:
        landed = Landed.LANDING
    else:
        landed = Landed.IN_AIR
    return CommanderStatus(arming, flight.mode, flight.intended, landed, flight.failsafe)

"""Built-in autopilot: sensors in, motor commands out, PX4 behaviour towards clients."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from airl_mav.control.demand import AnyDemand, AttitudeDemand, Gains, RateDemand
from airl_mav.control.loops import Motors
from airl_mav.control.memory import ticks_to_motors
from airl_mav.core import constants, frames
from firmware_sim import interfaces
from firmware_sim.autopilot import autopilot_state, commander
from firmware_sim.autopilot.climb import DECIDE_US, climb_record
from firmware_sim.autopilot.error_state import RATES, KernelFilter, NewFilter, Q
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import MavlinkEvent as Told
from firmware_sim.autopilot.failsafes.framework import NO_INTERVENTION, Intervention, Supervisor
from firmware_sim.autopilot.flight_commander import AutoDisarm, Commanded, FlightCommander
from firmware_sim.autopilot.flight_modes import WITH_STICKS, Mode
from firmware_sim.autopilot.guidance import Guidance, Home
from firmware_sim.autopilot.land_detector import LandDetector
from firmware_sim.autopilot.modes import interface
from firmware_sim.autopilot.navigation.navigator import IDLE_US, Navigator, Whereabouts
from firmware_sim.autopilot.navigation.plan import NavigationState, Plans
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.autopilot.sensor_monitor import NewestSensors
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.engine.controller import Controller
from firmware_sim.engine.record import LANDING, LIFT_OFF, NOTHING
from firmware_sim.engine.ticks import ALIGN, CLIMBED, REPEATED_BITS, control_record, detect_record

if TYPE_CHECKING:
    from firmware_sim.fault_timeline import ClientFaults

# Bound once: looking up an enum member in every tick is slow.
_GROUND, _AIR = commander.FlightPhase.GROUND, commander.FlightPhase.AIR

MAX_TEXTS = 100
"""Maximum number of texts in `BuiltinAutopilot.said`."""


class BuiltinAutopilot:
    """Autopilot: `FlightController` towards the plant, commands in and state out towards MAVLink.

    Every call happens between two ticks, on one thread.
    """

    rate_hz = constants.TICK_HZ

    def __init__(self, parameters: Parameters, new_filter: NewFilter = KernelFilter) -> None:
        """Boot. Arming requires convergence of the estimator, whose filter `new_filter` creates."""
        self.parameters = parameters
        """Parameter store."""
        self.plans = Plans()
        """Mission, geofence and rally points stored on board."""
        self.plans.has_state = parameters.release.mission_state
        value = parameters.value
        self.estimator = Estimator(value, new_filter)
        """Estimator, public for consistency checks."""
        self.record = record = self.estimator.record
        """Record of samples, estimate and control loops."""
        self._state = self.estimator.state
        self._guidance = Guidance(value, self.say, record)
        self._navigator = Navigator(self.plans, value, self)
        self._guidance.context.return_place = self._return_place
        self._guidance.context.missions = self._navigator.missions
        self._manual_control = interface.ManualControl(value)
        self._events: list[Told] = []
        self.supervisor = Supervisor(value, self.estimator, parameters.release, self._events.append)
        """Failsafe and pre-arm checks."""
        self._auto_disarm = AutoDisarm(value)
        self._land_detector = LandDetector(value, record)
        self._controller = Controller(Gains.from_parameters(value), record)
        self._memory: frames.Vector = record["memory"][0]
        parameters.on_change(self._parameters_changed)
        self._messages: list[autopilot_state.OperatorText] = []
        self.said = deque[autopilot_state.OperatorText](maxlen=MAX_TEXTS)
        """Newest operator texts, for `dmesg`."""
        self._demand: AnyDemand | None = None
        """Active demand; None = the motors are stopped."""
        self._taken_us = -1
        """Time of the newest sample in the estimator [µs]."""
        self._due_us: float = 0
        """Time of the next decision [µs]."""
        self._decided_on: tuple[commander.CommanderState | None, object] = (None, None)
        """Commander state and setpoint at the newest decision."""
        self._decided_healthy = 0
        """Health of the estimator at the newest decision, 0 or 1."""
        self._is_steady = False
        """True if the demand in the air is constant until something changes."""
        self._told: tuple[object, ...] = ()
        self._unsaid = 0
        """Client-visible state and number of queued texts and events at the newest decision."""
        self._has_news = False
        """True if a decision has changed client-visible state: the next tick ends the stretch."""
        self._navigated_on: tuple[object, ...] = ()
        """State, home and change counters of plans and parameters at the newest navigation."""
        self._newest = NewestSensors(record)
        self._home = Home(self.estimator, self._guidance)
        self._whereabouts = Whereabouts(self.estimator, self._newest, self._home, value)
        self._commander = FlightCommander(
            Commanded(
                self.supervisor, self._guidance, self._navigator, self._auto_disarm, self._home
            ),
            self._newest,
            self._state,
            self.say,
        )
        self._snapshot: AutopilotState | None = None
        self._unfused: set[str] = set()
        """Kinds of client sensors that were reported as not fused."""
        self.failures: ClientFaults | None = None
        """Failure injection for client requests; None: not supported. Set by the simulation."""
        self.logs = interfaces.LogStore()
        """Flight logs for clients. Set by the log writer."""
        self.on_setpoint: Callable[[autopilot_state.Wire, int], None] | None = None
        """Callback for accepted setpoints: setpoint as received, time of receipt [µs]."""
        self.on_message: Callable[[autopilot_state.OperatorText], None] | None = None
        self.body_by = None
        """Callback for operator texts."""
        self._say_all(parameters.take_texts())

    # --- towards the plant

    def step(self, sample: interfaces.SensorSample) -> interfaces.ActuatorControls:
        """Process one tick's sensors; return the motor commands until the next tick."""
        self.take(sample)
        self.decide_if_due()
        # A climb that ends changes the demand within this tick.
        if climb_record(self.record):
            self._due_us = 0
            self.decide_if_due()
        if self._demand is not None:
            control_record(self.record)
        if detect_record(self.record):
            self._handle_detected()
        return interfaces.ActuatorControls(
            sample.time_us, self._motors, self._commander.flight.phase >= _GROUND
        )

    def take(self, sample: interfaces.SensorSample) -> None:
        """Update the estimate with one tick's sensors. Repeated calls have no effect."""
        # The tick may already be in the estimate from compiled ticks.
        if sample.time_us == self._taken_us:
            return
        sensors = self.supervisor.sensors
        sensors.take(sample)
        # Samples of failed sensors must not reach the estimator.
        self.estimator.step(sensors.trusted(sample) if sensors.distrusted else sample)
        self._taken_us, self._snapshot = sample.time_us, None
        self._newest.take(sample)
        ground = self.estimator.aiding.ground
        if ground is not None:
            self._guidance.context.ground = ground
            self._land_detector.see(ground)
        if sample.esc_outputs is not None:
            self.supervisor.watch.hear_escs(sample.time_us, self._motors, sample.esc_outputs)

    def decide(self) -> None:
        """Run commander, failsafes, navigator and modes, and update the demand."""
        time_us, supervisor = self._taken_us, self.supervisor
        if time_us < 0:
            return
        # Python aligns when a compiled tick only collects the sums.
        if not self.record["aligned"].item(0) and self.estimator.align():
            self._navigator.due_us = 0
        # Order: mode end, home, readiness, failsafes, navigation, then the demand.
        if self._commander.flight.phase is _AIR and self._guidance.is_done(self._state):
            self._commander.handle(commander.CommanderEvent.MODE_DONE)
        if self._home.place is None and self.estimator.origin is not None:
            # While armed, home stays at the place of arming.
            if self._commander.flight.phase < _GROUND:
                self._home.set_here()
            else:
                self._home.locate()
        readiness = commander.READINESS[self._commander.flight.phase][
            self.record["healthy"].item(0)
        ]
        if readiness is not None:
            self._commander.handle(readiness)
        looks = time_us >= supervisor.next_us
        if looks:
            self._commander.look()
        thrust = 0.0 if self._demand is None else getattr(self._demand, "thrust", 1.0)
        idle = self._land_detector.carries(thrust)
        due = self._auto_disarm.event(self._commander.flight, time_us, idle=idle)
        if due is not None:
            self._commander.handle(due)
        if looks or time_us >= self._navigator.due_us:
            self._navigate()
        if self._manual_control.was_heard:
            self._guidance.context.sticks = self._manual_control.sticks(time_us)
        self._demand = self._guidance.demand(self._state, self._commander.flight.phase, time_us)
        self._controller.command(self._demand)

    # --- compiled ticks

    def decide_if_due(self) -> float:
        """Decide if due or if new input has arrived; return the time of the next decision [µs]."""
        flight, setpoint = self._decided_on
        healthy = self.record["healthy"].item(0)
        changed = flight is not self._commander.flight or healthy != self._decided_healthy
        due_us = min(self._due_us, self.supervisor.next_us, self._navigator.due_us)
        due, follows = self._taken_us >= due_us, setpoint is self._guidance.context.setpoint
        # A new setpoint alone does not need the whole decision.
        if not (changed or due or follows):
            follows = self._follow()
        if changed or not follows or (due and not self._finds_nothing_new()):
            self.decide()
            self._prepare()
            self._has_news = self._look_for_news()
        return self._taken_us if self._has_news else self._due_us

    def _is_undisturbed(self) -> bool:
        """Return whether the newest decision holds apart from setpoints and failsafe checks."""
        # Any new text or event needs a full decision, so that clients see it at once.
        said = len(self._messages) + len(self._events) > self._unsaid
        if said or not self._is_steady or self._manual_control.was_heard:
            return False
        return self._home.place is not None and not self._guidance.is_done(self._state)

    def _follow(self) -> bool:
        """Apply the newest setpoint if nothing else has changed; return True if applied."""
        guidance = self._guidance
        # Changed inputs of the estimator need `_prepare`.
        if self.estimator.is_changed or not (guidance.is_steady(_AIR) and self._is_undisturbed()):
            return False
        self._demand = guidance.demand(self._state, _AIR, self._taken_us)
        self._controller.command(self._demand)
        self._decided_on = self._commander.flight, guidance.context.setpoint
        return True

    def _finds_nothing_new(self) -> bool:
        """Return whether only a failsafe check is due and its result is unchanged."""
        supervisor, flight = self.supervisor, self._commander.flight
        if not (self._is_undisturbed() and self._is_idle()):
            return False
        climb = self._guidance.context.climb
        # The mode must process the end of a climb.
        if climb.has_ended or self._due_us == 0:
            return False
        if not supervisor.is_unchanged(self._taken_us, flight):
            return False
        # Conditions are unchanged, but delays of failsafes run on.
        self._commander.obey(NO_INTERVENTION)
        if self._commander.flight is not flight:
            self._navigator.due_us = 0
            return False
        self._navigator.due_us = self._taken_us + IDLE_US
        self._due_us = min(supervisor.next_us, self._navigator.due_us)
        # Compiled code updates the demand of a climb.
        if climb.flies:
            self.record["climb_due_us"] = self._taken_us
        else:  # A mode may rely on the call: offboard detects a new setpoint type there.
            self._demand = self._guidance.demand(self._state, _AIR, self._taken_us)
            self._controller.command(self._demand)
            self._is_steady = self._guidance.is_steady(_AIR)
            if not self._is_steady:
                self._due_us = min(self._due_us, self._taken_us + DECIDE_US)
        return True

    def _look_for_news(self) -> bool:
        """Return whether clients need an update after the newest decision."""
        plans, waiting = self.plans, len(self._messages) + len(self._events)
        told = (
            *(self._commander.flight, self._guidance.destination, self._home.place),
            *(self.estimator.origin, self.supervisor.changes, plans.current, plans.reached),
            self.parameters.revision,
        )
        news = told != self._told
        if news:
            self._told = told
        said, self._unsaid = waiting > self._unsaid, waiting
        return news or said

    def _prepare(self) -> None:
        """Prepare the record for compiled ticks and set the time of the next decision."""
        self.estimator.prepare()
        self._decided_on = flight, _ = self._commander.flight, self._guidance.context.setpoint
        self._decided_healthy = self.record["healthy"].item(0)
        phase = flight.phase
        # The land detector looks for one transition at a time.
        self.record["detecting"] = (
            LANDING if phase is _AIR else LIFT_OFF if phase is _GROUND else NOTHING
        )
        self._due_us = min(
            self.supervisor.next_us, self._navigator.due_us, self._auto_disarm.due_us
        )
        steady = self._guidance.is_steady(phase) and not self._manual_control.was_heard
        self._is_steady = steady and phase is _AIR
        # A mode with a varying demand decides at its own rate.
        if not steady:
            self._due_us = min(self._due_us, self._taken_us + DECIDE_US)

    def fuse(self, sample: interfaces.SensorSample, left: int) -> None:
        """Fuse the measurements of a sample that a compiled tick leaves to Python.

        `left` has the bits of the remaining work, from `engine.ticks.estimate`.
        """
        sensors = self.supervisor.sensors
        sensors.repeated(sample.time_us, left, left >> REPEATED_BITS)
        self.estimator.fuse_rest(sensors.trusted(sample) if sensors.distrusted else sample)

    def flown(self, read: Callable[[], interfaces.SensorSample], event: int) -> bool:
        """Process the results of compiled ticks; return whether the commander's state has changed.

        `read` returns the newest sample, which is already in the estimate; `event` ended the ticks.
        """
        before, self._snapshot = self._commander.flight, None
        self._taken_us = self.estimator.flown()
        self._newest.follow(read)
        # Alignment and the end of a climb need a decision at once.
        if event in (ALIGN, CLIMBED):
            self._due_us = 0
        if self.record["detected"].item(0):
            self._handle_detected()
        news, self._has_news = self._has_news, False
        return news or self._commander.flight is not before

    @property
    def _motors(self) -> Motors:
        return self._controller.motors

    def _navigate(self) -> None:
        navigator, flight = self._navigator, self._commander.flight
        armed = flight.phase >= _GROUND
        if not armed:
            self._home.stands()
        # Nothing to navigate: look again after IDLE_US.
        if self._is_idle():
            navigator.due_us = self._taken_us + IDLE_US
            return
        situation = self._situation()
        if situation is None:
            navigator.due_us = self._taken_us + IDLE_US
        else:
            self._navigated_on = self._navigates_on()
            navigator.step(situation, flight.mode, self._whereabouts.fenced_place, armed=armed)
            navigator.tell(self._guidance.context, self.supervisor.watch.reports)

    def _navigates_on(self) -> tuple[object, ...]:
        changes = self.plans.changes, self.parameters.revision
        return self._commander.flight, self._home.place, *changes

    def _is_idle(self) -> bool:
        """Return whether the navigator has no work, as in its newest step."""
        return self._navigator.idle and self._navigates_on() == self._navigated_on

    def _return_place(self) -> interface.PositionYaw | None:
        """Return the destination of Return: home, or the place selected by RTL_TYPE."""
        context, now = self._guidance.context, self._situation()
        home = interface.PositionYaw(context.home, context.home_yaw)
        return home if now is None else self._navigator.return_place(now, home)

    def _situation(self) -> NavigationState | None:
        return self._whereabouts.situation(landed=self._commander.flight.phase is not _AIR)

    def _handle_detected(self) -> None:
        landed = self._commander.flight.phase is _AIR
        self._commander.handle(
            commander.CommanderEvent.LANDED if landed else commander.CommanderEvent.LIFTED
        )

    # --- texts

    def _look_anew(self, mode: Mode) -> None:
        """Run the failsafe checks and act on them before a client's mode request is answered."""
        if mode is Mode.MISSION:
            valid = self._navigator.mission_is_valid(self._situation())
            self.supervisor.watch.reports.mission_missing = not valid
        self._commander.look()

    def say(self, message: autopilot_state.OperatorText) -> None:
        """Send a text to the operator."""
        self._messages.append(message)
        self.said.append(message)
        if message.event is not None:
            self._events.append(message.event)
        if self.on_message is not None:
            self.on_message(message)

    def _parameters_changed(self) -> None:
        self._controller.set_gains(Gains.from_parameters(self.parameters.value))
        self._land_detector.read_parameters()
        self.estimator.is_changed = True
        self.supervisor.read_parameters()
        self._say_all(self.parameters.take_texts())

    def _say_all(self, messages: Sequence[autopilot_state.OperatorText]) -> None:
        for message in messages:
            self.say(message)

    @property
    def flight(self) -> commander.CommanderState:
        """Commander state."""
        return self._commander.flight

    @property
    def sample(self) -> interfaces.SensorSample | None:
        """Sensors of the newest tick; None before the first."""
        return self._newest.sample

    @property
    def _now_us(self) -> int:
        return max(0, self._taken_us)

    # --- towards MAVLink

    @property
    def attitude(self) -> frames.Vector:
        """Estimated attitude quaternion (4,) body -> NED."""
        attitude: frames.Vector = self._state[Q:RATES].copy()
        return attitude

    @property
    def ticks_to_motors(self) -> int:
        """Number of ticks after the next until the motors reflect its demand."""
        # Attitude and rate setpoints skip the outer loops, which add ticks.
        ticks, wanted = ticks_to_motors(self._memory), self._guidance.context.setpoint
        if isinstance(wanted, RateDemand):
            return 0
        return min(1, ticks) if isinstance(wanted, AttitudeDemand) else ticks

    @property
    def internals(self) -> BuiltinAutopilot:
        """The autopilot itself: all internals are accessible."""
        return self

    def use_truth(self, truth: Callable[[], interfaces.TrueState]) -> None:
        """Ignore the true state: the autopilot flies by its estimate."""

    def close(self) -> None:
        """Do nothing: there are no resources to release."""

    def take_messages(self) -> list[autopilot_state.OperatorText]:
        """Return texts for the operator since the last call."""
        taken, self._messages, self._unsaid = self._messages, [], 0
        return taken

    def take_events(self) -> list[Told]:
        """Return events since the last call."""
        taken = list(self._events)
        self._events.clear()
        self._unsaid = 0
        return taken

    def tell_checks(self) -> None:
        """Report all failing pre-arm checks again (MAV_CMD_RUN_PREARM_CHECKS)."""
        self.supervisor.tell_checks()

    def arm(self, *, force: bool) -> autopilot_state.Result:
        """Request arming. The pre-arm checks also run for a forced request, as in PX4."""
        del force
        # Without samples or when armed already, no check applies: the commander answers.
        if self.sample is None or self.flight.phase >= _GROUND:
            return self._commander.handle(commander.CommanderEvent.ARM)
        # Check now: the newest result may be up to a period old.
        self._look_anew(self.flight.mode)
        refusals = self.supervisor.refusals(self.sample, self.flight)
        self._say_all(refusals)
        return self._commander.handle(
            commander.CommanderEvent.ARM_UNREADY if refusals else commander.CommanderEvent.ARM
        )

    def terminate(self) -> autopilot_state.Result:
        """Request permanent motor stop (MAV_CMD_DO_FLIGHTTERMINATION)."""
        return self._commander.handle(commander.Ask(Mode.TERMINATION))

    def disarm(self, *, force: bool) -> autopilot_state.Result:
        """Request disarming; force = kill, also in the air."""
        return self._commander.handle(
            commander.CommanderEvent.KILL if force else commander.CommanderEvent.DISARM
        )

    def takeoff(
        self, altitude_m: float | None, place: tuple[float, float] | None = None
    ) -> autopilot_state.Result:
        """Request a take-off to a height above home [m] and a place, local NED north, east [m].

        Default height: MIS_TAKEOFF_ALT; default place: straight up.
        """
        flying = self.flight.phase is _AIR
        self._guidance.take_off_to(altitude_m, place, self._state, flying=flying)
        return self._ask(Mode.TAKEOFF)

    def set_mode(
        self, mode: Mode, request: interface.ModeRequest | None = None, *, commanded: bool = False
    ) -> autopilot_state.Result:
        """Request a mode with its optional arguments.

        `commanded` is True for a specific command (NAV_LAND), whose acceptance is reported.
        """
        if mode is Mode.TAKEOFF:
            return self.takeoff(None)
        return self._ask(mode, request, commander.COMMANDED.get(mode) if commanded else None)

    def _ask(
        self,
        mode: Mode,
        request: interface.ModeRequest | None = None,
        granted: autopilot_state.OperatorText | None = None,
    ) -> autopilot_state.Result:
        if not self._guidance.flies(mode):
            self.say(commander.unavailable(mode))
            return autopilot_state.Result.TEMPORARILY_REJECTED
        self._look_anew(mode)
        # The geofence may forbid the place of the request.
        if self.flight.phase >= _GROUND:
            request = self._navigator.permitted(request, self._situation())
        available = self.supervisor.available(mode)
        if mode in WITH_STICKS:
            available = available and self._manual_control.sticks(self._now_us) is not None
        return self._commander.handle(commander.Ask(mode, available), request, granted)

    def change_speed(self, speed_m_s: float) -> None:
        """Set the horizontal speed of the present automatic mode [m/s]."""
        self._guidance.context.travel.speed_m_s = speed_m_s

    def start_mission(self, index: int) -> autopilot_state.Result:
        """Arm and fly the mission from an item (MAV_CMD_MISSION_START); -1 = current item."""
        if not self._navigator.mission_is_valid(self._situation()):
            self.say(
                autopilot_state.OperatorText.of(
                    autopilot_state.Severity.CRITICAL, events.MISSION_DENIED
                )
            )
            return autopilot_state.Result.DENIED
        # -1 means the current item.
        if not -1 <= index < len(self.plans.mission):
            return autopilot_state.Result.DENIED
        self._commander.handle(commander.Ask(Mode.MISSION))
        if (
            self.flight.phase < _GROUND
            and self.arm(force=False) is not autopilot_state.Result.ACCEPTED
        ):
            return autopilot_state.Result.TEMPORARILY_REJECTED
        if index >= 0:
            self.plans.set_current(index)
        return autopilot_state.Result.ACCEPTED

    # --- towards the mission (navigation.plan.Crew)

    def set_home(self, place: frames.Geodetic | None) -> autopilot_state.Result:
        """Move home; None = the current position."""
        done = self._home.set_here() if place is None else self._home.set_to(place)
        # Home is part of the snapshot, and modes may fly to it.
        self._snapshot, self._due_us = None, 0
        return (
            autopilot_state.Result.ACCEPTED if done else autopilot_state.Result.TEMPORARILY_REJECTED
        )

    def set_origin(self, place: frames.Geodetic) -> autopilot_state.Result:
        """Move the origin of local NED; rejected while armed.

        PX4 also moves it in flight and shifts all local positions.
        """
        if self.flight.phase >= _GROUND:
            self.say(
                autopilot_state.OperatorText(
                    autopilot_state.Severity.WARNING, "Origin is not moved while armed"
                )
            )
            return autopilot_state.Result.TEMPORARILY_REJECTED
        self.estimator.move_origin(place)
        self._home.find()
        self._snapshot, self._due_us = None, 0
        return autopilot_state.Result.ACCEPTED

    def look_at(self, place: frames.Geodetic | None) -> None:
        """Turn the nose to a place during a mission; None = cancel."""
        self._navigator.missions.look_at(place)

    def return_to_launch(self) -> None:
        """Abort the mission and return."""
        self.set_mode(Mode.RETURN, commanded=True)

    def offer_setpoint(self, setpoint: autopilot_state.Setpoint, time_us: int) -> None:
        """Pass on a valid offboard setpoint, received at `time_us` of simulated time."""
        self._guidance.context.offer(setpoint)
        self.supervisor.setpoint(setpoint, time_us)
        if self.on_setpoint is not None:
            self.on_setpoint(setpoint.wire, time_us)

    def offer_attitude(
        self,
        demand: AttitudeDemand | RateDemand,
        time_us: int,
        wire: autopilot_state.Wire = autopilot_state.UNTOLD,
    ) -> None:
        """Pass on an offboard setpoint of attitude or body rates, received at `time_us`.

        `wire` identifies it in latency analysis: roll, pitch, yaw [rad] or their rates [rad/s], and
        thrust.
        """
        self._guidance.context.offer(demand)
        self.supervisor.setpoint(None, time_us)
        if self.on_setpoint is not None:
            self.on_setpoint(wire, time_us)

    def refuse_setpoint(self, reason: str, time_us: int) -> None:
        """Record the reason of a rejected offboard setpoint, which the next failsafe names."""
        self._commander.refusal = reason, time_us

    def manual_control(
        self, sticks: interface.Sticks, source: interface.Source, time_us: int
    ) -> None:
        """Pass on the pilot's sticks, received at `time_us` of simulated time."""
        moved = self._manual_control.offer(sticks, source, time_us)
        self.supervisor.watch.hear_pilot(time_us)
        flown, override = self.flight.mode, int(self.parameters["COM_RC_OVERRIDE"])
        # COM_RC_OVERRIDE: bit 0 for automatic modes, bit 1 for offboard.
        bit = 2 if flown is Mode.OFFBOARD else 1
        takes_over = moved and override & bit and flown not in WITH_STICKS
        if takes_over and self.flight.failsafe:
            # In a failsafe, the framework decides whether the sticks take over.
            self._commander.obey(Intervention(sticks_moved=True))
            return
        if takes_over and self.flight.phase is _AIR and flown is not Mode.ORBIT:
            self._commander.handle(commander.Ask(Mode.POSITION))
            self.say(
                autopilot_state.OperatorText.of(
                    autopilot_state.Severity.INFO, events.PILOT_TOOK_OVER
                )
            )

    def receive(self, name: str, reading: Any) -> None:
        """Pass on a reading of a client's sensor: odometry, distance or flow."""
        fused, self._snapshot = self.estimator.receive(name, reading), None
        if not fused and name not in self._unfused:
            self._unfused.add(name)
            self.say(
                autopilot_state.OperatorText(
                    autopilot_state.Severity.WARNING, f"No add-on fuses the sensor: {name}"
                )
            )

    def see_obstacles(self, obstacles: interface.ObstacleBins) -> None:
        """Pass on the distances to obstacles."""
        self._guidance.context.obstacles = obstacles

    def follow(self, target: interface.FollowedTarget) -> None:
        """Pass on the position of the Follow target."""
        self._guidance.context.target = target

    def landing_target(self, target: interface.LandingTarget) -> None:
        """Pass on the position of the precision landing target."""
        self._guidance.context.landing_target = target

    def gcs_heartbeat(self, time_us: int) -> None:
        """Record a heartbeat from a ground station."""
        self.supervisor.gcs_heartbeat(time_us)

    def state(self) -> AutopilotState:
        """Return the snapshot after the newest tick. Raises RuntimeError before the first tick."""
        status = self._commander.status
        if self._snapshot is not None and self._snapshot.status is status:
            return self._snapshot
        if self._taken_us < 0:
            raise RuntimeError("no tick yet: the autopilot has no state")
        # Without findings and ESC reports, only `_told` can change logged data.
        calm = self.supervisor.is_calm and self._newest.esc_outputs is None
        revision = self._told if calm else None
        self._snapshot = AutopilotState(self, status, self._taken_us, self._demand, revision)
        return self._snapshot

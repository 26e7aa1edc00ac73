"""Failsafe framework, and the supervisor of one vehicle: check, decide, report.

The framework selects and times the active action: a pure state machine. The supervisor runs at
10 Hz, like PX4's commander, and upon user actions.

A triggered failsafe is held until its row's end condition. The highest held action takes effect. An
action that permits takeover waits in Hold for COM_FAIL_ACT_T first. If the action's mode cannot
run, the next in the chain replaces it. Source: PX4 1.16, commander/failsafe/framework.cpp.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.profiles.px4_release import Px4Release
from firmware_sim.autopilot import prearm
from firmware_sim.autopilot.autopilot_state import Health, OperatorText, Setpoint, Severity
from firmware_sim.autopilot.commander import CommanderState, FlightPhase
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import FailsafeAction, FailsafeCause, MavlinkEvent
from firmware_sim.autopilot.events.health_report import REPORT_US, HealthReporter
from firmware_sim.autopilot.failsafes import failsafe_conditions, failsafe_table, watch
from firmware_sim.autopilot.failsafes.failsafe_conditions import (
    Clear,
    Conditions,
    FailsafeSettings,
    Options,
    Takeover,
    can_run,
)
from firmware_sim.autopilot.failsafes.failsafe_table import Situation
from firmware_sim.autopilot.flight_modes import Mode, Need
from firmware_sim.autopilot.prearm import ArmingSettings, PrearmCheck, Readiness
from firmware_sim.autopilot.sensor_monitor import NO_DATA_US
from firmware_sim.interfaces import SensorSample

_GENERIC = FailsafeCause.GENERIC

_WARNINGS = {
    FailsafeCause.LOW_BATTERY_LEVEL: events.FAILSAFE_BATTERY_LOW,
    FailsafeCause.CRITICAL_BATTERY_LEVEL: events.FAILSAFE_BATTERY_CRITICAL,
    FailsafeCause.EMERGENCY_BATTERY_LEVEL: events.FAILSAFE_BATTERY_EMERGENCY,
    FailsafeCause.LOW_REMAINING_FLIGHT_TIME: events.FAILSAFE_TIME_LOW,
}
"""Warnings with a specific text."""

_DISENGAGING = (
    FailsafeAction.DESCEND,
    FailsafeAction.FALLBACK_ALTCTRL,
    FailsafeAction.FALLBACK_STABILIZED,
)


def announcement(
    action: FailsafeAction,
    delayed: FailsafeAction,
    cause: FailsafeCause,
    intended: Mode,
    delay_us: int,
) -> OperatorText:
    """Return the message for an action that starts.

    Args:
        action: Active action.
        delayed: Action after the delay in Hold; NONE = no delay.
        cause: Cause named in the text.
        intended: Mode requested by the user.
        delay_us: Remaining delay [µs].
    """
    text, mode, generic = "Failsafe activated", intended.spec.custom_mode, cause is _GENERIC
    # The text counts the delay only while Hold precedes another action.
    if action is FailsafeAction.HOLD and delayed is not FailsafeAction.NONE:
        # Rounded to whole seconds.
        seconds = (delay_us + US_PER_S // 2) // US_PER_S
        text = f"{text}: entering Hold for {seconds} seconds"
        if generic:
            event = events.FAILSAFE_HOLD_GENERIC.event(mode, delayed, seconds)
        else:
            event = events.FAILSAFE_HOLD.event(mode, delayed, seconds, cause)
    elif action is FailsafeAction.WARN and cause in _WARNINGS:
        event = _WARNINGS[cause].event()
    elif action is FailsafeAction.WARN and generic:
        event = events.FAILSAFE_WARN_GENERIC.event(mode)
    elif action is FailsafeAction.WARN:
        event = events.FAILSAFE_WARN.event(mode, cause)
    elif not generic:
        event = events.FAILSAFE.event(mode, action, cause)
    elif action in _DISENGAGING:
        event = events.FAILSAFE_DISENGAGED.event(mode, action)
    else:
        event = events.FAILSAFE_GENERIC.event(mode, action)
    return OperatorText(Severity.CRITICAL, text, event)


class Intervention(NamedTuple):
    """User actions since the last update."""

    mode_chosen: bool = False
    """A mode was requested, including the current intended mode."""
    sticks_moved: bool = False
    """The pilot takes over by moving the sticks."""


NO_INTERVENTION = Intervention()


class Held(NamedTuple):
    """Active action."""

    trigger: failsafe_table.Trigger
    options: Options
    failing: bool
    """True while the condition persists."""


SLOTS = 8
"""Maximum number of active actions, as in PX4."""


class FailsafeState(NamedTuple):
    """State of the failsafe framework."""

    held: tuple[Held | None, ...] = (None,) * SLOTS
    """Active actions in slots; None = free. Of equal actions, the first names the cause."""
    action: FailsafeAction = FailsafeAction.NONE
    """Active action."""
    taken_over: bool = False
    """The user continues to fly despite the failsafe."""
    time_us: int | None = None
    """Time of the last update [µs]."""
    armed: bool = False
    intended: Mode | None = None
    start_delay_us: int | None = None
    """Duration of the next delay in Hold [µs]; None = COM_FAIL_ACT_T."""
    delay_us: int = 0
    """Remaining time of the current delay in Hold [µs]."""
    armed_us: int | None = None
    manual_control_lost_at_arming: bool = False
    battery_at_arming: failsafe_conditions.BatteryWarning = failsafe_conditions.BatteryWarning.NONE

    @property
    def active(self) -> bool:
        """True if a failsafe determines the mode."""
        return self.action > FailsafeAction.WARN


class FailsafeResult(NamedTuple):
    """Result of an update."""

    state: FailsafeState
    mode: Mode
    """Active mode."""
    intended: Mode
    """Mode intended by the user; the sticks may have changed it."""
    text: OperatorText | None
    """New message for the operator; None = no change."""
    delayed: FailsafeAction = FailsafeAction.NONE
    """Action after the delay in Hold."""
    cause: FailsafeCause = _GENERIC


class _Choice(NamedTuple):
    """Selected action with its attributes."""

    action: FailsafeAction
    intended: Mode
    delayed: FailsafeAction = FailsafeAction.NONE
    cause: FailsafeCause = _GENERIC
    taken_over: bool = False


def update(
    state: FailsafeState,
    now: failsafe_table.Situation,
    intervention: Intervention = NO_INTERVENTION,
) -> FailsafeResult:
    """Return the active mode and action.

    Args:
        state: State after the last update; a new one after boot.
        now: Current situation. Its time must not decrease; the state has the data of arming.
        intervention: User actions since the last update.
    """
    elapsed_us = 0 if state.time_us is None else now.time_us - state.time_us
    # A changed intended mode is a selection, too.
    chosen = intervention.mode_chosen or (
        state.intended is not None and state.intended is not now.intended
    )
    state = _begin(state, now, elapsed_us)
    # Arming and disarming end actions that last until a mode change.
    if state.armed is not now.armed:
        state = state._replace(held=_released(state.held), taken_over=False)
    if chosen or state.taken_over:
        state = state._replace(held=_released(state.held))
    state, warned = _hold(state, now)
    # No delay without Hold: a stronger action, a takeover, or Hold is impossible.
    stronger = state.action > FailsafeAction.HOLD
    if stronger or state.taken_over or not can_run(Mode.HOLD, now.conditions):
        state = state._replace(delay_us=0)
    choice = _select(state, now, intervention._replace(mode_chosen=chosen))
    text = None
    # Announce stronger actions, and new warnings of an unchanged action.
    if choice.action > state.action or (choice.action is not FailsafeAction.NONE and warned):
        text = announcement(
            choice.action, choice.delayed, choice.cause, now.intended, state.delay_us
        )
    intended = choice.intended
    if now.rules.orbit_ends_at_once:
        interrupted = not state.active and choice.action > FailsafeAction.WARN
    else:
        mode = failsafe_table.mode_of(choice.action, intended)
        interrupted = state.active and mode in (intended, Mode.TERMINATION)
    if interrupted and intended is Mode.ORBIT:
        intended = Mode.HOLD  # Orbit does not resume after an interruption.
    state = state._replace(
        action=choice.action,
        taken_over=choice.taken_over,
        time_us=now.time_us,
        armed=now.armed,
        intended=intended,
        start_delay_us=_start_delay(state, now.settings, elapsed_us, choice.delayed),
    )
    mode = failsafe_table.mode_of(choice.action, intended)
    return FailsafeResult(state, mode, intended, text, choice.delayed, choice.cause)


def _begin(state: FailsafeState, now: failsafe_table.Situation, elapsed_us: int) -> FailsafeState:
    """Advance the delays, and store the failures present at arming."""
    state = state._replace(delay_us=max(0, state.delay_us - elapsed_us))
    lost = now.conditions.manual_control_signal_lost
    if now.armed and not state.armed:
        state = state._replace(
            armed_us=now.time_us,
            manual_control_lost_at_arming=lost,
            battery_at_arming=now.conditions.battery_warning,
        )
    elif not now.armed:
        # Nothing is added while disarmed.
        state = state._replace(armed_us=None, manual_control_lost_at_arming=lost)
    # Manual control that returns is required from then on.
    return state if lost else state._replace(manual_control_lost_at_arming=False)


def _released(held: tuple[Held | None, ...]) -> tuple[Held | None, ...]:
    """Return the held actions after a mode selection by the user."""
    return tuple(
        h if h and (h.failing or h.options.clear is not Clear.ON_MODE_CHANGE) else None
        for h in held
    )


def _hold(state: FailsafeState, now: failsafe_table.Situation) -> tuple[FailsafeState, bool]:
    """Add new failures, drop cleared ones; return also whether a warning is new."""
    now = now._replace(
        armed_us=state.armed_us,
        manual_control_lost_at_arming=state.manual_control_lost_at_arming,
        battery_at_arming=state.battery_at_arming,
    )
    # One action per trigger; rows of one trigger exclude each other.
    answers = failsafe_table.answers(now)
    held, warned, delay_us = list(state.held), False, state.delay_us
    # COM_FAIL_ACT_T up to 0.1 s means no delay, as in PX4.
    waits = now.settings.com_fail_act_t > 0.1
    for trigger in failsafe_table.Trigger:
        options = answers.get(trigger)
        place = next((i for i, item in enumerate(held) if item and item.trigger is trigger), None)
        item = None if place is None else held[place]
        if place is not None and item is not None:
            if options is not None:
                # The action may change; end condition and takeover rule stay.
                changed = item.options._replace(action=options.action)
                held[place] = Held(trigger, changed, failing=True)
            elif trigger in answers:
                held[place] = _cleared(item)
            continue
        if options is None:
            continue
        places = [i for i, item in enumerate(held) if item is None] or [
            i for i, item in enumerate(held) if item and options.action > item.options.action
        ]
        if not places:
            continue
        if options.takeover is Takeover.AUTO:
            if waits and options.action is not FailsafeAction.WARN and delay_us == 0:
                delay_us = _next_delay(state, now.settings)
            takeover = Takeover.ALWAYS if waits else Takeover.MODE_SWITCH
            options = options._replace(takeover=takeover)
        # The last free slot, as in PX4.
        held[places[-1]] = Held(trigger, options, failing=True)
        warned = warned or options.action is FailsafeAction.WARN
        # A new failsafe ends the takeover: the user must confirm it again.
        if options.action >= FailsafeAction.HOLD:
            state = state._replace(taken_over=False)
    # Unchecked failures end after the others.
    ended = (_cleared(item) if item and item.trigger not in answers else item for item in held)
    return state._replace(held=tuple(ended), delay_us=delay_us), warned


def _cleared(item: Held) -> Held | None:
    """Return an action whose condition has cleared; None = it ends."""
    return None if item.options.clear is Clear.WITH_CONDITION else item._replace(failing=False)


def _next_delay(state: FailsafeState, settings: FailsafeSettings) -> int:
    full_us = round(settings.com_fail_act_t * US_PER_S)
    return full_us if state.start_delay_us is None else min(full_us, state.start_delay_us)


def _start_delay(
    state: FailsafeState, settings: FailsafeSettings, elapsed_us: int, delayed: FailsafeAction
) -> int | None:
    """Return the duration of the next delay: an intermittent condition shortens it."""
    remaining = _next_delay(state, settings)
    if delayed is not FailsafeAction.NONE:
        return max(0, remaining - elapsed_us)
    # Used delay does not return at once: it recovers at a quarter of real time.
    remaining += elapsed_us // 4
    return None if remaining >= settings.com_fail_act_t * US_PER_S else remaining


def _select(
    state: FailsafeState, now: failsafe_table.Situation, intervention: Intervention
) -> _Choice:
    # Termination is final.
    if state.action is FailsafeAction.TERMINATE:
        return _Choice(FailsafeAction.TERMINATE, now.intended)
    if not now.armed:
        return _Choice(FailsafeAction.NONE, now.intended)
    # Highest action and strictest takeover rule of all held failsafes.
    worst = Options(FailsafeAction.NONE, takeover=Takeover.ALWAYS)
    strictest = Takeover.ALWAYS
    # Until PX4 1.17, an action that is switched off counts for the takeover.
    least = FailsafeAction(now.rules.delays_from // 2)
    for item in state.held:
        if item is None or item.options.action < least:
            continue
        strictest = max(strictest, item.options.takeover)
        if item.options.action > worst.action:
            worst = item.options
    action, cause, intended = worst.action, worst.cause, now.intended
    delayed = FailsafeAction.NONE
    # During the delay the vehicle waits in Hold, and any mode selection takes over.
    if (
        state.delay_us > 0
        and not state.taken_over
        and strictest <= Takeover.MODE_SWITCH
        and now.rules.delays_from <= action
        and action not in (FailsafeAction.DISARM, FailsafeAction.TERMINATE, FailsafeAction.HOLD)
    ):
        delayed, action, strictest = action, FailsafeAction.HOLD, Takeover.MODE_SWITCH
    # A mode switch in the update that starts the action does not end the action.
    known = state.active if now.rules.takeover_needs_action else state.action is action
    by_mode = intervention.mode_chosen and known
    takes_over = state.taken_over or by_mode
    if strictest is Takeover.ALWAYS:
        takes_over = takes_over or intervention.sticks_moved
    taken_over = False
    if (
        FailsafeAction.HOLD <= action <= FailsafeAction.DESCEND
        and strictest < Takeover.AUTO
        and takes_over
    ):
        # Sticks take over into Position; a mode selection keeps the selected mode.
        if not state.taken_over and intervention.sticks_moved:
            intended = Mode.POSITION
        action, taken_over, delayed = FailsafeAction.WARN, True, FailsafeAction.NONE
        # The user's mode may be impossible: then its fallback acts.
        action = max(action, failsafe_table.mode_fallback(now, intended))
    possible_now = failsafe_table.possible(action, now.conditions)
    if possible_now is not action:
        action, cause = possible_now, _GENERIC
    if _already_on_the_way(intended, action, delayed, now.conditions):
        action, delayed = FailsafeAction.WARN, FailsafeAction.NONE
    return _Choice(action, intended, delayed, cause, taken_over)


def _already_on_the_way(
    intended: Mode, action: FailsafeAction, delayed: FailsafeAction, conditions: Conditions
) -> bool:
    """Return whether Return is redundant as the vehicle already lands or returns.

    A precision landing also continues instead of an ordinary landing.
    """
    needless = {FailsafeAction.RTL}
    if intended is Mode.PRECISION_LAND:
        needless.add(FailsafeAction.LAND)
    return (
        intended in (Mode.LAND, Mode.RETURN, Mode.PRECISION_LAND)
        and (action in needless or delayed in needless)
        and can_run(intended, conditions)
    )


LOOK_US = 100_000
"""Check period [µs] (PX4's commander: 10 Hz): the maximum delay until a loss is detected."""

CHECK_US = 100_000
"""Period of the pre-arm checks [µs] (PX4: 10 Hz)."""

_GROUND = FlightPhase.GROUND


class FailsafeDecision(NamedTuple):
    """Decision of the failsafes."""

    flight: CommanderState
    text: OperatorText | None
    disarm: bool
    """True if the motors must stop now."""


class Supervisor:
    """Failsafes and pre-arm checks of one vehicle."""

    def __init__(
        self,
        value: Callable[[str], float],
        estimator: Estimator,
        release: Px4Release,
        send_event: Callable[[MavlinkEvent], None] = lambda _event: None,
    ) -> None:
        """Store the look-up for PX4 parameters, estimator, PX4 release and event callback."""
        self._value, self._release = value, release
        self._estimator = estimator
        self.watch = watch.Watch(value, estimator)
        """Monitors for signals and measurements."""
        self.sensors = self.watch.sensors
        """Sensor validity."""
        self.next_us = 0
        """Time of the next check [µs]; earlier checks are harmless."""
        self.conditions = failsafe_conditions.Conditions()
        """Conditions at the last check."""
        self.changes = 0
        """Number of checks with changed conditions or readiness."""
        self.failing: tuple[PrearmCheck, ...] = ()
        """Pre-arm checks that failed at the last check."""
        self._ready: Readiness | None = None
        """Last input of the pre-arm checks."""
        self._armable = False
        self._state = FailsafeState()
        self._decided: tuple[object, ...] = ()
        self._reported: tuple[PrearmCheck, ...] | None = None
        """Checks reported as failing; None: reporting starts when the vehicle is ready."""
        self._reported_us = 0
        self._send_event = send_event
        self._pilot_us: int | None = None
        """Time of the newest pilot input at the last check with a pilot [µs]."""
        self._reporter = HealthReporter(send_event)
        self._report_requested = False
        """True if a report of all failing checks is requested."""
        self._check_us = 0
        self._checked = FlightPhase.BOOT
        """Flight phase at the last check."""
        self._calm_flight: CommanderState | None = None
        """Flight state at a check without findings that stays valid; None = there were findings."""
        self.read_parameters()

    def read_parameters(self) -> None:
        """Read the parameters again."""
        self.watch.read_parameters()
        self._settings = failsafe_conditions.FailsafeSettings(
            *failsafe_conditions.read_settings(
                failsafe_conditions.FailsafeSettings._field_defaults, self._value
            )
        )
        self._arming = ArmingSettings(
            *failsafe_conditions.read_settings(ArmingSettings._field_defaults, self._value)
        )
        # Changed limits may change every result.
        self.next_us, self._calm_flight = 0, None

    # --- inputs

    def setpoint(self, setpoint: Setpoint | None, time_us: int) -> None:
        """Record a valid offboard setpoint; None = attitude or body rates."""
        self.watch.hear_setpoint(setpoint, time_us)
        # Regained signals end a failsafe at once instead of at the next check.
        if self.conditions.offboard_control_signal_lost:
            self.next_us = 0

    def gcs_heartbeat(self, time_us: int) -> None:
        """Record a ground station's heartbeat."""
        self.watch.hear_gcs(time_us)
        if self.conditions.gcs_connection_lost:
            self.next_us = 0

    def tell_checks(self) -> None:
        """Report all failing checks at the next check, including reported ones."""
        self._report_requested, self.next_us, self._check_us, self._calm_flight = True, 0, 0, None

    # --- looking

    @property
    def is_calm(self) -> bool:
        """True if the newest check found nothing new or unusual."""
        return self._calm_flight is not None

    def is_unchanged(self, now_us: int, flight: CommanderState) -> bool:
        """Return whether a check would repeat the newest result; if so, it counts as done."""
        # A new flight state object means that the commander's state has changed.
        if flight is not self._calm_flight or not self.watch.is_unchanged(now_us):
            self._calm_flight = None
            return False
        self.next_us, self._check_us = now_us + LOOK_US, now_us + CHECK_US
        return True

    def look(self, sample: SensorSample, flight: CommanderState) -> list[OperatorText]:
        """Run the checks; return new messages for the operator."""
        now_us = sample.time_us
        self.next_us = now_us + LOOK_US
        before = self.conditions
        self.conditions, texts = self.watch.look(sample, flight.phase)
        self._report_pilot(now_us, was_lost=before.manual_control_signal_lost)
        # Arming rules depend on the phase.
        changed = self.conditions != before or flight.phase is not self._checked
        if now_us >= self._check_us or changed:
            self._check_us, self._checked = now_us + CHECK_US, flight.phase
            readiness = self.readiness(sample, flight, flight.mode)
            # The checks are pure: equal input gives an equal result.
            if readiness != self._ready:
                self.changes += 1
                self._ready, self.failing = readiness, prearm.failing(readiness)
                self._armable = not prearm.blocking(self.failing, readiness)
            self._reporter.update(readiness, now_us, force=self._report_requested)
            texts += self._report(now_us, flight)
        all_reported = (
            self.failing == self._reported and not self._report_requested and self._reporter.is_sent
        )
        calm = all_reported and not changed and self.watch.is_calm
        self._calm_flight = flight if calm else None
        return texts

    def _report_pilot(self, now_us: int, *, was_lost: bool) -> None:
        """Report that pilot input was lost or regained; PX4 has no text for it."""
        lost, heard_us = self.conditions.manual_control_signal_lost, self._pilot_us
        if lost is not was_lost and heard_us is not None:
            silent_s = (now_us - heard_us) / US_PER_S
            self._send_event(
                events.PILOT_LOST.event() if lost else events.PILOT_REGAINED.event(silent_s)
            )
        if not lost:
            self._pilot_us = now_us

    def readiness(self, sample: SensorSample, flight: CommanderState, mode: Mode) -> Readiness:
        """Return the input of the pre-arm checks for arming in a mode."""
        now_us, attitude = sample.time_us, self.watch.attitude
        return Readiness(
            mode,
            self.conditions,
            self._arming,
            converged=self._estimator.healthy,
            compass_agrees=not self._estimator.recovery.compass.given_up,
            field_disturbed=flight.phase < _GROUND and self._estimator.field_disturbed,
            **self.sensors.valid(now_us)._asdict(),
            distance=self._ranges(now_us),
            rolled=attitude.roll,
            pitched=attitude.pitch,
            charge_short=sample.battery.remaining < self._arming.com_arm_bat_min,
            failed_motors=self.watch.motors.failed,
            offboard_lacks=self.watch.offboard_lacks,
            terminated=flight.mode is Mode.TERMINATION,
            armed=flight.phase >= _GROUND,
            release=self._release.name,
        )

    def health(self, now_us: int) -> Health:
        """Return sensor and estimate health for clients."""
        seen, sensors = self.conditions, self.sensors.valid(now_us)
        return Health(
            gyro=not seen.angular_velocity_invalid,
            accel=sensors.accel,
            mag=sensors.mag and not self._estimator.recovery.compass.given_up,
            baro=sensors.baro,
            gps=sensors.gps,
            distance=self._ranges(now_us) if self._arming.sys_has_num_dist > 0 else None,
            attitude=not seen.attitude_invalid,
            velocity=not seen.local_velocity_invalid,
            position=not seen.local_position_invalid,
            altitude=not seen.local_altitude_invalid,
            accel_error=self._estimator.recovery.doubts_inertial(now_us),
            battery=seen.battery_warning < failsafe_conditions.BatteryWarning.CRITICAL,
            armable=self._armable,
        )

    def _ranges(self, now_us: int) -> bool | None:
        """Return whether a distance sensor delivers data; None: it never has."""
        if self._estimator.aiding.ground is None:
            return None
        newest = self._estimator.readings.get("distance")
        return now_us - (0 if newest is None else newest.time_us) < NO_DATA_US

    def _report(self, now_us: int, flight: CommanderState) -> list[OperatorText]:
        """Return the newly failing checks once the vehicle has been ready."""
        # During boot any check may fail: reporting starts when the vehicle is ready.
        if self._reported is None:
            if flight.phase is FlightPhase.BOOT:
                self._report_requested = False
                return []
            self._reported = ()
        unchanged = self.failing == self._reported or now_us < self._reported_us + REPORT_US
        if unchanged and not self._report_requested:
            return []
        # A requested report repeats known checks.
        reported = () if self._report_requested else self._reported
        new = [check for check in self.failing if check.announced and check not in reported]
        self._reported, self._reported_us, self._report_requested = self.failing, now_us, False
        return [OperatorText(check.severity, check.text) for check in new]

    # --- arming and modes

    def refusals(self, sample: SensorSample, flight: CommanderState) -> list[OperatorText]:
        """Return the reasons against arming in the current mode; empty = armable."""
        checks = prearm.can_arm(self.readiness(sample, flight, flight.mode))
        return [OperatorText(Severity.CRITICAL, check.text) for check in checks]

    def available(self, mode: Mode) -> bool:
        """Return whether a mode's requirements are met for a user request, pilot input aside."""
        # The caller checks pilot input.
        return not failsafe_conditions.lacking(mode, self.conditions) & ~(
            Need.NOT_ARMING | Need.MANUAL_CONTROL
        )

    # --- deciding

    def decide(
        self,
        time_us: int,
        flight: CommanderState,
        intervention: Intervention = NO_INTERVENTION,
    ) -> FailsafeDecision | None:
        """Return the failsafes' decision for a flight; None = no change."""
        state, finished = self._state, self.watch.reports.mission_finished
        armed = flight.phase >= _GROUND
        # Equal inputs need no new decision.
        seen = (self.conditions, armed, flight.intended, finished, self._settings)
        # Time-dependent inputs: delays, and rows with a time limit after arming.
        waiting = state.delay_us > 0 or state.start_delay_us is not None
        timed = self.conditions.fd_critical_failure
        idle = not (waiting or timed or state.taken_over)
        if idle and seen == self._decided and intervention == NO_INTERVENTION:
            return None
        self._decided = seen
        now = Situation(
            *(time_us, self.conditions, self._settings, flight.intended, finished),
            armed=armed,
            rules=self._release.failsafes,
        )
        outcome = update(state, now, intervention)
        self._state = outcome.state
        action = outcome.state.action
        followed = replace(
            flight, mode=outcome.mode, intended=outcome.intended, failsafe=outcome.state.active
        )
        text = outcome.text
        if text and action is FailsafeAction.WARN and not self._release.failsafes.warning_has_text:
            if text.event is not None:
                self._send_event(text.event)
            text = None
        return FailsafeDecision(followed, text, action is FailsafeAction.DISARM and armed)

"""Failsafe supervisor of one vehicle: check, decide, report.

It runs at 10 Hz, like PX4's commander, and upon user actions. The state machine runs only after a
change or during a delay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot import prearm
from firmware_sim.autopilot.autopilot_state import Health, OperatorText, Setpoint, Severity
from firmware_sim.autopilot.commander import CommanderState, FlightPhase
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import FailsafeAction, MavlinkEvent
from firmware_sim.autopilot.events.health_report import REPORT_US, HealthReporter
from firmware_sim.autopilot.failsafes import failsafe_conditions, framework
from firmware_sim.autopilot.failsafes.failsafe_table import Situation
from firmware_sim.autopilot.failsafes.watch import Watch
from firmware_sim.autopilot.flight_modes import Mode, Need
from firmware_sim.autopilot.prearm import ArmingSettings, PrearmCheck, Readiness
from firmware_sim.autopilot.sensor_monitor import NO_DATA_US
from firmware_sim.interfaces import SensorSample

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
        send_event: Callable[[MavlinkEvent], None] = lambda _event: None,
    ) -> None:
        """Store the look-up for PX4 parameters, the estimator and the event callback."""
        self._value = value
        self._estimator = estimator
        self.watch = Watch(value, estimator)
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
        self._state = framework.FailsafeState()
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
            terminated=flight.mode is Mode.TERMINATION,
            armed=flight.phase >= _GROUND,
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
        intervention: framework.Intervention = framework.NO_INTERVENTION,
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
        if idle and seen == self._decided and intervention == framework.NO_INTERVENTION:
            return None
        self._decided = seen
        now = Situation(
            time_us, self.conditions, self._settings, flight.intended, finished, armed=armed
        )
        outcome = framework.update(state, now, intervention)
        self._state = outcome.state
        action = outcome.state.action
        followed = replace(
            flight, mode=outcome.mode, intended=outcome.intended, failsafe=outcome.state.active
        )
        return FailsafeDecision(followed, outcome.text, action is FailsafeAction.DISARM and armed)

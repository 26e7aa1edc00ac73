"""Detection of failure conditions from estimator, links, battery, timers and reports."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from airl_mav.control.loops import Motors
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from firmware_sim.autopilot.autopilot_state import OperatorText, Setpoint, Severity
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.error_state import SIGMA, Q
from firmware_sim.autopilot.estimator import GPS_GONE_US, Estimator
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.failsafes import detectors, failsafe_conditions
from firmware_sim.autopilot.sensor_monitor import CALM_US, SensorMonitor
from firmware_sim.engine.record import ACCEL_ROW, CHANGED, GYRO_ROW, MAG_ROW, SEEN, WATCHES, Record
from firmware_sim.interfaces import BatterySample, SensorSample

_GROUND, _AIR = FlightPhase.GROUND, FlightPhase.AIR
_WARNINGS = tuple(failsafe_conditions.BatteryWarning)

_RECENT, _ACCURACY, _SPEED_ACCURACY, _ROLL, _PITCH, _BATTERY = range(6)
"""Indices into the limits of `is_calm`."""


@kernel
def is_calm(controller: Record, limits: Vector) -> bool:
    """Return whether all measurements are far from failsafe limits, and record that check.

    Args:
        controller: Record (1,); `looked_at` and `watch` are updated by a calm check.
        limits: (6,) age of the newest fusion [µs], accuracies [m], [m/s], angles [rad], charge.
    """
    c = controller[0]
    now_us, s, seen = c.time_us, c.state, c.looked_at
    fused_us = min(c.gps_horizontal_us, c.baro_fused_us)
    roll, pitch = detectors.roll_and_pitch(s[Q], s[Q + 1], s[Q + 2], s[Q + 3])
    # Any value near a limit needs the full check.
    calm = (
        c.healthy != 0
        and fused_us >= 0
        and now_us - fused_us <= limits[_RECENT]
        and math.hypot(s[SIGMA], s[SIGMA + 1]) < limits[_ACCURACY]
        and math.hypot(s[SIGMA + 3], s[SIGMA + 4]) < limits[_SPEED_ACCURACY]
        and roll <= limits[_ROLL]
        and pitch <= limits[_PITCH]
        and c.battery_left >= limits[_BATTERY]
    )
    # Compass, barometer and GPS must have changed recently.
    for row in range(MAG_ROW, WATCHES):
        calm = calm and now_us - c.watch[row, CHANGED] < CALM_US
    # IMU samples always differ; equal ones may come from a frozen sensor.
    felt = turned = False
    for i in range(3):
        felt, turned = felt or c.accel[i] != seen[i], turned or c.gyro[i] != seen[3 + i]
    if not (calm and felt and turned):
        return False
    # A calm check counts as a sample of the sensor monitor.
    for i in range(3):
        seen[i], seen[3 + i] = c.accel[i], c.gyro[i]
    for row in (GYRO_ROW, ACCEL_ROW):
        c.watch[row, SEEN] = c.watch[row, CHANGED] = now_us
    return True


@dataclass
class Reports:
    """Reports from other parts of the autopilot; each writes only its fields."""

    fence: failsafe_conditions.FenceBreach = failsafe_conditions.NO_BREACH
    mission_missing: bool = True
    """True if no feasible mission is stored."""
    mission_finished: bool = False
    return_time_s: float = 0.0
    """Duration of a return including margins [s]; 0 = unknown."""


class WatchSettings(NamedTuple):
    """Monitor parameters: the field name in capitals; defaults are PX4's."""

    bat1_capacity: float = -1.0
    bat_avrg_current: float = 15.0
    bat_low_thr: float = 0.15
    bat_crit_thr: float = 0.07
    bat_emergen_thr: float = 0.05
    com_arm_bat_min: float = -1.0
    com_dl_loss_t: float = 10.0
    com_flt_time_max: float = -1.0
    com_of_loss_t: float = 1.0
    com_pos_fs_eph: float = 5.0
    com_pos_low_eph: float = -1.0
    com_rc_loss_t: float = 0.5
    com_vel_fs_evh: float = 1.0
    fd_act_en: float = 1.0
    fd_act_mot_c2t: float = 2.0
    fd_act_mot_thr: float = 0.2
    fd_act_mot_tout: float = 100.0
    fd_fail_p: float = 60.0
    fd_fail_p_ttri: float = 0.3
    fd_fail_r: float = 60.0
    fd_fail_r_ttri: float = 0.3


class Watch:
    """Monitor of signals and measurements; reports failure conditions."""

    def __init__(self, value: Callable[[str], float], estimator: Estimator) -> None:
        """Store the look-up for PX4 parameters and the estimator to monitor."""
        self._value = value
        self._estimator = estimator
        self.sensors = SensorMonitor(estimator.record["watch"][0])
        """Sensor monitor."""
        self.attitude = detectors.AttitudeFailure()
        """Attitude failure detector."""
        self.motors = detectors.MotorFailure()
        """Motor failure detector."""
        self.reports = Reports()
        """Reports from other parts of the autopilot."""
        self.setpoint_us: int | None = None
        self._setpoint: Setpoint | None = None
        self._manual_us: int | None = None
        self._gcs_us: int | None = None
        self._gcs_lost = True
        self._battery = failsafe_conditions.BatteryWarning.NONE
        self._endurance = detectors.Endurance()
        self._takeoff_us: int | None = None
        self._local, self._relaxed, self._velocity = (
            detectors.Validity(),
            detectors.Validity(),
            detectors.Validity(),
        )
        self._gps_fused = False
        self._vision_fused = False
        self._restarts = 0
        self._compass_given_up = False
        self._armed = False
        self._calm: tuple[object, ...] | None = None
        """Reported and received state at a check without findings; None = there were findings."""
        self.read_parameters()

    def read_parameters(self) -> None:
        """Read the parameters again."""
        self.settings = p = WatchSettings(
            *failsafe_conditions.read_settings(WatchSettings._field_defaults, self._value)
        )
        self._calm = None
        # 0 disables the check: no limit.
        tilts = (math.radians(abs(d)) or math.inf for d in (p.fd_fail_r, p.fd_fail_p))
        self._limits = np.array(
            [
                # The earliest of several timeouts.
                min(self._value("EKF2_NOAID_TOUT"), GPS_GONE_US),
                detectors.HYSTERESIS * (p.com_pos_fs_eph if p.com_pos_fs_eph >= 0.0 else math.inf),
                detectors.HYSTERESIS * p.com_vel_fs_evh,
                *tilts,
                max(p.bat_low_thr, p.bat_crit_thr, p.bat_emergen_thr, p.com_arm_bat_min),
            ]
        )

    def hear_setpoint(self, setpoint: Setpoint | None, time_us: int) -> None:
        """Record a valid offboard setpoint; None = attitude or body rates."""
        self._setpoint, self.setpoint_us = setpoint, time_us

    def hear_pilot(self, time_us: int) -> None:
        """Record valid pilot input: MANUAL_CONTROL or RC."""
        self._manual_us = time_us

    def hear_gcs(self, time_us: int) -> None:
        """Record a ground station's heartbeat."""
        if self._gcs_us is None:
            self._gcs_lost = False  # The first one is not reported.
        self._gcs_us = time_us

    @property
    def offboard_lacks(self) -> str:
        """Invalid estimate that the newest setpoint needs: position or velocity; "" = none."""
        setpoint = self._setpoint
        # Attitude and rate setpoints need no position estimate.
        if setpoint is None:
            return ""
        by_position = not math.isnan(setpoint.position[0])
        valid = (self._local if by_position else self._velocity).valid
        return "" if valid else "position" if by_position else "velocity"

    def offboard_lost(self, time_us: int) -> bool:
        """Return whether no usable setpoint arrived within COM_OF_LOSS_T."""
        silent = _silent(self.setpoint_us, time_us, self.settings.com_of_loss_t)
        return silent or bool(self.offboard_lacks)

    def hear_escs(self, time_us: int, commands: Motors, outputs: Motors) -> None:
        """Check the motor outputs reported by the speed controllers against the commands."""
        p = self.settings
        if p.fd_act_en:
            limits = detectors.Undercurrent(p.fd_act_mot_thr, p.fd_act_mot_c2t, p.fd_act_mot_tout)
            self.motors.take(time_us, commands, outputs, limits)

    def look(
        self, sample: SensorSample, phase: FlightPhase
    ) -> tuple[failsafe_conditions.Conditions, list[OperatorText]]:
        """Return the current conditions and the messages for the operator."""
        seen, now_us = self._estimator.record["looked_at"][0], sample.time_us
        # Calm checks have skipped the sensor monitor: bring it up to date first.
        if self._calm is not None:
            self.sensors.looked_at(seen[:3], seen[3:])
        texts = self.sensors.judge(sample, flying=phase is _AIR)
        conditions = self._conditions(sample, phase)
        texts += self._texts(conditions, now_us, phase)
        seen[:3], seen[3:] = sample.accel, sample.gyro
        self._armed = phase >= _GROUND
        self._calm = self._reported(now_us) if self._is_usual(conditions, now_us) else None
        return conditions, texts

    @property
    def is_calm(self) -> bool:
        """True if the newest check found nothing unusual."""
        return self._calm is not None

    def is_unchanged(self, now_us: int) -> bool:
        """Return whether a check would repeat the newest result."""
        calm = self._calm
        if calm is None or self._reported(now_us) != calm:
            return False
        return is_calm(self._estimator.record, self._limits)

    def _reported(self, now_us: int) -> tuple[object, ...]:
        # Everything that can change without a measurement.
        reports, recovery, p = self.reports, self._estimator.recovery, self.settings
        setpoint_us, manual_us, gcs_us = self.setpoint_us, self._manual_us, self._gcs_us
        return (
            setpoint_us is None or now_us - setpoint_us > p.com_of_loss_t * US_PER_S,
            manual_us is None or now_us - manual_us > p.com_rc_loss_t * US_PER_S,
            gcs_us is None or now_us - gcs_us > p.com_dl_loss_t * US_PER_S,
            *(reports.fence, reports.mission_missing),
            *(self.motors.failed, recovery.compass.given_up),
            *(recovery.consistency.restarts, self._estimator.compiled),
            not self._armed and self._estimator.field_disturbed,
        )

    def _is_usual(self, found: failsafe_conditions.Conditions, now_us: int) -> bool:
        """Return whether neither time nor another check would change the result."""
        p = self.settings
        return (
            # These optional failsafes depend on time or accuracy, so no check stays valid.
            max(p.com_flt_time_max, p.com_pos_low_eph, p.bat1_capacity) <= 0.0
            and self._local.valid
            and self._relaxed.valid
            and self._velocity.valid
            and not (found.global_position_invalid or found.local_altitude_invalid)
            and not (found.battery_warning or self._vision_fused)
            and self._gps_fused
            and found.manual_control_signal_lost
            and self._estimator.compiled
            and self.attitude.is_calm
            and not self._estimator.recovery.doubts_inertial(now_us)
            and self.sensors.are_calm(now_us)
        )

    def _conditions(
        self, sample: SensorSample, phase: FlightPhase
    ) -> failsafe_conditions.Conditions:
        now_us, p, reports = sample.time_us, self.settings, self.reports
        estimator = self._estimator
        armed = phase >= _GROUND
        estimator.flying = phase is _AIR
        if phase is _AIR:
            # The first moment in the air counts.
            self._takeoff_us = now_us if self._takeoff_us is None else self._takeoff_us
        elif not armed:
            self._takeoff_us = None
        if not armed:
            self.motors.rest()
        accuracy, speed_accuracy = estimator.accuracy()
        position = estimator.knows_position(now_us, flying=phase is _AIR)
        needed = p.com_pos_fs_eph if p.com_pos_fs_eph >= 0.0 else math.inf
        # Before alignment the first good estimate must not be marked as failed.
        if estimator.aligned:
            for validity, sigma, limit in (
                (self._local, accuracy, needed),
                (self._relaxed, accuracy, math.inf),
                (self._velocity, speed_accuracy, p.com_vel_fs_evh),
            ):
                validity.update(now_us, good=position, accuracy=sigma, needed=limit)
        local, sensors = self._local.valid, self.sensors.valid(now_us)
        self._battery = self._charge(sample.battery, armed=armed)
        long_flight = (
            p.com_flt_time_max > 0.0
            and self._takeoff_us is not None
            and now_us - self._takeoff_us > p.com_flt_time_max * US_PER_S
        )
        return failsafe_conditions.Conditions(
            angular_velocity_invalid=not sensors.gyro,
            attitude_invalid=not (estimator.aligned and sensors.gyro and sensors.accel),
            local_altitude_invalid=not estimator.knows_height(now_us),
            local_position_invalid=not local,
            local_position_invalid_relaxed=not self._relaxed.valid,
            local_velocity_invalid=not self._velocity.valid,
            global_position_invalid=not (local and estimator.knows_place),
            local_position_accuracy_low=local and 0.0 < p.com_pos_low_eph < accuracy,
            home_position_invalid=estimator.origin is None,
            auto_mission_missing=reports.mission_missing,
            offboard_control_signal_lost=self.offboard_lost(now_us),
            manual_control_signal_lost=_silent(self._manual_us, now_us, p.com_rc_loss_t),
            gcs_connection_lost=_silent(self._gcs_us, now_us, p.com_dl_loss_t),
            battery_warning=self._battery,
            battery_low_remaining_time=self._lasts_too_short(sample, armed=armed),
            geofence=reports.fence,
            flight_time_limit_exceeded=long_flight,
            fd_critical_failure=self.attitude.update(
                now_us,
                estimator.state,
                (p.fd_fail_r, p.fd_fail_p),
                (p.fd_fail_r_ttri, p.fd_fail_p_ttri),
            ),
            fd_motor_failure=self.motors.failed != 0,
        )

    def _texts(
        self, conditions: failsafe_conditions.Conditions, now_us: int, phase: FlightPhase
    ) -> list[OperatorText]:
        texts: list[OperatorText] = []
        if self._gcs_us is not None and conditions.gcs_connection_lost is not self._gcs_lost:
            lost = self._gcs_lost = conditions.gcs_connection_lost
            text = "Connection to ground station lost" if lost else "GCS connection regained"
            event = events.GCS_LOST if lost else events.GCS_REGAINED
            texts.append(OperatorText(Severity.INFO, text, event.event()))
        fused = self._estimator.fuses_gps(now_us)
        if fused is not self._gps_fused:
            self._gps_fused = fused
            if phase >= _GROUND and fused:
                texts.append(OperatorText.of(Severity.INFO, events.GNSS_STARTED))
            elif phase >= _GROUND:
                texts.append(OperatorText.of(Severity.WARNING, events.GNSS_STOPPED))
        seen = self._estimator.aiding.sees_vision
        if seen is not self._vision_fused:
            self._vision_fused = seen
            if phase >= _GROUND:
                text = f"External vision fusion {'started' if seen else 'stopped'}"
                texts.append(OperatorText(Severity.INFO if seen else Severity.WARNING, text))
        estimator = self._estimator
        if estimator.recovery.consistency.restarts != self._restarts:
            self._restarts = estimator.recovery.consistency.restarts
            other = "GNSS" if fused else "vision"
            text = f"Estimator biases reset: IMU and {other} disagree"
            texts.append(OperatorText(Severity.WARNING, text))
        if estimator.recovery.compass.given_up is not self._compass_given_up:
            given_up = self._compass_given_up = estimator.recovery.compass.given_up
            if given_up and phase >= _GROUND:
                text = "Compass needs calibration - Land now!"
                texts.append(OperatorText(Severity.CRITICAL, text))
        return texts

    def _lasts_too_short(self, sample: SensorSample, *, armed: bool) -> bool:
        """Return whether the remaining battery time is shorter than a return."""
        p, needed_s = self.settings, self.reports.return_time_s
        if p.bat1_capacity <= 0.0:
            return False
        left_s = self._endurance.update(
            sample.time_us, sample.battery, p.bat1_capacity, p.bat_avrg_current, armed=armed
        )
        return left_s < needed_s

    def _charge(self, battery: BatterySample, *, armed: bool) -> failsafe_conditions.BatteryWarning:
        """Return the battery warning level, which cannot decrease while armed."""
        p, remaining = self.settings, battery.remaining
        # The levels are nested: each limit passed adds one.
        below = (
            (remaining < p.bat_low_thr)
            + (remaining < p.bat_crit_thr)
            + (remaining < p.bat_emergen_thr)
        )
        warning = _WARNINGS[below]
        return max(warning, self._battery) if armed else warning


def _silent(heard_us: int | None, now_us: int, limit_s: float) -> bool:
    return heard_us is None or now_us - heard_us > limit_s * US_PER_S

"""The estimator: an error-state extended Kalman filter.

What the states and the sensors are is in `error_state`; how the error's covariance is carried is a
filter's business: `filter_kernel` is the default, `filter_filterpy` its reference. This module is
the order of events: wait at rest, align, then predict and fuse whatever has been measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.constants import TICK_S, US_PER_S
from airl_mav.core.frames import (
    Geodetic,
    Vector,
    geodetic_to_local,
    local_to_geodetic,
    quat_from_euler,
)
from airl_mav.core.location import MAGNETIC_DECLINATION, MAGNETIC_FIELD_NED
from airl_mav.vehicle.atmosphere import altitude_m
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.autopilot_state import Estimate
from firmware_sim.autopilot.consistency import Compass, Consistency, Restart
from firmware_sim.autopilot.emergency_yaw import EmergencyYaw, turn_to
from firmware_sim.autopilot.error_filter import NewFilter
from firmware_sim.autopilot.filter_kernel import KernelFilter
from firmware_sim.autopilot.fusion_horizon import FusionHorizon
from firmware_sim.autopilot.magnetic_field import FieldCheck
from firmware_sim.autopilot.measurement import Measurement, selecting
from firmware_sim.autopilot.yaw_estimator import YawEstimator
from firmware_sim.interfaces import GpsFix, SensorSample

ALIGN_S = 0.5
"""Time at rest over which attitude and barometer are averaged at start [s]."""

_north, _east, _down = MAGNETIC_FIELD_NED
# The field dips, so a tilt error turns the measured heading: seen from the world's axes,
# d innovation / d phi = (-tan(dip) cos(declination), -tan(dip) sin(declination), 1).
_HEADING_BY_TURN_NED = np.array([-_down * _north, -_down * _east, _north**2 + _east**2]) / (
    _north**2 + _east**2
)

LONGEST_ALIGN_S = 10.0
"""Samples at rest that are older are forgotten while a sensor is waited for [s]."""

_NEEDED = ("gps", "mag", "pressure_hpa")
"""Without one of each there is no alignment."""

GPS_GONE_US = 1_000_000
"""GPS that was not fused for so long no longer aids the filter (EKF2: its data are late)."""

PROBATION_US = 10 * US_PER_S
"""Inertial sensors that were wrong are doubted for so long (EKF2: BADACC_PROBATION) [µs]."""

BIAS_STEP_S = 0.01
"""PX4's filter runs at 100 Hz; its bias process noises (EKF2_*_B_NOISE) are per such a step [s]."""

BARO_WALK_M_SQRT_S = 0.01
"""Process noise of the barometer's offset [m/sqrt(s)]."""


class Estimator:
    """Turns noisy sensors into position, velocity, attitude and biases; never sees the truth."""

    def __init__(self, value: Callable[[str], float], new_filter: NewFilter = KernelFilter) -> None:
        """Start unaligned; `value` looks up EKF2_* parameters by name."""
        self._value = value
        self.origin: Geodetic | None = None
        """Where local NED is zero: the mean of the first fixes; None before alignment."""
        self.state = es.new_state()
        """The nominal state, by `error_state`'s layout."""
        self.healthy = False
        """Converged: may be armed and flown on."""
        self.filter = new_filter(np.diag(es.INITIAL_SIGMA**2), self._process_noise())
        """Carries the error's covariance."""
        self.innovations: Callable[[str, Vector, Vector], None] | None = None
        """Called with name, innovation and its covariance for every measurement, if set."""
        self._resting: list[SensorSample] = []
        self._seen: set[str] = set()
        """Which of the slower sensors have measured since alignment began."""
        self._origin_altitude_baro = 0.0
        self._chosen_origin: Geodetic | None = None
        """Where local NED shall be zero, chosen before alignment; None = where the vehicle is."""
        self._time_us = 0
        self._aligned_us: int | None = None
        self._estimate: Estimate | None = None
        horizontal = selecting(es.POS, es.POS + 1, es.VEL, es.VEL + 1)
        self._gps_horizontal = Measurement("gps_horizontal", 0, horizontal)
        self._gps_vertical = Measurement("gps_vertical", 3, selecting(es.POS + 2, es.VEL + 2))
        self._baro = Measurement("baro", 1, selecting(es.BARO) - selecting(es.POS + 2))
        self._heading = Measurement("heading", 2, np.zeros((1, es.N_STATES)))
        self.consistency = Consistency()
        """Sees inertial sensors that have gone wrong."""
        self.compass = Compass()
        """Whether the compass is believed."""
        self._horizon = FusionHorizon()
        self.yaw = YawEstimator()
        """The heading without a compass."""
        self.flying = False
        """Whether the vehicle is in the air; set by whoever knows."""
        self.emergency = EmergencyYaw()
        """When it is taken over."""
        self._biases_before = self.state[es.GYRO_BIAS : es.BARO_OFFSET].copy()
        """Of gyro and accelerometer (6,), before these were doubted."""
        self._field: Vector | None = None
        """The newest that the compass has measured (3,) FRD [gauss]; before alignment the mean."""

    def step(self, sample: SensorSample) -> None:
        """Take one tick's sensors."""
        self._time_us, self._estimate = sample.time_us, None
        if self.origin is None:
            self._align(sample)
        else:
            self._predict(sample)
            self.yaw.feel(sample.gyro, sample.accel)
            if sample.gps is not None:
                self._fuse_gps(sample.gps, self.origin)
            if sample.pressure_hpa is not None:
                self._fuse_baro(sample.pressure_hpa)
            if sample.mag is not None:
                self._field = sample.mag
                self._fuse_heading(sample.mag)
        converged = es.converged(self.state, self.filter.covariance)
        self.healthy = converged and self.origin is not None

    def estimate(self) -> Estimate:
        """Return a copy of the estimate after the newest tick."""
        if self._estimate is None:
            row = self.state.copy()
            self._estimate = Estimate(
                time_us=self._time_us,
                position=row[es.P : es.V],
                velocity=row[es.V : es.Q],
                acceleration=row[es.ACCELERATION : es.SIGMA],
                quaternion=row[es.Q : es.RATES],
                angular_velocity=row[es.RATES : es.GYRO_BIAS],
                gyro_bias=row[es.GYRO_BIAS : es.ACCEL_BIAS],
                accel_bias=row[es.ACCEL_BIAS : es.BARO_OFFSET],
                sigma=row[es.SIGMA : es.RATIO],
                innovation_ratio=row[es.RATIO :],
                healthy=self.healthy,
            )
        return self._estimate

    def move_origin(self, origin: Geodetic) -> None:
        """Let local NED be zero at another place of the globe; the vehicle stays where it is.

        Source: PX4 1.16, Ekf::setEkfGlobalOrigin.
        """
        before, self._chosen_origin = self.origin, origin
        if before is None:
            return
        here = local_to_geodetic(self.state[es.P : es.V], before)
        self.state[es.P : es.V] = geodetic_to_local(here, origin)
        self._origin_altitude_baro += origin.altitude_m - before.altitude_m
        self.origin, self._estimate = origin, None

    # --- what is known (PX4: EKF2's dead reckoning)

    def knows_position(self, now_us: int, *, flying: bool = True) -> bool:
        """Return whether horizontal position and velocity are valid.

        Without GPS they are for EKF2_NOAID_TOUT: that long the vehicle flies by dead reckoning. On
        the ground, where the biases have hardly been learnt, nobody begins a flight so.
        """
        longest_us = self._value("EKF2_NOAID_TOUT") if flying else GPS_GONE_US
        return self.origin is not None and self._recent(self._gps_horizontal, now_us, longest_us)

    def knows_height(self, now_us: int) -> bool:
        """Return whether height and vertical speed are valid: barometer or GPS, as above."""
        longest_us = self._value("EKF2_NOAID_TOUT")
        return self.origin is not None and (
            self._recent(self._baro, now_us, longest_us)
            or self._recent(self._gps_vertical, now_us, longest_us)
        )

    def fuses_gps(self, now_us: int) -> bool:
        """Return whether GPS has been fused lately."""
        fused = self._gps_horizontal.fused_us
        return fused is not None and now_us - fused <= GPS_GONE_US

    def doubts_inertial(self, now_us: int) -> bool:
        """Return whether inertial data disagreed with the GPS lately."""
        restarted = self.consistency.restarted_us
        return restarted is not None and now_us - restarted < PROBATION_US

    @property
    def field_disturbed(self) -> bool:
        """Whether the compass measures something else than the earth's field, by EKF2_MAG_CHECK."""
        if self._field is None:
            return False
        return FieldCheck.read(self._value).disturbed(self._field, es.attitude(self.state))

    def accuracy(self) -> tuple[float, float]:
        """Return the standard deviations of horizontal position [m] and velocity [m/s]."""
        north, east = self.state[es.SIGMA : es.SIGMA + 2].tolist()
        v_north, v_east = self.state[es.SIGMA + 3 : es.SIGMA + 5].tolist()
        return math.hypot(north, east), math.hypot(v_north, v_east)

    def _recent(self, m: Measurement, now_us: int, longest_us: float) -> bool:
        """Return whether it was fused lately; right after alignment all are."""
        since = self._aligned_us if m.fused_us is None else m.fused_us
        return since is not None and now_us - since <= longest_us

    # --- start

    def _align(self, sample: SensorSample) -> None:
        """Average the sensors at rest; then level by gravity and point by the magnetic field."""
        self._resting.append(sample)
        self._seen |= self._kinds(sample)
        elapsed_s = (sample.time_us - self._resting[0].time_us) / US_PER_S
        if elapsed_s < ALIGN_S or len(self._seen) < len(_NEEDED):
            if elapsed_s > LONGEST_ALIGN_S:
                self._forget()
            return
        ax, ay, az = np.mean([s.accel for s in self._resting], axis=0)
        roll, pitch = math.atan2(-ay, -az), math.atan2(ax, math.hypot(ay, az))
        field = np.mean([s.mag for s in self._resting if s.mag is not None], axis=0)
        level = tuple(quat_from_euler(roll, pitch, 0.0).tolist())
        self._field = field
        if FieldCheck.read(self._value).disturbed(field, level):
            # A heading by it would be wrong, and nothing would tell before the vehicle moves.
            self._forget()
            return
        heading = es.true_heading(field, level, MAGNETIC_DECLINATION)
        self.state[es.Q : es.RATES] = quat_from_euler(roll, pitch, heading)
        baro = [altitude_m(s.pressure_hpa) for s in self._resting if s.pressure_hpa is not None]
        self._origin_altitude_baro = float(np.mean(baro))
        fixes = [s.gps.position for s in self._resting if s.gps is not None]
        here = Geodetic(*(float(c) for c in np.mean(fixes, axis=0)))
        self.origin = here
        if self._chosen_origin is not None:
            self.move_origin(self._chosen_origin)
        self._aligned_us = sample.time_us
        self._resting.clear()

    @staticmethod
    def _kinds(sample: SensorSample) -> set[str]:
        return {name for name in _NEEDED if getattr(sample, name) is not None}

    def _forget(self) -> None:
        """A sensor is missing: keep the newer half of the samples, so that memory stays bounded."""
        self._resting = self._resting[len(self._resting) // 2 :]
        self._seen = set().union(*(self._kinds(sample) for sample in self._resting))

    def _process_noise(self) -> Vector:
        value = self._value
        q = np.zeros(es.N_STATES)
        q[es.VEL : es.ATT] = (value("EKF2_ACC_NOISE") * TICK_S) ** 2
        q[es.ATT : es.GYRO] = (value("EKF2_GYR_NOISE") * TICK_S) ** 2
        q[es.GYRO : es.ACC] = value("EKF2_GYR_B_NOISE") ** 2 * BIAS_STEP_S * TICK_S
        q[es.ACC : es.BARO] = value("EKF2_ACC_B_NOISE") ** 2 * BIAS_STEP_S * TICK_S
        q[es.BARO] = BARO_WALK_M_SQRT_S**2 * TICK_S
        return q

    def _predict(self, sample: SensorSample) -> None:
        state, horizon = self.state, self._horizon
        before = state[es.P : es.Q].copy() if horizon.is_past else None
        self.filter.predict(state, sample.gyro, sample.accel)
        if before is not None:
            horizon.moved(before, state[es.P : es.Q])

    # --- measurements

    def _fuse(self, m: Measurement) -> None:
        if self.innovations is not None:
            s = m.h @ self.filter.covariance @ m.h.T + np.diag(m.variance)
            self.innovations(m.name, m.innovation.copy(), s)
        ratio = self.filter.fuse(self.state, m.innovation, m.h, m.variance)
        self.state[m.slot] = ratio
        if ratio <= 1.0:
            m.fused_us = self._time_us

    def _fuse_gps(self, fix: GpsFix, origin: Geodetic) -> None:
        measured, value = geodetic_to_local(fix.position, origin), self._value
        r_p, r_v = value("EKF2_GPS_P_NOISE") ** 2, value("EKF2_GPS_V_NOISE") ** 2
        self._horizon.assume(value("EKF2_GPS_DELAY"))
        self._observe_yaw(fix.velocity_ned, math.sqrt(r_v))
        r_v, restart = self._check_velocity(fix.velocity_ned - self._then()[3:], r_v)
        self._answer(restart)
        if self._heading_is_due and self._suspects_heading:
            self._reset_heading(measured, fix.velocity_ned, r_p, r_v)
        m, then = self._gps_horizontal, self._then()
        m.innovation[:2] = measured[:2] - then[:2]
        m.innovation[2:] = fix.velocity_ned[:2] - then[3:5]
        m.variance[:2], m.variance[2:] = r_p, r_v
        self._fuse(m)
        m, then = self._gps_vertical, self._then()
        m.innovation[0] = measured[2] - then[2]
        m.innovation[1] = fix.velocity_ned[2] - then[5]
        # A receiver's height is about half as good as its horizontal position.
        m.variance[0], m.variance[1] = max(fix.epv_m, math.sqrt(r_p)) ** 2, r_v
        self._fuse(m)

    def _observe_yaw(self, velocity: Vector, accuracy: float) -> None:
        state = self.state
        if self._horizon.is_past:
            velocity = velocity + state[es.V : es.Q] - self._then()[3:]
        bias = state[es.GYRO_BIAS : es.ACCEL_BIAS]
        self.yaw.observe(velocity, accuracy, bias, flying=self.flying)

    def _then(self) -> Vector:
        """Return position and velocity (6,) NED when a fix of now was measured."""
        state, horizon = self.state, self._horizon
        return horizon.seen_from(state) if horizon.is_past else state[es.P : es.Q]

    def _fuse_baro(self, pressure: float) -> None:
        height = altitude_m(pressure) - self._origin_altitude_baro
        expected = -self.state.item(es.P + 2) + self.state.item(es.BARO_OFFSET)
        self._baro.innovation[0] = height - expected
        self._baro.variance[0] = self._value("EKF2_BARO_NOISE") ** 2
        self._fuse(self._baro)

    def _fuse_heading(self, field: Vector) -> None:
        m = self._heading
        observable = es.observe_heading(
            self.state, field, MAGNETIC_DECLINATION, _HEADING_BY_TURN_NED, m.innovation, m.h
        )
        innovation = m.innovation.item(0)
        if not (observable and self.compass.admits(innovation)):
            return
        m.variance[0] = self._value("EKF2_HEAD_NOISE") ** 2
        self._fuse(m)
        ratio = self.state.item(m.slot)
        self.compass.tested(innovation, ratio, self._time_us)
        deviations = math.copysign(es.GATE * ratio, innovation)
        self._answer(self.consistency.heading(deviations, self._time_us, within=ratio <= 1.0))

    # --- inertial sensors that have gone wrong

    def _check_velocity(self, innovation: Vector, variance: float) -> tuple[float, Restart | None]:
        """Return the variance of a measured velocity, and what to restart the filter with."""
        excess = self.consistency.velocity_excess
        sigma = np.sqrt(self.filter.covariance.diagonal()[es.VEL : es.ATT] + variance)
        acceleration = self.state[es.ACCELERATION : es.SIGMA]
        restart = self.consistency.velocity(innovation, sigma, acceleration, self._time_us)
        return variance * excess, restart

    @property
    def _heading_is_due(self) -> bool:
        return self.emergency.is_due(self._time_us, self.yaw, self._gps_horizontal.fused_us)

    @property
    def _suspects_heading(self) -> bool:
        return self.flying and self.emergency.is_suspected(self.state, self.yaw)

    def _answer(self, restart: Restart | None) -> None:
        """Restart the filter, unless the heading is given up for the same reason."""
        if restart is None:
            return
        if self._suspects_heading:
            self.emergency.doubt(self._time_us)
            if self._heading_is_due:
                return
        self._restart(restart)

    def _reset_heading(self, place: Vector, velocity: Vector, r_p: float, r_v: float) -> None:
        """Take over the yaw estimator's heading and the GPS's motion, and give up the compass.

        What a restart has let the filter learn meanwhile, in tilt and biases, goes with it.
        """
        state, then = self.state, self._then().copy()
        if self.doubts_inertial(self._time_us):
            # The inertial sensors were doubted for what the heading did.
            state[es.GYRO_BIAS : es.BARO_OFFSET] = self._biases_before
            state[es.Q : es.RATES] = self.yaw.attitude
        covariance = turn_to(state, self.filter.covariance, self.yaw.yaw, self.yaw.variance)
        state[es.P : es.P + 2] += place[:2] - then[:2]
        state[es.V : es.Q] += velocity - then[3:]
        for i in range(2):
            covariance[es.POS + i, es.POS + i] = r_p
        for i in range(3):
            covariance[es.VEL + i, es.VEL + i] = r_v
        self.filter.restart(covariance)
        self.compass.fail()
        self.emergency.resets += 1

    def _restart(self, restart: Restart) -> None:
        """Let the filter learn anew what inertial sensors make wrong."""
        if not self.doubts_inertial(self._time_us):
            self._biases_before = self.state[es.GYRO_BIAS : es.BARO_OFFSET].copy()
        self.consistency.restarted(self._time_us)
        variances = self.filter.covariance.diagonal().copy()
        for first, sigma in (
            (es.VEL, restart.velocity_m_s),
            (es.ATT, restart.attitude_rad),
            (es.GYRO, restart.gyro_bias_rad_s),
            (es.ACC, restart.accel_bias_m_s2),
        ):
            block = variances[first : first + 3]
            np.maximum(block, sigma**2, out=block)
        self.filter.restart(np.diag(variances))

"""Recovery of the estimator from inertial sensor and heading faults.

`consistency` distinguishes faults from noise, and `EmergencyYaw` identifies a heading fault. This
module restarts the filter's variances, or resets the heading to the yaw estimator's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector, quat_to_matrix
from airl_mav.vehicle.rotation import multiply, yaw_of
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.consistency import Compass, Consistency, Restart
from firmware_sim.autopilot.fusion_horizon import ErrorFilter
from firmware_sim.autopilot.yaw_estimator import YawEstimator

CONVERGED_RAD = 0.262
"""Maximum standard deviation of a usable yaw estimate (EKFGSF_yaw_err_max), 15° [rad]."""

SURE_RAD = math.radians(10.0)
"""Required standard deviation if inertial sensor biases may be the cause. PX4 does not model such
biases."""

FAILED_RAD = math.radians(25.0)
"""Difference beyond which a heading has failed."""

REFUSED_US = US_PER_S
"""Time of continuous GPS velocity rejection before a reset (EKFGSF_reset_delay) [µs]."""

DOUBTED_US = 2 * US_PER_S
"""Duration of a doubt, during which the yaw estimator may converge [µs]."""

SUSPECTED_SIGMA = 3.0
"""Difference in the yaw estimator's standard deviations beyond which a heading is suspected."""

EXPLAINED = 0.97
"""Share of the disagreement that another heading must explain before the heading is blamed. A gyro
error, which tilts filter and yaw estimator alike, leaves a larger rest."""


class EmergencyYaw:
    """Test for a wrong heading when GPS velocities disagree with the filter."""

    def __init__(self) -> None:
        self.resets = 0
        """Number of heading resets."""
        self._doubted_us: int | None = None

    def is_suspected(self, state: Vector, yaw: YawEstimator) -> bool:
        """Return whether the nominal state's heading is likely wrong."""
        # Difference on the circle.
        heading = yaw_of(es.attitude(state))
        off = abs(math.remainder(yaw.yaw - heading, 2.0 * math.pi))
        # Far beyond both a fixed limit and the yaw estimator's own uncertainty.
        apart = off > max(FAILED_RAD, SUSPECTED_SIGMA * math.sqrt(yaw.variance))
        return apart and yaw.explained(heading) > EXPLAINED

    def is_doubted(self, time_us: int) -> bool:
        """Return whether an error was detected recently."""
        return self._doubted_us is not None and time_us - self._doubted_us <= DOUBTED_US

    def doubt(self, time_us: int) -> None:
        """Record that an error was detected, possibly in the heading."""
        self._doubted_us = time_us

    def is_due(self, time_us: int, yaw: YawEstimator, fused_us: int | None) -> bool:
        """Return whether a suspected heading must be reset now.

        Args:
            time_us: Current time [µs].
            yaw: Yaw estimator.
            fused_us: Time of the last GPS velocity within the gate; None = never.
        """
        refused = fused_us is not None and time_us - fused_us >= REFUSED_US
        doubted = self.is_doubted(time_us)
        sigma = math.sqrt(yaw.variance)
        # A doubt may come from biases, so it needs a surer yaw than a rejection.
        return (refused and sigma < CONVERGED_RAD) or (doubted and sigma < SURE_RAD)


def turn_to(state: Vector, covariance: Vector, yaw: float, variance: float) -> Vector:
    """Turn the nominal state about the world's down axis to a heading; return its covariance.

    Correlations learned with the wrong heading are cleared. The uncertainty of velocity and biases
    returns to at least the initial values.

    Args:
        state: Nominal state, updated.
        covariance: Covariance of the error (16, 16).
        yaw: Heading [rad].
        variance: Variance of the heading [rad²].
    """
    # Half angles make the quaternion.
    half = 0.5 * (yaw - yaw_of(es.attitude(state)))
    turn = (math.cos(half), 0.0, 0.0, math.sin(half))
    state[es.Q : es.RATES] = multiply(turn, es.attitude(state))
    # Rounding can leave tiny negative variances.
    known = np.maximum(covariance.diagonal(), 0.0).copy()
    known[es.VEL :] = np.maximum(known[es.VEL :], es.INITIAL_SIGMA[es.VEL :] ** 2)
    after = np.diag(known)
    # The error is a rotation vector in body axes; tilt and heading are in world axes.
    tilt = covariance.diagonal()[es.ATT : es.ATT + 2].max()
    world = quat_to_matrix(state[es.Q : es.RATES])
    here = slice(es.ATT, es.GYRO)
    # Variances per world axis, rotated into body axes.
    after[here, here] = world.T @ np.diag([tilt, tilt, variance]) @ world
    return after


PROBATION_US = 10 * US_PER_S
"""Time for which a faulty inertial sensor is doubted (EKF2: BADACC_PROBATION) [µs]."""


class RecoveryState(NamedTuple):
    """Time and flight state of a decision."""

    time_us: int
    flying: bool
    """True if the vehicle is in the air."""
    gps_us: int | None
    """Time of the last GPS fusion within the gate [µs]; None = never."""


class Recovery:
    """Monitor of velocities and headings that restarts the filter after faults."""

    def __init__(
        self, state: Vector, error_filter: ErrorFilter, yaw: YawEstimator, record: Any = None
    ) -> None:
        """Store the nominal state, its filter (both updated), and the yaw estimator.

        `record` is the flight controller's record; None = a new one.
        """
        self._state, self._filter, self._yaw = state, error_filter, yaw
        self.consistency = Consistency(record)
        """Detector of inertial sensor faults."""
        self.compass = Compass()
        """Compass monitor."""
        self.emergency = EmergencyYaw()
        """Emergency yaw reset."""
        self._biases_before = state[es.GYRO_BIAS : es.BARO_OFFSET].copy()
        """Biases of gyro and accelerometer (6,) before the fault."""

    def use(self, error_filter: ErrorFilter) -> None:
        """Continue with another filter that carries the same errors."""
        self._filter = error_filter

    def doubts_inertial(self, now_us: int) -> bool:
        """Return whether inertial data recently disagreed with measured velocity."""
        restarted = self.consistency.restarted_us
        return restarted is not None and now_us - restarted < PROBATION_US

    def take_velocity(
        self, innovation: Vector, variance: float | Vector, now: RecoveryState
    ) -> None:
        """Check the innovation (3,) NED of a velocity with a variance."""
        sigma = np.sqrt(self._filter.covariance.diagonal()[es.VEL : es.ATT] + variance)
        acceleration = self._state[es.ACCELERATION : es.SIGMA]
        self._answer(self.consistency.velocity(innovation, sigma, acceleration, now.time_us), now)

    def take_heading(self, innovation: float, ratio: float, now: RecoveryState) -> None:
        """Check the innovation of a heading and its test ratio: above 1 it was rejected."""
        self.compass.tested(innovation, ratio, now.time_us)
        # GATE times the ratio gives standard deviations; the sign equals the innovation's sign.
        deviations = math.copysign(es.GATE * ratio, innovation)
        self._answer(self.consistency.heading(deviations, now.time_us, within=ratio <= 1.0), now)

    def heading_is_wrong(self, now: RecoveryState) -> bool:
        """Return whether the heading must be reset now."""
        return self._is_due(now) and self._is_suspected(now)

    def turn(
        self,
        place: Vector,
        velocity: Vector,
        then: Vector,
        r_p: float,
        r_v: float,
        now: RecoveryState,
    ) -> None:
        """Reset heading to the yaw estimator and motion to GPS, and disable the compass.

        Tilt and biases learned since a restart are discarded.

        Args:
            place: Measured position (3,) NED [m].
            velocity: Measured velocity (3,) NED [m/s].
            then: Filter's position and velocity (6,) at the time of the measurement.
            r_p: Variance of the position [m²].
            r_v: Variance of the velocity [m²/s²].
            now: Time and flight state.
        """
        state = self._state
        if self.doubts_inertial(now.time_us):
            # The heading error had been attributed to the inertial sensors.
            # Discard the biases that the heading error caused; the yaw estimator has its own tilt.
            state[es.GYRO_BIAS : es.BARO_OFFSET] = self._biases_before
            state[es.Q : es.RATES] = self._yaw.attitude
        covariance = turn_to(state, self._filter.covariance, self._yaw.yaw, self._yaw.variance)
        # Shift by the difference at the fix: a delayed fix moves the present state equally.
        state[es.P : es.P + 2] += place[:2] - then[:2]
        state[es.V : es.Q] += velocity - then[3:]
        for i in range(2):
            covariance[es.POS + i, es.POS + i] = r_p
        for i in range(3):
            covariance[es.VEL + i, es.VEL + i] = r_v
        self._filter.restart(covariance)
        # The wrong heading came from the compass, so the compass stays off.
        self.compass.fail()
        self.emergency.resets += 1

    def _is_due(self, now: RecoveryState) -> bool:
        return self.emergency.is_due(now.time_us, self._yaw, now.gps_us)

    def _is_suspected(self, now: RecoveryState) -> bool:
        return now.flying and self.emergency.is_suspected(self._state, self._yaw)

    def _answer(self, restart: Restart | None, now: RecoveryState) -> None:
        """Restart the filter, unless the heading is reset for the same reason."""
        if restart is None:
            return
        if self._is_suspected(now):
            self.emergency.doubt(now.time_us)
            # The heading reset removes the cause, so no restart is needed.
            if self._is_due(now):
                return
        self._restart(restart, now.time_us)

    def _restart(self, restart: Restart, time_us: int) -> None:
        """Increase the filter's variances for the effects of faulty inertial sensors."""
        # Keep the first biases of a series: later ones already contain the fault.
        if not self.doubts_inertial(time_us):
            self._biases_before = self._state[es.GYRO_BIAS : es.BARO_OFFSET].copy()
        self.consistency.restarted(time_us)
        variances = self._filter.covariance.diagonal().copy()
        for first, sigma in (
            (es.VEL, restart.velocity_m_s),
            (es.ATT, restart.attitude_rad),
            (es.GYRO, restart.gyro_bias_rad_s),
            (es.ACC, restart.accel_bias_m_s2),
        ):
            block = variances[first : first + 3]
            # Only increase: a restart must not claim more certainty.
            np.maximum(block, sigma**2, out=block)
        self._filter.restart(np.diag(variances))

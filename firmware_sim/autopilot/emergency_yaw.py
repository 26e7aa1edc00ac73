"""Emergency yaw reset: replaces a failed heading with the yaw estimator's.

Source: PX4 1.16, Ekf::isYawFailure, tryYawEmergencyReset and resetQuatStateYaw.
"""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector, quat_to_matrix
from airl_mav.vehicle.rotation import multiply, yaw_of
from firmware_sim.autopilot import error_state as es
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
        heading = yaw_of(es.attitude(state))
        off = abs(math.remainder(yaw.yaw - heading, 2.0 * math.pi))
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
    half = 0.5 * (yaw - yaw_of(es.attitude(state)))
    turn = (math.cos(half), 0.0, 0.0, math.sin(half))
    state[es.Q : es.RATES] = multiply(turn, es.attitude(state))
    known = np.maximum(covariance.diagonal(), 0.0).copy()
    known[es.VEL :] = np.maximum(known[es.VEL :], es.INITIAL_SIGMA[es.VEL :] ** 2)
    after = np.diag(known)
    # The error is a rotation vector in body axes; tilt and heading are in world axes.
    tilt = covariance.diagonal()[es.ATT : es.ATT + 2].max()
    world = quat_to_matrix(state[es.Q : es.RATES])
    here = slice(es.ATT, es.GYRO)
    after[here, here] = world.T @ np.diag([tilt, tilt, variance]) @ world
    return after

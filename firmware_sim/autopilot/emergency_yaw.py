"""When a heading is given up for the yaw estimator's, and what the filter knows afterwards.

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
"""The yaw estimator is asked only where it is as sure as this (EKFGSF_yaw_err_max), 15°."""

SURE_RAD = math.radians(10.0)
"""Where biases of the inertial sensors may be what is wrong it has to be as sure as this. PX4 has
no such biases."""

FAILED_RAD = math.radians(25.0)
"""A heading that differs by more has failed."""

REFUSED_US = US_PER_S
"""GPS velocities have to be refused for so long (EKFGSF_reset_delay) [µs]."""

DOUBTED_US = 2 * US_PER_S
"""A doubt lasts so long: meanwhile the yaw estimator may become sure [µs]."""

SUSPECTED_SIGMA = 3.0
"""A heading so many of the yaw estimator's standard deviations off is suspected."""

EXPLAINED = 0.97
"""A heading is to blame where another one explains more than this share of the disagreement. What
a gyro's error does, which tilts the filter and the yaw estimator alike, leaves more of it."""


class EmergencyYaw:
    """Whether the heading is what is wrong where GPS velocities disagree with the filter."""

    def __init__(self) -> None:
        self.resets = 0
        """How often the heading has been given up."""
        self._doubted_us: int | None = None

    def is_suspected(self, state: Vector, yaw: YawEstimator) -> bool:
        """Return whether the nominal state's heading is likely to be another one."""
        heading = yaw_of(es.attitude(state))
        off = abs(math.remainder(yaw.yaw - heading, 2.0 * math.pi))
        apart = off > max(FAILED_RAD, SUSPECTED_SIGMA * math.sqrt(yaw.variance))
        return apart and yaw.explained(heading) > EXPLAINED

    def is_doubted(self, time_us: int) -> bool:
        """Return whether something was found to be wrong lately."""
        return self._doubted_us is not None and time_us - self._doubted_us <= DOUBTED_US

    def doubt(self, time_us: int) -> None:
        """Note that something must be wrong, and that the heading may be."""
        self._doubted_us = time_us

    def is_due(self, time_us: int, yaw: YawEstimator, fused_us: int | None) -> bool:
        """Return whether a suspected heading is given up now.

        Args:
            time_us: Now.
            yaw: The yaw estimator.
            fused_us: When a GPS velocity was last within the gate; None = never.
        """
        refused = fused_us is not None and time_us - fused_us >= REFUSED_US
        doubted = self.is_doubted(time_us)
        sigma = math.sqrt(yaw.variance)
        return (refused and sigma < CONVERGED_RAD) or (doubted and sigma < SURE_RAD)


def turn_to(state: Vector, covariance: Vector, yaw: float, variance: float) -> Vector:
    """Turn the nominal state about the world's down axis to a heading; return its covariance.

    Nothing of what was learnt with the wrong heading is correlated any more, and velocity and
    biases are known no better than at first.

    Args:
        state: Nominal state, updated.
        covariance: Of its error (16, 16).
        yaw: Heading [rad].
        variance: Of it [rad²].
    """
    half = 0.5 * (yaw - yaw_of(es.attitude(state)))
    turn = (math.cos(half), 0.0, 0.0, math.sin(half))
    state[es.Q : es.RATES] = multiply(turn, es.attitude(state))
    known = np.maximum(covariance.diagonal(), 0.0).copy()
    known[es.VEL :] = np.maximum(known[es.VEL :], es.INITIAL_SIGMA[es.VEL :] ** 2)
    after = np.diag(known)
    # The error is a rotation vector in body axes; tilt and heading are the world's.
    tilt = covariance.diagonal()[es.ATT : es.ATT + 2].max()
    world = quat_to_matrix(state[es.Q : es.RATES])
    here = slice(es.ATT, es.GYRO)
    after[here, here] = world.T @ np.diag([tilt, tilt, variance]) @ world
    return after

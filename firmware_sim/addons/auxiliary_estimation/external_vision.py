"""External vision: fusion of poses from a companion computer or camera system, as in PX4.

EKF2_EV_CTRL selects the fused data: 1 horizontal position, 2 vertical position, 4 velocity, 8
heading. Source: PX4 1.16, EKF/aid_sources/external_vision. The bias estimate between two position
sources is not implemented: while GPS is fused, vision position is not used, and neither is vision
height with another height reference (EKF2_HGT_REF).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntFlag
from typing import NamedTuple

import numpy as np

from airl_mav.core.frames import Vector, quat_to_matrix
from airl_mav.vehicle.rotation import conjugate, multiply, normalize, yaw_of
from firmware_sim.addons.auxiliary_estimation.terrain_filter import reset_variances
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.estimator import Estimator
from firmware_sim.autopilot.recovery import turn_to
from firmware_sim.autopilot.sensor_monitor import LEARN_US
from firmware_sim.interfaces import Odometry

LONGEST_INTERVAL_US = 200_000
"""Maximum odometry interval to start fusion (EV_MAX_INTERVAL) [µs]."""

SILENT_US = 2 * LONGEST_INTERVAL_US
"""Timeout without odometry after which fusion stops [µs]."""

RESETS = 5
"""Maximum number of in-flight position resets to vision."""

LEAST_VARIANCE = 0.01**2
"""PX4's minimum variance of a position [m²] and of a heading [rad²]."""

FRAME_SHARE = 0.001
"""Weight of a new sample in the estimated rotation of the vision frame (PX4's filter)."""

HEIGHT_BY_VISION = 3
"""EKF2_HGT_REF value for vision height."""


class Control(IntFlag):
    """Bits of EKF2_EV_CTRL."""

    HORIZONTAL = 1
    VERTICAL = 2
    VELOCITY = 4
    YAW = 8


class _Sample(NamedTuple):
    """Pose with its quality flags."""

    odometry: Odometry
    now_us: int
    good: bool
    """True if the quality meets EKF2_EV_QMIN."""
    begins: bool
    """True if fusion may start: good quality and a sufficient rate."""
    jumped: bool
    """True if the reset counter has changed."""


class ExternalVision:
    """Fusion of odometry as selected by EKF2_EV_CTRL."""

    def __init__(self, estimator: Estimator, judge: Callable[[Vector, Vector], float]) -> None:
        """Start without odometry.

        `judge` checks the innovation (3,) and variance (3,) of a velocity, restarts the filter upon
        an inertial sensor fault, and returns the ratio of measured to stated variance.
        """
        self._estimator, self._judge = estimator, judge
        self._value, self._state, self._fuse = estimator.value, estimator.state, estimator.fuse
        self.horizon = es.FusionHorizon(0.0)
        """Vehicle motion since the measurement time of current odometry (EKF2_EV_DELAY)."""
        self.position = es.Measurement("vision_position", 0, es.selecting(es.POS, es.POS + 1))
        self.height = es.Measurement("vision_height", 3, es.selecting(es.POS + 2))
        self.velocity = es.Measurement(
            "vision_velocity", 0, es.selecting(es.VEL, es.VEL + 1, es.VEL + 2)
        )
        self.yaw = es.Measurement("vision_heading", 2, np.zeros((1, es.N_STATES)))
        self.fused = Control(0)
        """Data currently fused."""
        self._newest: Odometry | None = None
        self._first_us = 0
        """Time of the first odometry [µs]."""
        self._has_noise: bool | None = None
        """True if successive poses differ even at rest; None = not known yet."""
        self._previous: Odometry | None = None
        """Newest odometry of good quality."""
        self._previous_us = 0
        self._frame = (1.0, 0.0, 0.0, 0.0)
        """Rotation from the vision frame to the filter's frame (quaternion)."""
        self._is_frame_known = False
        self._resets_left = RESETS
        self.on_height_moved: Callable[[float], None] | None = None
        """Callback with the downward shift [m] of a height reset to vision."""

    def take(self, odometry: Odometry, now_us: int, *, gps: bool, flying: bool) -> None:
        """Fuse the selected data of a pose received now; `gps` is True if GPS is being fused."""
        # Bits above 15 have no meaning here.
        asked = Control(int(self._value("EKF2_EV_CTRL")) & 15)
        if self._is_stuck(odometry, now_us, flying=flying):
            return
        self.horizon.assume(self._value("EKF2_EV_DELAY"))
        # Data that the parameter no longer selects stop at once.
        self.fused &= asked
        previous, wanted = self._previous, self._value("EKF2_EV_QMIN")
        good = wanted <= 0 or odometry.quality >= wanted
        # Fusion starts only with a sufficient rate: two good poses close together.
        begins = good and previous is not None and now_us - self._previous_us < LONGEST_INTERVAL_US
        jumped = previous is not None and odometry.reset_counter != previous.reset_counter
        # The rotation between the frames is needed before position and velocity.
        self._learn_frame(odometry, anew=jumped)
        sample = _Sample(odometry, now_us, good, begins, jumped)
        # Heading first: it decides in which frame position and velocity are fused.
        if asked & Control.YAW:
            self._take_yaw(sample, gps=gps)
        if asked & Control.VELOCITY:
            self._take_velocity(sample)
        if asked & Control.HORIZONTAL and not gps:
            self._take_position(sample, flying=flying)
        # GPS and vision position would differ by a bias that is not estimated.
        elif gps:
            self.fused &= ~Control.HORIZONTAL
        if asked & Control.VERTICAL and self._value("EKF2_HGT_REF") == HEIGHT_BY_VISION:
            self._take_height(sample)
        else:
            self.fused &= ~Control.VERTICAL
        if good:
            self._previous, self._previous_us = odometry, now_us

    def _is_stuck(self, odometry: Odometry, now_us: int, *, flying: bool) -> bool:
        """Return whether odometry is frozen: repeated values from a source that has noise.

        In the air any repetition is a fault. At rest it is one if the first second showed noise.
        """
        before = self._newest
        # Compare position, velocity and quaternion; missing values count as equal.
        repeats = before is not None and all(
            (a is None and b is None) or (a is not None and b is not None and np.array_equal(a, b))
            for a, b in zip(odometry[:3], before[:3], strict=True)
        )
        self._newest = odometry
        if before is None:
            self._first_us = now_us
        # A repetition, or a second without one, decides whether the source has noise.
        elif self._has_noise is None and (repeats or now_us - self._first_us >= LEARN_US):
            self._has_noise = not repeats
        return repeats and (flying or bool(self._has_noise))

    def look(self, now_us: int) -> None:
        """Stop fusion after the odometry timeout."""
        if now_us - self._previous_us > SILENT_US:
            self.fused, self._previous, self._is_frame_known = Control(0), None, False

    # --- heading

    def _take_yaw(self, sample: _Sample, *, gps: bool) -> None:
        odometry, now_us, good, begins, jumped = sample
        quaternion, active = odometry.quaternion, bool(self.fused & Control.YAW)
        in_ned = odometry.pose_frame == "ned"
        # A heading relative to the vision frame would rotate GPS measurements.
        if quaternion is None or (gps and not in_ned) or not (active or begins):
            self.fused &= ~Control.YAW
            return
        yaw = yaw_of(tuple(quaternion.tolist()))
        # PX4 uses EKF2_EVA_NOISE [rad] as the variance here.
        noise = self._value("EKF2_EVA_NOISE")
        told = self._variance(odometry.orientation_variance, noise).item(2)
        variance = max(told, noise, LEAST_VARIANCE)
        m = self.yaw
        # A jump of the source, or long rejection, needs a reset; else fuse with a gate.
        if active:
            anew = jumped or self._is_overdue(m, now_us)
        else:
            # There is no reference for a gate.
            anew = not (in_ned and self._estimator.is_north_known)
        if anew and good:
            carried = self._estimator.filter
            carried.restart(turn_to(self._state, carried.covariance, yaw, variance))
            # From now on the heading belongs to the vision frame, unless the pose is in NED.
            self.fused |= Control.YAW
            self._estimator.is_north_known, m.fused_us = in_ned, now_us
        elif good:
            q = es.attitude(self._state)
            m.innovation[0] = math.remainder(yaw - yaw_of(q), 2.0 * math.pi)
            m.variance[0] = variance
            m.h[0, es.ATT : es.GYRO] = yaw_by_turn(q)
            # A compass that disagrees is not disabled in favour of vision.
            if self._fuse(m):
                self.fused |= Control.YAW

    def _is_overdue(self, m: es.Measurement, now_us: int) -> bool:
        """Return whether a measurement was rejected for EKF2_NOAID_TOUT and needs a reset."""
        since_us = m.fused_us
        return since_us is not None and now_us - since_us > self._value("EKF2_NOAID_TOUT")

    # --- velocity

    def _take_velocity(self, sample: _Sample) -> None:
        odometry, _, good, begins, _ = sample
        measured, active = odometry.velocity, bool(self.fused & Control.VELOCITY)
        if measured is None or not (active or begins):
            self.fused &= ~Control.VELOCITY
            return
        if not good:
            return
        m, frame = self.velocity, odometry.velocity_frame
        # NED does not depend on the attitude: clear the entries of an earlier body velocity.
        m.h[:, es.ATT : es.GYRO] = 0.0
        if frame == "body":
            body = quat_to_matrix(self._state[es.Q : es.RATES])
            # An attitude error rotates a velocity measured in body axes.
            m.h[:, es.ATT : es.GYRO] = body @ _cross(measured)
            measured = body @ measured
        # FRD without vision heading: rotate from the vision frame into the filter's.
        elif frame == "frd" and not self.fused & Control.YAW:
            measured = self._into_own_frame(measured)
        noise = self._value("EKF2_EVV_NOISE")
        m.innovation[:] = measured - self._then()[3:]
        m.variance[:] = self._variance(odometry.velocity_variance, noise)
        m.variance *= self._judge(m.innovation.copy(), m.variance)
        # The check may have restarted the filter.
        m.innovation[:] = measured - self._then()[3:]
        self._fuse(m)
        self.fused |= Control.VELOCITY

    # --- position

    def _take_position(self, sample: _Sample, *, flying: bool) -> None:
        odometry, now_us, good, begins, jumped = sample
        active = bool(self.fused & Control.HORIZONTAL)
        needs_north = odometry.pose_frame == "ned" and not self._estimator.is_north_known
        # A NED position is useless while local NED has no north.
        if odometry.position is None or needs_north or not (active or begins):
            self.fused &= ~Control.HORIZONTAL
            return
        measured, variance = self._place(odometry.position, odometry)
        m = self.position
        overdue = self._is_overdue(m, now_us)
        # Reset at the start, after a jump of the source, or after long rejection.
        if not active or (jumped and good) or (overdue and good and self._resets_left > 0):
            self._put(measured, variance)
            m.fused_us = now_us
            if not active:
                self._resets_left = RESETS
            # A limited number in flight: a source that disagrees again and again is wrong.
            elif overdue and flying:
                self._resets_left -= 1
            self.fused |= Control.HORIZONTAL
        elif overdue:
            self.fused &= ~Control.HORIZONTAL
        elif good:
            m.innovation[:] = measured[:2] - self._then()[:2]
            m.variance[:] = variance[:2]
            self._fuse(m)

    def _take_height(self, sample: _Sample) -> None:
        odometry, now_us, good, begins, jumped = sample
        active = bool(self.fused & Control.VERTICAL)
        if odometry.position is None or not (active or begins):
            self.fused &= ~Control.VERTICAL
            return
        measured, variance = self._place(odometry.position, odometry)
        m = self.height
        if not active or (good and (jumped or self._is_overdue(m, now_us))):
            self._put_height(measured.item(2), variance.item(2))
            self.fused |= Control.VERTICAL
            m.fused_us = now_us
        elif good:
            m.innovation[0] = measured.item(2) - self._then().item(2)
            m.variance[0] = variance.item(2)
            self._fuse(m)

    def _place(self, position: Vector, odometry: Odometry) -> tuple[Vector, Vector]:
        """Return the position of odometry and its variance (3,), in the filter's frame."""
        noise = self._value("EKF2_EVP_NOISE")
        variance = np.maximum(self._variance(odometry.position_variance, noise), LEAST_VARIANCE)
        if odometry.pose_frame == "frd" and not self.fused & Control.YAW:
            # A rotated position is also uncertain by the rotation.
            turned = self._variance(odometry.orientation_variance, self._value("EKF2_EVA_NOISE"))
            position, variance = self._into_own_frame(position), np.maximum(variance, turned.max())
        return position, variance

    def _variance(self, told: Vector, noise: float) -> Vector:
        """Return the variance (3,): as reported, at least the parameter's (EKF2_EV_NOISE_MD)."""
        # A client may report a variance; the parameter is its minimum.
        if self._value("EKF2_EV_NOISE_MD") == 0 and np.isfinite(told).all():
            return np.maximum(told, noise**2)
        return np.full(3, noise**2)

    def _then(self) -> Vector:
        """Return position and velocity (6,) at the measurement time of current odometry."""
        state, horizon = self._state, self.horizon
        return horizon.seen_from(state) if horizon.is_past else state[es.P : es.Q]

    # --- jumps

    def _put(self, place: Vector, variance: Vector) -> None:
        """Reset the horizontal position and its covariance."""
        # Shift by the difference at the measurement time, so that motion since then stays.
        moved = place[:2] - self._then()[:2]
        self._state[es.P : es.P + 2] += moved
        reset_variances(self._estimator.filter, {es.POS + i: variance.item(i) for i in range(2)})

    def _put_height(self, down: float, variance: float) -> None:
        """Reset the height; the barometer offset shifts with it."""
        moved = down - self._then().item(2)
        self._state[es.P + 2] += moved
        # The barometer must agree with the new height.
        self._state[es.BARO_OFFSET] += moved
        if self.on_height_moved is not None:
            self.on_height_moved(moved)
        reset_variances(self._estimator.filter, {es.POS + 2: variance})

    # --- vision's frame

    def _learn_frame(self, odometry: Odometry, *, anew: bool) -> None:
        if odometry.quaternion is None:
            return
        seen = tuple(odometry.quaternion.tolist())
        turn = multiply(es.attitude(self._state), conjugate(seen))
        if anew or not self._is_frame_known:
            self._frame, self._is_frame_known = normalize(turn), True
            return
        # q and -q are the same rotation: average the nearer of both.
        sign = 1.0 if sum(a * b for a, b in zip(turn, self._frame, strict=True)) >= 0.0 else -1.0
        w, x, y, z = (
            a + FRAME_SHARE * (sign * b - a) for a, b in zip(self._frame, turn, strict=True)
        )
        # A mean of quaternions does not have unit length.
        self._frame = normalize((w, x, y, z))

    def _into_own_frame(self, vector: Vector) -> Vector:
        turned: Vector = quat_to_matrix(np.array(self._frame)) @ vector
        return turned


def yaw_by_turn(q: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Return the change of yaw by a turn about each body axis (Euler's kinematic equations)."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    return 0.0, math.sin(roll) / math.cos(pitch), math.cos(roll) / math.cos(pitch)


def _cross(v: Vector) -> Vector:
    """Return the matrix [v]x."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

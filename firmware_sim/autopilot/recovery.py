"""Recovery of the estimator from inertial sensor and heading faults.

`Consistency` distinguishes faults from noise, and `EmergencyYaw` identifies a heading fault.
`Recovery` increases the filter's variances, or resets the heading to the yaw estimator's.

Noise of any strength changes its sign from sample to sample. An unmodelled accelerometer or gyro
error keeps the innovations of velocity and heading on one side. The filter then needs larger
variances, above all for the biases. A receiver with more velocity noise than stated shows in the
differences between innovations, which slow errors do not affect.

Sources: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, ch.
5.4 (consistency) and 11.2 (adjusting the noise upon a test of the innovations). PX4's EKF2 has the
same responses with other tests: it raises the accelerometer noise (`BADACC_BIAS_PNOISE`), resets
the gyro bias variance, and stops using a compass (`mag_fault`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.frames import Vector, quat_to_matrix
from airl_mav.core.kernels import kernel
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

        `fused_us` is the time of the last GPS velocity within the gate; None = never.
        """
        refused = fused_us is not None and time_us - fused_us >= REFUSED_US
        doubted = self.is_doubted(time_us)
        sigma = math.sqrt(yaw.variance)
        # A doubt may come from biases, so it needs a surer yaw than a rejection.
        return (refused and sigma < CONVERGED_RAD) or (doubted and sigma < SURE_RAD)


def turn_to(state: Vector, covariance: Vector, yaw: float, variance: float) -> Vector:
    """Turn the nominal state about the world's down axis to a heading; return its covariance.

    Correlations learned with the wrong heading are cleared. The uncertainty of velocity and biases
    returns to at least the initial values. The heading is `yaw` [rad], its variance [rad²].
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
        self, state: Vector, error_filter: es.ErrorFilter, yaw: YawEstimator, record: Any
    ) -> None:
        """Store the nominal state and its filter, both updated, yaw estimator and record."""
        self._state, self._filter, self._yaw = state, error_filter, yaw
        self.consistency = Consistency(record)
        """Detector of inertial sensor faults."""
        self.compass = Compass()
        """Compass monitor."""
        self.emergency = EmergencyYaw()
        """Emergency yaw reset."""
        self._biases_before = state[es.GYRO_BIAS : es.BARO_OFFSET].copy()
        """Biases of gyro and accelerometer (6,) before the fault."""

    def use(self, error_filter: es.ErrorFilter) -> None:
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

        Tilt and biases learned since a restart are discarded. `place` and `velocity` are measured,
        (3,) NED, with variances `r_p` [m²] and `r_v` [m²/s²]; `then` are the filter's position and
        velocity (6,) at the time of the measurement.
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


FAR = 3.0
"""Threshold in standard deviations beyond which an innovation counts towards a run."""

VELOCITY_RUN = 6
"""Consecutive GPS velocities beyond `FAR` on the same side: 0.6 s at 10 Hz. False alarm rate: once
in 10^16 samples."""

HEADING_RUN = 25
"""Consecutive headings beyond `FAR`: 0.5 s at 50 Hz."""

LATE_S = 0.5
"""Tolerated additional receiver delay [s]. Velocity innovations within the vehicle's velocity
change over this time do not count as an inertial sensor fault."""

LOOK_BACK = 6
"""Number of samples searched for the maximum acceleration."""

COMPASS_REFUSED_US = US_PER_S
"""Time of continuous rejection after which a compass is disabled [µs]."""

NOISY = 4.0
"""Ratio of measured to expected velocity variance beyond which a receiver counts as noisy."""

_NOISE_SHARE = 0.1
"""Weight of the newest sample in the mean: 1 s at 10 Hz."""

_OUTLIER = 12.0
"""Upper limit of a sample's contribution: one outlier, which differs twice, is not yet noise."""


class Restart(NamedTuple):
    """Standard deviations of the filter's errors after a restart."""

    velocity_m_s: float
    attitude_rad: float
    accel_bias_m_s2: float
    gyro_bias_rad_s: float


LEAST = Restart(0.3, 0.1, 0.5, 0.04)
GREATEST = Restart(10.0, 0.3, 5.0, 0.2)
"""Limits of the standard deviations. For the gyro bias they are 2.3 and 11 °/s."""


def restart_for(velocity_m_s: float, seconds: float) -> Restart:
    """Return the sensor errors that explain a velocity error accumulated in a time [s].

    Candidates are an accelerometer error of `velocity / time`, a tilt with that share of gravity,
    and a gyro error that causes this tilt in that time.
    """
    acceleration = abs(velocity_m_s) / seconds
    tilt = acceleration / GRAVITY_M_S2
    sigmas = Restart(abs(velocity_m_s), tilt, acceleration, tilt / seconds)
    bounded = zip(sigmas, LEAST, GREATEST, strict=True)
    return Restart._make(min(max(sigma, least), greatest) for sigma, least, greatest in bounded)


class InnovationCounter:
    """Counter for consecutive large innovations on the same side."""

    def __init__(self, needed: int) -> None:
        """Start at zero; `needed` innovations in a row are not noise."""
        self._needed = needed
        self._side = 0
        self.length = 0
        """Current length of the run."""
        self._since_us = 0

    def take(self, deviations: float, time_us: int) -> float:
        """Add an innovation in standard deviations.

        Returns:
            Duration of the run [s] if it is too long to be noise, else 0.
        """
        side = (deviations > FAR) - (deviations < -FAR)
        # A change of side ends a run: noise changes its sign.
        if side == 0 or side != self._side:
            self._side, self.length, self._since_us = side, 0, time_us
        if side == 0:
            return 0.0
        self.length += 1
        return (time_us - self._since_us) / US_PER_S if self.length >= self._needed else 0.0

    def restart(self) -> None:
        """Reset the run."""
        self._side = self.length = 0


class Compass:
    """Compass monitor that disables a compass after continuous rejection.

    Without a compass the heading variance grows until the gate accepts any heading. To enable the
    compass again, a heading must lie within the gate of the first rejection.
    """

    def __init__(self) -> None:
        self.given_up = False
        self._failed = False
        self._refused_us: int | None = None
        self._gate_rad = 0.0

    @property
    def is_suspect(self) -> bool:
        """True if headings are rejected, or were recently."""
        return self.given_up or self._failed or self._refused_us is not None

    def admits(self, innovation_rad: float) -> bool:
        """Return whether a heading may be fused if it also passes the gate."""
        near = not self.given_up or abs(innovation_rad) <= self._gate_rad
        return near and not self._failed

    def fail(self) -> None:
        """Disable the compass permanently: the heading has been proven wrong."""
        self.given_up = self._failed = True

    def tested(self, innovation_rad: float, ratio: float, time_us: int) -> None:
        """Record the test ratio of a heading: above 1 it was rejected."""
        if ratio <= 1.0:
            self.given_up, self._refused_us = False, None
        elif self._refused_us is None:
            # The gate's width follows from the innovation and its ratio.
            self._refused_us, self._gate_rad = time_us, abs(innovation_rad) / ratio
        elif time_us - self._refused_us >= COMPASS_REFUSED_US:
            self.given_up = True


@kernel
def note_velocity(record: Any, deviations: Vector, acceleration: Vector) -> None:
    """Record a velocity's noise and the vehicle's acceleration in a flight controller's record.

    `deviations` (3,) are the innovation in standard deviations; `acceleration` (3,) is NED [m/s²].
    """
    square, slot = 0.0, record.fixes % LOOK_BACK
    for i in range(3):
        square += (deviations[i] - record.velocity_before[i]) ** 2
        record.velocity_before[i] = deviations[i]
        record.accelerations[slot, i] = abs(acceleration[i])
    record.fixes += 1
    if not math.isnan(square):
        # The difference of two independent samples has twice the variance.
        variance = min(square / 6.0, _OUTLIER)
        record.velocity_noise += _NOISE_SHARE * (variance - record.velocity_noise)


@kernel
def _note_velocity(records: Any, deviations: Vector, acceleration: Vector) -> None:
    note_velocity(records[0], deviations, acceleration)


class Consistency:
    """Monitor for the innovations of velocity and heading."""

    def __init__(self, record: Any) -> None:
        """Use the record of a flight controller."""
        self._record = record
        self.restarts = 0
        """Number of filter restarts."""
        self.restarted_us: int | None = None
        """Time of the last restart."""
        self._runs = [InnovationCounter(VELOCITY_RUN) for _ in range(3)]
        self._heading = InnovationCounter(HEADING_RUN)

    @property
    def velocity_deviates(self) -> bool:
        """True if the newest velocities were far off on one side, or noisy."""
        return any(run.length for run in self._runs) or self.velocity_excess > 1.0

    @property
    def heading_deviates(self) -> bool:
        """True if the newest headings were far off on one side."""
        return self._heading.length > 0

    @property
    def velocity_excess(self) -> float:
        """Ratio of measured to expected velocity variance if above `NOISY`, else 1."""
        noise: float = self._record["velocity_noise"].item(0)
        return noise if noise > NOISY else 1.0

    def velocity(
        self, innovation: Vector, sigma: Vector, acceleration: Vector, time_us: int
    ) -> Restart | None:
        """Check a GPS velocity; return the standard deviations of a filter restart; None = none.

        The innovation (3,) is measured minus expected, NED [m/s], `sigma` (3,) its expected
        standard deviation, `acceleration` (3,) the estimate [m/s²].
        """
        deviations = innovation / sigma
        if not np.isfinite(deviations).all():
            return None
        # Read the excess before this sample changes it.
        excess, record = self.velocity_excess, self._record
        _note_velocity(record, deviations, acceleration)
        seen = min(record["fixes"].item(0), LOOK_BACK)
        # A receiver that is later than stated is off by the speed change in that time.
        late = LATE_S * np.max(record["accelerations"][0, :seen], axis=0)
        unexplained = np.sign(innovation) * np.maximum(np.abs(innovation) - late, 0.0)
        deviations = unexplained / (sigma * math.sqrt(excess))
        lasted = [
            run.take(z, time_us) for run, z in zip(self._runs, deviations.tolist(), strict=True)
        ]
        if not any(lasted):
            return None
        # The longest run gives the smallest error that explains the deviation.
        return self._anew(restart_for(float(np.abs(innovation).max()), max(lasted)))

    def heading(self, deviations: float, time_us: int, *, within: bool) -> Restart | None:
        """Check a heading innovation in standard deviations; `within` = inside the gate.

        A compass fault leaves the gate at once. Only a gyro error grows through it and counts.
        """
        if not within and self._heading.length == 0:
            return None
        lasted = self._heading.take(deviations, time_us)
        return self._anew(restart_for(0.0, lasted)) if lasted else None

    def restarted(self, time_us: int) -> None:
        """Record that the filter was restarted with the returned values."""
        self.restarts += 1
        self.restarted_us = time_us

    def _anew(self, restart: Restart) -> Restart:
        for run in (*self._runs, self._heading):
            run.restart()
        # NaN skips the next difference: the restart moves the innovations.
        self._record["velocity_before"] = np.nan
        return restart

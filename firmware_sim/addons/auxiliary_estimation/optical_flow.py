"""Optical flow: fusion of ground motion in a downward camera, as in PX4.

With a known height above ground, flow measures velocity. With a known velocity, it measures the
height above ground. EKF2_OF_CTRL enables it. Source: PX4 (main of 2026, one sensor),
EKF/aid_sources/optical_flow and ZeroVelocityUpdate, FakePosFusion of the same folder. Not
implemented: the sensor's height and speed limits in piloted modes, and changes of SENS_FLOW_MINHGT,
_MAXHGT and _MAXR, which keep their defaults.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.constants import MS_PER_S, TICK_S, US_PER_S
from airl_mav.core.frames import Vector, quat_to_matrix
from firmware_sim.addons.auxiliary_estimation import range_finder, sensors, terrain_filter
from firmware_sim.autopilot import error_state as es
from firmware_sim.interfaces import FlowReading

LONGEST_S = 1.0
"""Maximum integration time of a measurement [s]."""

STUCK = 10
"""Number of identical non-zero measurements that indicate a frozen sensor, which is not fused (PX4
would fuse it). In the air values never repeat, except zeros of a coarse sensor."""

_TO_BEGIN = 10
"""Number of measurements before the first fusion."""
_BEGIN_AGAIN_US = 2 * US_PER_S
"""Minimum time between the last fusion and a new start [µs]."""
_UNUSED_US = US_PER_S
"""Time of rejection after which a reset or stop follows (no_aid_timeout_max) [µs]."""
_SILENT_US = 7 * US_PER_S
"""Timeout without data after which fusion stops (reset_timeout_max) [µs]."""
_COS_GREATEST_TILT = math.cos(math.radians(45.0))
"""Cosine of the maximum tilt: range_cos_max_tilt."""
_LEAST_CLEARANCE_M = 0.01
_LEAST_NOISE_RAD_S = 0.05
_BIAS_SHARE, _GREATEST_BIAS_RAD_S = 0.01, 0.1
"""Filter gain and limit for the difference between the sensor's gyro and the vehicle's."""
_SMOOTHED_SHARE = 0.1
"""Weight of a new sample in the smoothed flow: a 0.09 s low-pass at 0.01 s steps."""
_UNKNOWN_GROUND_M2 = 100.0
"""Variance of a terrain height reset by flow."""
_BEST_QUALITY = 255.0

_STAND_EVERY_US = 200_000
_STANDING_M, _STANDING_M_S = 0.01, 0.001
"""Standard deviations of the zero-motion measurement on the ground."""


class OpticalFlowFusion:
    """Fusion of one optical flow sensor."""

    def __init__(
        self,
        value: Callable[[str], float],
        state: Vector,
        ground: range_finder.RangeFinder,
        fuse: Callable[[es.Measurement], bool],
    ) -> None:
        """Start without measurements.

        `ground` is the range finder with the terrain filter, `fuse` fuses a measurement without
        terrain.
        """
        self._value, self._state = value, state
        self._ground, self._terrain = ground, ground.terrain
        self._fuse_standing = fuse
        self.horizon = es.FusionHorizon(0.0)
        """Vehicle motion since the middle of the integration time of current measurements: half
        that time plus EKF2_OF_DELAY ago."""
        self.fused = False
        """True if flow is being fused."""
        self.fused_us: int | None = None
        """Time of the newest measurement within the gate [µs]; None = never."""
        self.innovation, self.ratio = np.zeros(2), np.zeros(2)
        """Innovation [rad/s] and test ratios of the newest measurement; 1 = at the gate."""
        self.reading: FlowReading | None = None
        """Newest reading."""
        self.reading_us = 0
        """Time of arrival of the reading [µs]."""
        self._waiting = False
        self._repeated = 0
        self._count = 0
        self._turned, self._turned_s = np.zeros(3), 0.0
        """Rotation of the vehicle's gyro since the newest measurement [rad], and the time since
        then [s]."""
        self._rate = np.zeros(3)
        """Mean rate of the vehicle's gyro before the newest measurement [rad/s]."""
        self._gyro_bias = np.zeros(3)
        self._smoothed_velocity, self._smoothed_rate = np.zeros(2), np.zeros(2)
        """Body velocity [m/s] and flow [rad/s]."""
        held = es.selecting(es.POS, es.POS + 1, es.VEL, es.VEL + 1)
        self.standing = es.Measurement("standing", 0, held)
        """Zero-motion measurement of a vehicle on the ground."""
        self.standing.variance[:] = [_STANDING_M**2] * 2 + [_STANDING_M_S**2] * 2
        self._stands_at: Vector | None = None
        self._stood_us = 0

    def take(self, reading: FlowReading, now_us: int) -> None:
        """Store a measurement for this tick; missing rotation comes from the vehicle's gyro."""
        interval_s = reading.interval_s
        told = np.isfinite(reading.flow).all() and 0.0 <= interval_s < LONGEST_S
        # A zero interval is accepted only with quality 0, as a report of no flow.
        if not told or (interval_s == 0.0 and reading.quality > 0):
            return
        before = self.reading
        repeats = before is not None and np.array_equal(reading.flow, before.flow)
        # A coarse sensor may repeat zeros at rest: only non-zero repetitions count.
        self._repeated = self._repeated + 1 if repeats and reading.flow.any() else 0
        self._rate = self._turned / self._turned_s if self._turned_s > 0.0 else np.zeros(3)
        self._turned, self._turned_s = np.zeros(3), 0.0
        # Rotation of the vehicle's gyro over the same interval replaces missing axes.
        turned, own = reading.turned, self._rate * interval_s
        if not np.isfinite(turned[:2]).all():
            turned = own
        elif not math.isfinite(turned.item(2)):
            turned = np.array([*turned[:2].tolist(), own.item(2)])
        self.reading = reading._replace(turned=turned)
        self.reading_us, self._waiting = now_us, self._repeated < STUCK

    def turn(self, gyro: Vector) -> None:
        """Integrate a tick's rate (3,) FRD [rad/s]."""
        self._turned += gyro * TICK_S
        self._turned_s += TICK_S

    def step(self, now_us: int, *, aided: bool, flying: bool) -> None:
        """Fuse a received measurement; call once per tick.

        `aided` is True if another sensor measures horizontal motion.
        """
        if self._value("EKF2_OF_CTRL") != 1:
            self._stop()
        elif self._waiting and self.reading is not None:
            self._control(self.reading, now_us, aided=aided, flying=flying)
        elif self.fused and now_us - self.reading_us > _SILENT_US:
            self._stop()
        self._waiting = False
        self._stand(now_us, free=flying or aided)

    def told_motion_since(self, since_us: float) -> bool:
        """Return whether flow or zero motion was fused since then [µs]."""
        times = (self.fused_us, self.standing.fused_us)
        return any(time is not None and time >= since_us for time in times)

    def is_coming(self, now_us: int) -> bool:
        """Return whether measurements arrive that would be fused in the air."""
        lately = self.reading is not None and now_us - self.reading_us <= _UNUSED_US
        return lately and self._value("EKF2_OF_CTRL") == 1

    # --- fusion

    def _control(self, reading: FlowReading, now_us: int, *, aided: bool, flying: bool) -> None:
        value, ground = self._value, self._ground
        rate, gyro = self._rates(reading)
        # The measurement belongs to the middle of its integration time.
        self.horizon.assume(value("EKF2_OF_DELAY") + 0.5 * MS_PER_S * reading.interval_s)
        # Remove the rotation: the rest is translation over the ground.
        compensated = rate - gyro[:2]
        variance = self._variance(reading.quality)
        # Test every measurement; `_fuse` reads the ratios.
        self._test(compensated, gyro, variance)
        # On the ground PX4 accepts another minimum quality.
        least_quality = value("EKF2_OF_QMIN" if flying else "EKF2_OF_QMIN_GND")
        fast = max(math.hypot(*rate.tolist()), math.hypot(*compensated.tolist()))
        good = (
            reading.quality >= least_quality
            and fast <= sensors.GREATEST_RAD_S
            and self._rotation[2, 2] > _COS_GREATEST_TILT
        )
        if good:
            # As in PX4, invalid flow is also smoothed: the velocity may be reset to it.
            self._smooth(compensated)
        # Height by terrain and estimate, not by the newest range.
        height = self._terrain.down - self._state.item(es.P + 2)
        possible = sensors.LEAST_HEIGHT_M <= height <= sensors.GREATEST_HEIGHT_M
        tells_ground = not ground.is_reference
        if not possible:
            self._stop()
        elif self.fused:
            if good:
                self._fuse(compensated, gyro, variance, now_us, ground=tells_ground)
            # Rejected for too long: reset to flow if nothing else measures motion.
            if self.fused_us is not None and now_us - self.fused_us > _UNUSED_US:
                if good and flying and not aided:
                    self._put_velocity(variance, now_us)
                else:
                    self._stop()
        elif good and self._may_begin(now_us, aided=aided):
            self._begin(compensated, gyro, variance, now_us, aided=aided)

    def _may_begin(self, now_us: int, *, aided: bool) -> bool:
        """Return whether the conditions for fusion besides a good measurement are met."""
        lately = self.fused_us is not None and now_us - self.fused_us <= _BEGIN_AGAIN_US
        # Flow needs a known scale: a height above ground, or another aid.
        known = aided or self._ground.is_reference or self._ground.clearance().valid
        return self._count > _TO_BEGIN and known and not lately

    def _begin(
        self, compensated: Vector, gyro: Vector, variance: float, now_us: int, *, aided: bool
    ) -> None:
        ground = self._ground
        tells_ground = not ground.is_reference
        # Without another aid, velocity drifts freely: start from the flow velocity.
        if not aided:
            self._put_velocity(variance, now_us)
        elif not self._fuse(compensated, gyro, variance, now_us, ground=tells_ground):
            # The terrain is reset by flow only if no range measures it.
            if ground.tells_ground or not tells_ground:
                return
            self._put_ground(now_us)
        self.fused = True

    def _stop(self) -> None:
        if self.fused:
            # A restart needs a new series of measurements.
            self.fused, self._count = False, 0

    def _fuse(
        self, compensated: Vector, gyro: Vector, variance: float, now_us: int, *, ground: bool
    ) -> bool:
        """Fuse both axes in sequence; return whether they were within the gate."""
        if (self.ratio > 1.0).any():
            return False
        # Both axes are linearised at the state before.
        jacobian = self._jacobian()
        for axis in range(2):
            row = jacobian[axis]
            # The first axis has changed the state: compute the second innovation again.
            if axis == 1:
                self.innovation[1] = compensated[1] - self._predicted(gyro)[1]
                self.ratio[1] = self._ratio(self.innovation.item(1), row, variance)
                if self.ratio[1] > 1.0:
                    # Skip only this axis: the first is fused already.
                    continue
            self._terrain.fuse_with_ground(
                self._state, self.innovation.item(axis), row, variance, vehicle=True, ground=ground
            )
        self.fused_us = now_us
        if ground:
            self._ground.ground_seen(now_us)
        return True

    def _rates(self, reading: FlowReading) -> tuple[Vector, Vector]:
        """Return flow (2,) and gyro (3,) of a measurement [rad/s], with PX4's signs.

        The signs are opposite to the sensor's: positive for a scene rotating about the axis.
        """
        if reading.interval_s == 0.0:
            return np.zeros(2), np.zeros(3)
        gyro = -reading.turned / reading.interval_s
        # The vehicle's gyro with opposite sign, minus the estimated bias.
        reference = self._state[es.GYRO_BIAS : es.ACCEL_BIAS] - self._rate
        off = np.clip(gyro - reference, -_GREATEST_BIAS_RAD_S, _GREATEST_BIAS_RAD_S)
        self._gyro_bias += _BIAS_SHARE * (off - self._gyro_bias)
        return -reading.flow / reading.interval_s, gyro - self._gyro_bias

    def _variance(self, quality: int) -> float:
        """Return the variance of the flow [rad²/s²] for a quality."""
        value, least = self._value, self._value("EKF2_OF_QMIN")
        # Interpolate the standard deviation between best and worst quality.
        best = max(value("EKF2_OF_N_MIN"), _LEAST_NOISE_RAD_S)
        worst = max(value("EKF2_OF_N_MAX"), _LEAST_NOISE_RAD_S)
        span = _BEST_QUALITY - least
        share = min(1.0, max(0.0, (quality - least) / span)) if span >= 1.0 else 0.0
        return (best * share + worst * (1.0 - share)) ** 2

    def _test(self, compensated: Vector, gyro: Vector, variance: float) -> None:
        """Compute innovation and test ratios of a measurement."""
        self.innovation = compensated - self._predicted(gyro)
        jacobian = self._jacobian()
        for axis in range(2):
            self.ratio[axis] = self._ratio(self.innovation.item(axis), jacobian[axis], variance)

    def _ratio(self, innovation: float, row: Vector, variance: float) -> float:
        # PX4 limits the gate to at least one standard deviation.
        gate = max(self._value("EKF2_OF_GATE"), 1.0)
        return innovation**2 / (gate**2 * (self._terrain.spread(row) + variance))

    def _smooth(self, compensated: Vector) -> None:
        scale = self._range_m
        # Flow about x shows motion to the right, flow about y motion backward.
        velocity = np.array([-compensated[1] * scale, compensated[0] * scale])
        if self._count == 0:
            self._smoothed_velocity, self._smoothed_rate = velocity, compensated
        else:
            self._smoothed_velocity += _SMOOTHED_SHARE * (velocity - self._smoothed_velocity)
            self._smoothed_rate += _SMOOTHED_SHARE * (compensated - self._smoothed_rate)
        self._count += 1

    # --- expected measurement

    @property
    def _rotation(self) -> Vector:
        return quat_to_matrix(self._state[es.Q : es.RATES])

    @property
    def _place(self) -> Vector:
        return np.array([self._value(f"EKF2_OF_POS_{axis}") for axis in "XYZ"])

    @property
    def _then(self) -> Vector:
        """Position and velocity (6,) NED at the time of the current measurement."""
        state, horizon = self._state, self.horizon
        return horizon.seen_from(state) if horizon.is_past else state[es.P : es.Q]

    @property
    def _height_m(self) -> float:
        """Height of the sensor above ground, at least `_LEAST_CLEARANCE_M` [m]."""
        # The sensor's mounting position rotates with the vehicle.
        offset = (self._rotation @ self._place).item(2)
        return max(abs(self._terrain.down - self._then.item(2) - offset), _LEAST_CLEARANCE_M)

    @property
    def _range_m(self) -> float:
        """Distance along the optical axis to the ground [m]."""
        return self._height_m / self._rotation.item(2, 2)

    def _predicted(self, gyro: Vector) -> Vector:
        """Return the expected flow (2,) without rotation [rad/s]."""
        rotation = self._rotation
        # A sensor away from the centre also moves by the rotation (w x r).
        body = rotation.T @ self._then[3:] + np.cross(-gyro, self._place)
        # 1 / range: height divided by the cosine of the tilt.
        scale = rotation.item(2, 2) / self._height_m
        return np.array([body[1] * scale, -body[0] * scale])

    def _jacobian(self) -> Vector:
        """Return the Jacobian of the flow by the 16 errors and the ground (2, 17)."""
        return flow_by_errors(self._rotation, self._then[3:], self._height_m)

    # --- jumps

    def _put_velocity(self, variance: float, now_us: int) -> None:
        """Reset the horizontal velocity to the flow velocity."""
        state = self._state
        # Rotate the smoothed body velocity to NED, without its vertical component.
        level = self._rotation[:2, :2] @ self._smoothed_velocity
        state[es.V : es.V + 2] = level
        # A flow error of s [rad/s] is a velocity error of s times range.
        spread = self._range_m**2 * variance
        terrain_filter.reset_variances(self._terrain, {es.VEL: spread, es.VEL + 1: spread})
        self._agree(now_us)

    def _put_ground(self, now_us: int) -> None:
        """Reset the terrain height from flow at the known velocity."""
        state = self._state
        forward, right = -self._smoothed_rate.item(1), self._smoothed_rate.item(0)
        # Speed over flow gives the distance to the ground.
        seen = math.hypot(*(self._rotation[:2, :2] @ np.array([forward, right])).tolist())
        least = self._value("EKF2_MIN_RNG")
        # Too little flow to divide by: assume the minimum range.
        away = math.hypot(*state[es.V : es.V + 2].tolist()) / seen if seen > 1e-6 else least
        self._terrain.put(state.item(es.P + 2) + max(away, least), _UNKNOWN_GROUND_M2)
        self._ground.ground_seen(now_us)
        self._agree(now_us)

    def _agree(self, now_us: int) -> None:
        """Record that the estimate has been reset to the measurement."""
        self.innovation, self.ratio = np.zeros(2), np.zeros(2)
        self.fused_us = now_us

    # --- on the ground

    def _stand(self, now_us: int, *, free: bool) -> None:
        """Hold position on the ground while flow arrives without other aids."""
        # In the air, or with another aid, a fixed position would be wrong.
        if free or not self.is_coming(now_us):
            self._stands_at = None
            return
        # The first call records the position; later calls hold it.
        if self._stands_at is None:
            self._stands_at = self._state[es.P : es.P + 2].copy()
        # PX4's ZeroVelocityUpdate and FakePosFusion run at 5 Hz.
        elif now_us - self._stood_us >= _STAND_EVERY_US:
            self._stood_us = now_us
            m = self.standing
            m.innovation[:2] = self._stands_at - self._state[es.P : es.P + 2]
            m.innovation[2:] = -self._state[es.V : es.V + 2]
            if self._fuse_standing(m):
                m.fused_us = now_us


def flow_by_errors(rotation: Vector, velocity: Vector, height_m: float) -> Vector:
    """Return the Jacobian (2, 17) of the flow by the 16 errors and the height of the ground.

    The flow about x is v_y R22 / h, about y -v_x R22 / h, with the velocity v in body axes, the
    lower right element R22 of the attitude and the sensor's height h above ground. `rotation` is
    body -> NED, `velocity` (3,) NED [m/s].
    """
    body = rotation.T @ velocity
    scale = rotation.item(2, 2) / height_m
    jacobian = np.zeros((2, es.N_STATES + 1))
    x, y, z = body.tolist()
    # A body rotation t changes v_body by v_body x t, and R22 by R20 t_y - R21 t_x.
    by_turn = np.array([[0.0, -z, y], [z, 0.0, -x]])
    tilt = np.array([-rotation.item(2, 1), rotation.item(2, 0), 0.0]) / height_m
    # Flow about x depends on v_y, flow about y on -v_x.
    for axis, (seen, sign) in enumerate(((1, 1.0), (0, -1.0))):
        row = jacobian[axis]
        row[es.VEL : es.ATT] = sign * scale * rotation[:, seen]
        row[es.ATT : es.GYRO] = sign * (scale * by_turn[seen] + body[seen] * tilt)
        # Flow falls with height: d(v / h) / dh = -v / h².
        by_height = -sign * scale * body[seen] / height_m
        # The height above ground is terrain z minus vehicle z.
        row[es.POS + 2], row[terrain_filter.GROUND] = -by_height, by_height
    return jacobian

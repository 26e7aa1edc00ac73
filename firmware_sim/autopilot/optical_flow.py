"""Optical flow: how the ground moves in the image of a camera that looks down, fused as by PX4.

Together with how far the ground is, it tells the velocity over it. Where something else tells the
velocity, it tells how far the ground is. EKF2_OF_CTRL switches it.
Source: PX4 (main of 2026, one sensor), EKF/aid_sources/optical_flow and ZeroVelocityUpdate,
FakePosFusion of the same folder. Not taken over: limits of height and speed that such a sensor sets
to what is flown in piloted modes, and SENS_FLOW_MINHGT, _MAXHGT, _MAXR, which are as by default.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.constants import MS_PER_S, TICK_S, US_PER_S
from airl_mav.core.frames import Vector, quat_to_matrix
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.fusion_horizon import FusionHorizon
from firmware_sim.autopilot.measurement import Measurement, selecting
from firmware_sim.autopilot.range_finder import RangeFinder
from firmware_sim.autopilot.terrain_filter import GROUND
from firmware_sim.interfaces import FlowReading

LEAST_HEIGHT_M, GREATEST_HEIGHT_M, GREATEST_RAD_S = 0.08, 100.0, 8.0
"""SENS_FLOW_MINHGT, SENS_FLOW_MAXHGT, SENS_FLOW_MAXR by default: within them flow is believed."""

LONGEST_S = 1.0
"""A measurement that took longer is none [s]."""

STUCK = 10
"""The same flow, other than none, so many times in a row is that of a sensor that hangs, which is
not fused: PX4 would. In the air nothing is measured twice; none may be, by a coarse sensor."""

_TO_BEGIN = 10
"""So many measurements come before the first is fused."""
_BEGIN_AGAIN_US = 2 * US_PER_S
"""After its last use it does not begin again before this [µs]."""
_UNUSED_US = US_PER_S
"""Refused for so long it is taken over, or given up (no_aid_timeout_max) [µs]."""
_SILENT_US = 7 * US_PER_S
"""Silent for so long it is given up (reset_timeout_max) [µs]."""
_COS_GREATEST_TILT = math.cos(math.radians(45.0))
"""range_cos_max_tilt"""
_LEAST_CLEARANCE_M = 0.01
_LEAST_NOISE_RAD_S = 0.05
_BIAS_SHARE, _GREATEST_BIAS_RAD_S = 0.01, 0.1
"""How the difference between the sensor's gyro and the vehicle's is learnt."""
_SMOOTHED_SHARE = 0.1
"""Share of a new sample in the smoothed flow: a low-pass of 0.09 s at steps of 0.01 s."""
_UNKNOWN_GROUND_M2 = 100.0
"""Variance of the ground where flow puts it."""
_BEST_QUALITY = 255.0

_STAND_EVERY_US = 200_000
_STANDING_M, _STANDING_M_S = 0.01, 0.001
"""How well it is known that a vehicle on the ground stays where it is."""


class OpticalFlow:
    """Takes the measurements of one sensor and has the filter fuse them."""

    def __init__(
        self,
        value: Callable[[str], float],
        state: Vector,
        ground: RangeFinder,
        fuse: Callable[[Measurement], bool],
    ) -> None:
        """Begin without any.

        Args:
            value: Looks up EKF2_* parameters by name.
            state: The nominal state, by `error_state`'s layout; updated.
            ground: Knows where the ground is, with its filter.
            fuse: Fuses a measurement that is none of the ground.
        """
        self._value, self._state = value, state
        self._ground, self._terrain = ground, ground.terrain
        self._fuse_standing = fuse
        self.horizon = FusionHorizon(0.0)
        """Where the vehicle was in the middle of the time that a measurement that comes now took:
        half of that ago, and EKF2_OF_DELAY."""
        self.fused = False
        """Whether it is being fused."""
        self.fused_us: int | None = None
        """When one was last within the gate; None = never."""
        self.innovation, self.ratio = np.zeros(2), np.zeros(2)
        """Of the newest measurement [rad/s]; test ratios, 1 = at the gate."""
        self.reading: FlowReading | None = None
        """The newest."""
        self.reading_us = 0
        """When it came [µs]."""
        self._waiting = False
        self._repeated = 0
        self._count = 0
        self._turned, self._turned_s = np.zeros(3), 0.0
        """How far the vehicle's gyro has turned since the newest measurement [rad], and how long
        that is."""
        self._rate = np.zeros(3)
        """How fast it turned before that [rad/s]."""
        self._gyro_bias = np.zeros(3)
        self._smoothed_velocity, self._smoothed_rate = np.zeros(2), np.zeros(2)
        """Body velocity [m/s] and flow [rad/s]."""
        held = selecting(es.POS, es.POS + 1, es.VEL, es.VEL + 1)
        self.standing = Measurement("standing", 0, held)
        """That a vehicle on the ground does not move."""
        self.standing.variance[:] = [_STANDING_M**2] * 2 + [_STANDING_M_S**2] * 2
        self._stands_at: Vector | None = None
        self._stood_us = 0

    def take(self, reading: FlowReading, now_us: int) -> None:
        """Take a measurement, fused in this tick; of what turn it does not tell, the vehicle's."""
        interval_s = reading.interval_s
        told = np.isfinite(reading.flow).all() and 0.0 <= interval_s < LONGEST_S
        if not told or (interval_s == 0.0 and reading.quality > 0):
            return
        before = self.reading
        repeats = before is not None and np.array_equal(reading.flow, before.flow)
        self._repeated = self._repeated + 1 if repeats and reading.flow.any() else 0
        self._rate = self._turned / self._turned_s if self._turned_s > 0.0 else np.zeros(3)
        self._turned, self._turned_s = np.zeros(3), 0.0
        turned, own = reading.turned, self._rate * interval_s
        if not np.isfinite(turned[:2]).all():
            turned = own
        elif not math.isfinite(turned.item(2)):
            turned = np.array([*turned[:2].tolist(), own.item(2)])
        self.reading = reading._replace(turned=turned)
        self.reading_us, self._waiting = now_us, self._repeated < STUCK

    def turn(self, gyro: Vector) -> None:
        """Note a tick's turn (3,) FRD [rad/s]."""
        self._turned += gyro * TICK_S
        self._turned_s += TICK_S

    def step(self, now_us: int, *, aided: bool, flying: bool) -> None:
        """Fuse a measurement that has come; once a tick.

        Args:
            now_us: Now.
            aided: Whether anything else measures horizontal motion.
            flying: Whether the vehicle is in the air.
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
        """Return whether it has told since then [µs] how the vehicle moves, or that it stands."""
        times = (self.fused_us, self.standing.fused_us)
        return any(time is not None and time >= since_us for time in times)

    def is_coming(self, now_us: int) -> bool:
        """Return whether measurements come that would tell the motion in the air."""
        lately = self.reading is not None and now_us - self.reading_us <= _UNUSED_US
        return lately and self._value("EKF2_OF_CTRL") == 1

    # --- fusion

    def _control(self, reading: FlowReading, now_us: int, *, aided: bool, flying: bool) -> None:
        value, ground = self._value, self._ground
        rate, gyro = self._rates(reading)
        self.horizon.assume(value("EKF2_OF_DELAY") + 0.5 * MS_PER_S * reading.interval_s)
        compensated = rate - gyro[:2]
        variance = self._variance(reading.quality)
        self._test(compensated, gyro, variance)
        least_quality = value("EKF2_OF_QMIN" if flying else "EKF2_OF_QMIN_GND")
        fast = max(math.hypot(*rate.tolist()), math.hypot(*compensated.tolist()))
        good = (
            reading.quality >= least_quality
            and fast <= GREATEST_RAD_S
            and self._rotation[2, 2] > _COS_GREATEST_TILT
        )
        if good:
            # PX4 smooths what it does not believe, too: the velocity may be put to that.
            self._smooth(compensated)
        height = self._terrain.down - self._state.item(es.P + 2)
        possible = LEAST_HEIGHT_M <= height <= GREATEST_HEIGHT_M
        tells_ground = not ground.is_reference
        if not possible:
            self._stop()
        elif self.fused:
            if good:
                self._fuse(compensated, gyro, variance, now_us, ground=tells_ground)
            if self.fused_us is not None and now_us - self.fused_us > _UNUSED_US:
                if good and flying and not aided:
                    self._put_velocity(variance, now_us)
                else:
                    self._stop()
        elif good and self._may_begin(now_us, aided=aided):
            self._begin(compensated, gyro, variance, now_us, aided=aided)

    def _may_begin(self, now_us: int, *, aided: bool) -> bool:
        """Return whether what it needs beside a good measurement is there."""
        lately = self.fused_us is not None and now_us - self.fused_us <= _BEGIN_AGAIN_US
        known = aided or self._ground.is_reference or self._ground.clearance().valid
        return self._count > _TO_BEGIN and known and not lately

    def _begin(
        self, compensated: Vector, gyro: Vector, variance: float, now_us: int, *, aided: bool
    ) -> None:
        ground = self._ground
        tells_ground = not ground.is_reference
        if not aided:
            self._put_velocity(variance, now_us)
        elif not self._fuse(compensated, gyro, variance, now_us, ground=tells_ground):
            if ground.tells_ground or not tells_ground:
                return
            self._put_ground(now_us)
        self.fused = True

    def _stop(self) -> None:
        if self.fused:
            self.fused, self._count = False, 0

    def _fuse(
        self, compensated: Vector, gyro: Vector, variance: float, now_us: int, *, ground: bool
    ) -> bool:
        """Fuse both axes, one after the other; return whether they were within the gate."""
        if (self.ratio > 1.0).any():
            return False
        # Both are linearised about the state before.
        jacobian = self._jacobian()
        for axis in range(2):
            row = jacobian[axis]
            if axis == 1:
                self.innovation[1] = compensated[1] - self._predicted(gyro)[1]
                self.ratio[1] = self._ratio(self.innovation.item(1), row, variance)
                if self.ratio[1] > 1.0:
                    continue
            self._terrain.fuse_with_ground(
                self._state, self.innovation.item(axis), row, variance, vehicle=True, ground=ground
            )
        self.fused_us = now_us
        if ground:
            self._ground.ground_seen(now_us)
        return True

    def _rates(self, reading: FlowReading) -> tuple[Vector, Vector]:
        """Return flow (2,) and gyro (3,) of a measurement [rad/s], by PX4's signs.

        These are opposite to those of the sensor: positive where the scene turns about the axis.
        """
        if reading.interval_s == 0.0:
            return np.zeros(2), np.zeros(3)
        gyro = -reading.turned / reading.interval_s
        reference = self._state[es.GYRO_BIAS : es.ACCEL_BIAS] - self._rate
        off = np.clip(gyro - reference, -_GREATEST_BIAS_RAD_S, _GREATEST_BIAS_RAD_S)
        self._gyro_bias += _BIAS_SHARE * (off - self._gyro_bias)
        return -reading.flow / reading.interval_s, gyro - self._gyro_bias

    def _variance(self, quality: int) -> float:
        """Return the variance of the flow [rad²/s²], by its quality."""
        value, least = self._value, self._value("EKF2_OF_QMIN")
        best = max(value("EKF2_OF_N_MIN"), _LEAST_NOISE_RAD_S)
        worst = max(value("EKF2_OF_N_MAX"), _LEAST_NOISE_RAD_S)
        span = _BEST_QUALITY - least
        share = min(1.0, max(0.0, (quality - least) / span)) if span >= 1.0 else 0.0
        return (best * share + worst * (1.0 - share)) ** 2

    def _test(self, compensated: Vector, gyro: Vector, variance: float) -> None:
        """Note how a measurement fits."""
        self.innovation = compensated - self._predicted(gyro)
        jacobian = self._jacobian()
        for axis in range(2):
            self.ratio[axis] = self._ratio(self.innovation.item(axis), jacobian[axis], variance)

    def _ratio(self, innovation: float, row: Vector, variance: float) -> float:
        gate = max(self._value("EKF2_OF_GATE"), 1.0)
        return innovation**2 / (gate**2 * (self._terrain.spread(row) + variance))

    def _smooth(self, compensated: Vector) -> None:
        scale = self._range_m
        velocity = np.array([-compensated[1] * scale, compensated[0] * scale])
        if self._count == 0:
            self._smoothed_velocity, self._smoothed_rate = velocity, compensated
        else:
            self._smoothed_velocity += _SMOOTHED_SHARE * (velocity - self._smoothed_velocity)
            self._smoothed_rate += _SMOOTHED_SHARE * (compensated - self._smoothed_rate)
        self._count += 1

    # --- what is expected

    @property
    def _rotation(self) -> Vector:
        return quat_to_matrix(self._state[es.Q : es.RATES])

    @property
    def _place(self) -> Vector:
        return np.array([self._value(f"EKF2_OF_POS_{axis}") for axis in "XYZ"])

    @property
    def _then(self) -> Vector:
        """Position and velocity (6,) NED when a measurement of now was made."""
        state, horizon = self._state, self.horizon
        return horizon.seen_from(state) if horizon.is_past else state[es.P : es.Q]

    @property
    def _height_m(self) -> float:
        """How far the ground is below the sensor, never nothing [m]."""
        offset = (self._rotation @ self._place).item(2)
        return max(abs(self._terrain.down - self._then.item(2) - offset), _LEAST_CLEARANCE_M)

    @property
    def _range_m(self) -> float:
        """How far what is in the middle of the image is [m]."""
        return self._height_m / self._rotation.item(2, 2)

    def _predicted(self, gyro: Vector) -> Vector:
        """Return the flow (2,) that is expected, without the turn [rad/s]."""
        rotation = self._rotation
        body = rotation.T @ self._then[3:] + np.cross(-gyro, self._place)
        scale = rotation.item(2, 2) / self._height_m
        return np.array([body[1] * scale, -body[0] * scale])

    def _jacobian(self) -> Vector:
        """Return how the flow changes by the 16 errors and the ground (2, 17)."""
        return flow_by_errors(self._rotation, self._then[3:], self._height_m)

    # --- jumps

    def _put_velocity(self, variance: float, now_us: int) -> None:
        """Put the horizontal velocity to what flow says."""
        state, p = self._state, self._terrain.covariance.copy()
        level = self._rotation[:2, :2] @ self._smoothed_velocity
        state[es.V : es.V + 2] = level
        for i in (es.VEL, es.VEL + 1):
            p[i, :] = p[:, i] = 0.0
            p[i, i] = self._range_m**2 * variance
        self._terrain.restart(p)
        self._agree(now_us)

    def _put_ground(self, now_us: int) -> None:
        """Put the ground where flow at the known velocity says."""
        state = self._state
        forward, right = -self._smoothed_rate.item(1), self._smoothed_rate.item(0)
        seen = math.hypot(*(self._rotation[:2, :2] @ np.array([forward, right])).tolist())
        least = self._value("EKF2_MIN_RNG")
        away = math.hypot(*state[es.V : es.V + 2].tolist()) / seen if seen > 1e-6 else least
        self._terrain.put(state.item(es.P + 2) + max(away, least), _UNKNOWN_GROUND_M2)
        self._ground.ground_seen(now_us)
        self._agree(now_us)

    def _agree(self, now_us: int) -> None:
        """Note that what is estimated has been made what was measured."""
        self.innovation, self.ratio = np.zeros(2), np.zeros(2)
        self.fused_us = now_us

    # --- on the ground

    def _stand(self, now_us: int, *, free: bool) -> None:
        """Hold a vehicle that stands where it is, as long as flow comes and nothing else does."""
        if free or not self.is_coming(now_us):
            self._stands_at = None
            return
        if self._stands_at is None:
            self._stands_at = self._state[es.P : es.P + 2].copy()
        elif now_us - self._stood_us >= _STAND_EVERY_US:
            self._stood_us = now_us
            m = self.standing
            m.innovation[:2] = self._stands_at - self._state[es.P : es.P + 2]
            m.innovation[2:] = -self._state[es.V : es.V + 2]
            if self._fuse_standing(m):
                m.fused_us = now_us


def flow_by_errors(rotation: Vector, velocity: Vector, height_m: float) -> Vector:
    """Return the Jacobian (2, 17) of the flow by the 16 errors and the height of the ground.

    The flow about x is v_y R22 / h, that about y is -v_x R22 / h, of the velocity in body axes, the
    attitude's lowest right element and the height above ground.

    Args:
        rotation: (3, 3) body -> NED.
        velocity: (3,) NED [m/s].
        height_m: Of the sensor above the ground [m].
    """
    body = rotation.T @ velocity
    scale = rotation.item(2, 2) / height_m
    jacobian = np.zeros((2, es.N_STATES + 1))
    x, y, z = body.tolist()
    # By a turn t of the body, v_body changes by v_body x t, and R22 by R20 t_y - R21 t_x.
    by_turn = np.array([[0.0, -z, y], [z, 0.0, -x]])
    tilt = np.array([-rotation.item(2, 1), rotation.item(2, 0), 0.0]) / height_m
    for axis, (seen, sign) in enumerate(((1, 1.0), (0, -1.0))):
        row = jacobian[axis]
        row[es.VEL : es.ATT] = sign * scale * rotation[:, seen]
        row[es.ATT : es.GYRO] = sign * (scale * by_turn[seen] + body[seen] * tilt)
        by_height = -sign * scale * body[seen] / height_m
        row[es.POS + 2], row[GROUND] = -by_height, by_height
    return jacobian

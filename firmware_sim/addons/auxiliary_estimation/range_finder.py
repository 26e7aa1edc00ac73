"""Downward range finder: terrain height and height above ground.

EKF2_RNG_CTRL enables range height: 0 never, 1 at low height and speed, 2 always; ranges always
update the terrain. With EKF2_HGT_REF = 2 the ground is the height reference. Source: PX4 1.16,
EKF/aid_sources/range_finder: range_height_control.cpp, terrain_control.cpp, SensorRangeFinder and
RangeFinderConsistencyCheck. Not implemented: flight limits for vehicles without another height
source (there is always a barometer), and the wider gate during known vertical acceleration errors.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import rotate
from firmware_sim.addons.auxiliary_estimation.terrain_filter import TerrainFilter, reset_variances
from firmware_sim.autopilot import autopilot_state, error_state
from firmware_sim.autopilot import error_state as es
from firmware_sim.interfaces import DOWNWARD, DistanceReading

HEIGHT_BY_RANGE = 2
"""EKF2_HGT_REF value for range height."""

STEP_US = 10_000
"""Period of PX4's sensor check, 100 Hz [µs]."""

TIMEOUT_US = 5 * US_PER_S
"""Time of rejection after which a reset follows (hgt_fusion_timeout_max) [µs]."""

_LEAST_VARIANCE = 1e-3
"""Minimum variance of a range in the consistency check [m²]."""
_STANDING = 0.1
"""Squared speed below which a vehicle does not move sideways [m²/s²]."""

_TO_BEGIN = 0.7
"""Share of the EKF2_RNG_A_* limits within which conditional fusion starts."""
_STEADY = 0.01
"""Test ratio below which conditional fusion starts."""

_UNUSED_US = US_PER_S
"""Time without ranges on the ground after which terrain is assumed EKF2_MIN_RNG below [µs]."""

_FILTERED_TAU_S, _GREATEST_RATIO = 0.5, 4.0


_CONDITIONAL, _ALWAYS = 1, 2
"""Values of EKF2_RNG_CTRL; 0 = off."""


class Aids(NamedTuple):
    """Other aids for the vehicle's motion."""

    horizontal: bool
    """True if a sensor measures horizontal motion."""
    vertical_speed: bool
    """True if a sensor measures vertical speed."""
    height_us: int
    """Time of the last height fusion from a sensor other than ranges [µs]."""


class RangeFinder:
    """Fusion of one range sensor for height and terrain."""

    def __init__(
        self, value: Callable[[str], float], state: Vector, terrain: TerrainFilter, now_us: int
    ) -> None:
        """Start without ranges; the nominal state and the terrain filter are updated."""
        self._value, self._state, self.terrain = value, state, terrain
        self.sensor, self.consistency = RangeSensor(), RangeConsistency()
        self.tells_height, self.tells_ground = False, False
        """Fusion of ranges into height and terrain."""
        self.is_reference = False
        """True if the ground, measured by ranges, is the height reference."""
        self.fused_us: int | None = None
        """Time of the newest range within the gate [µs]; None = never."""
        self.innovation, self.ratio = 0.0, 0.0
        """Innovation [m] and test ratio of the newest range; 1 = at the gate."""
        self._filtered_ratio = 0.0
        self._tested_us = 0
        self._ground_us: int | None = None
        """Time of the last terrain update from any source [µs]."""
        self._seen_us: int | None = None
        """Time of the last terrain update from another source than ranges [µs]; None = never."""
        self._valid = False
        self._resets = 0
        self._flying = False
        self._waiting: DistanceReading | None = None
        self._source: int | None = None
        """Id of the selected sensor; None = the first to send a range."""
        self._last_us = now_us
        """Time of the newest range of the selected sensor [µs]."""
        # -1 runs the first step in any case.
        self._step = -1
        self._begin_ground()

    def take(self, reading: DistanceReading, now_us: int, source: int) -> None:
        """Store a range of a downward sensor for fusion in the next step.

        The first of several such sensors is selected until it has been silent for 1 s (PX4:
        EKF2::UpdateRangeSample).
        """
        # Upward and sideways sensors say nothing about the ground.
        if reading.orientation != DOWNWARD or not math.isfinite(reading.distance_m):
            return
        # Another sensor takes over only after a timeout, so that two sensors do not alternate.
        if source != self._source:
            if self._source is not None and now_us - self._last_us <= US_PER_S:
                return
            self._source = source
        self._waiting, self._last_us = reading, now_us

    def step(self, now_us: int, aids: Callable[[], Aids], *, flying: bool) -> None:
        """Fuse a received range and check for timeouts; call once per tick.

        `aids` returns the other aids for the vehicle's motion.
        """
        step = now_us // STEP_US
        # Timeouts need at most PX4's 100 Hz.
        if self._waiting is None and step == self._step:
            return
        self._step = step
        self._check(now_us, flying=flying)
        if self.sensor.is_new:
            self._control(now_us, aids())
        # No range for two intervals: stop, before the estimate relies on old ones.
        elif self._fuses and now_us - self._last_us > 2 * LONGEST_INTERVAL_US:
            self._stop()
        self._follow_ground(now_us, flying=flying)
        self.sensor.is_new = False
        value, terrain = self._value, self.terrain
        free = not self.is_reference
        # While the ground is the height reference it is fixed by definition.
        terrain.walk_m_s = value("EKF2_TERR_NOISE") if free else 0.0
        terrain.slope = value("EKF2_TERR_GRAD")

    def clearance(self) -> autopilot_state.Clearance:
        """Return the height above ground."""
        # The filtered ratio is a square with a sign.
        ratio = math.sqrt(abs(self._filtered_ratio)) if self.tells_ground else math.nan
        return autopilot_state.Clearance(
            max(self._clearance_m, 0.0),
            self._valid,
            self.terrain.variance,
            self.tells_ground,
            self._resets,
            ratio,
        )

    def moved(self, down_m: float) -> None:
        """Shift the terrain by a change of the height origin, positive down [m]."""
        self.terrain.down += down_m
        self._resets += 1

    def ground_seen(self, now_us: int) -> None:
        """Record a terrain update from another source than ranges."""
        self._ground_us = self._seen_us = now_us

    def told_height_since(self, since_us: float) -> bool:
        """Return whether a range has updated the height since then [µs]."""
        return self.tells_height and self.fused_us is not None and self.fused_us >= since_us

    def correct(self, baro: error_state.Measurement, now_us: int) -> None:
        """Correct the offset of a long-rejected barometer if the ground is the reference.

        Source: PX4 1.16, EKF/aid_sources/barometer, which stops it and restarts with a new bias.
        """
        # A barometer that was never fused has been rejected since the start.
        refused_us = now_us - (baro.fused_us or 0)
        if not (self.is_reference and refused_us > TIMEOUT_US):
            return
        self._state[es.BARO_OFFSET] += baro.innovation.item(0)
        # Restart the offset, with its initial uncertainty and no correlations.
        reset_variances(self.terrain, {es.BARO: es.INITIAL_SIGMA.item(es.BARO) ** 2})
        baro.fused_us = now_us

    @property
    def _clearance_m(self) -> float:
        return self.terrain.down - self._state.item(es.P + 2)

    @property
    def _fuses(self) -> bool:
        return self.tells_height or self.tells_ground

    # --- the sensor

    def _check(self, now_us: int, *, flying: bool) -> None:
        sensor, value = self.sensor, self._value
        if self._waiting is not None:
            sensor.take(self._waiting, now_us)
            self._waiting = None
        sensor.quality_s, sensor.fog_m = value("EKF2_RNG_QLTY_T"), value("EKF2_RNG_FOG")
        q, pitch = es.attitude(self._state), value("EKF2_RNG_PITCH")
        # The ray in world axes: its down component is the cosine of the tilt.
        ray = rotate(q, (math.sin(pitch), 0.0, math.cos(pitch)))
        sensor.check(now_us, ray[2])
        if sensor.is_healthy:
            x, y, z = (value(f"EKF2_RNG_POS_{axis}") for axis in "XYZ")
            # Add the sensor's depth below the reference point, along the ray.
            sensor.range_m += rotate(q, (x, y, z))[2] / sensor.cos_tilt
            # On the ground the vertical speed is zero, so the check shows nothing.
            if flying:
                self._compare(now_us)
        elif not flying and sensor.is_regular and sensor.is_new:
            # Below the minimum range: use the known height on the ground.
            sensor.range_m, sensor.is_valid = value("EKF2_MIN_RNG"), True

    def _compare(self, now_us: int) -> None:
        """Check a range against the vertical speed."""
        value, sensor, p = self._value, self.sensor, self.terrain.covariance
        north, east, down = self._state[es.V : es.Q].tolist()
        # Horizontal speed counts as motion only beyond its own uncertainty.
        spread = float(p[es.VEL, es.VEL] + p[es.VEL + 1, es.VEL + 1])
        # EKF2_RNG_SFE: noise that grows with the range.
        scaled = value("EKF2_RNG_SFE") * sensor.dist_bottom_m
        self.consistency.update(
            sensor.dist_bottom_m,
            max(value("EKF2_RNG_NOISE") ** 2 + scaled**2, _LEAST_VARIANCE),
            down,
            float(p[es.VEL + 2, es.VEL + 2]),
            value("EKF2_RNG_K_GATE"),
            now_us,
            sideways=north * north + east * east > max(spread, _STANDING),
        )

    # --- fusion

    def _control(self, now_us: int, aids: Aids) -> None:
        value, sensor = self._value, self.sensor
        control = int(value("EKF2_RNG_CTRL"))
        # The assumed delay may change in flight.
        self.terrain.horizon.assume(value("EKF2_RNG_DELAY"))
        measured, variance = self._measure(now_us)
        goes_on = (
            control in (_CONDITIONAL, _ALWAYS)
            and sensor.is_healthy
            and self.consistency.is_consistent
        )
        conditional = self._fuses and control == _CONDITIONAL and self._is_suitable(aids)
        always = self._fuses and control == _ALWAYS
        # First the use of ranges for height, then for terrain, then the fusion.
        if self.tells_height:
            if not (conditional or always):
                self._stop_height()
        elif conditional or always:
            self._begin_height(measured, variance, now_us, always=always)
        if not self._fuses:
            if goes_on and sensor.is_regular:
                # A large difference at the start: reset the terrain instead of a slow fusion.
                if self.ratio > 1.0:
                    self._put_ground(variance, now_us)
                self.tells_ground = True
        elif goes_on:
            self._fuse(measured, variance, now_us, aids)
        else:
            self._stop()

    def _measure(self, now_us: int) -> tuple[float, float]:
        """Return the newest height above ground [m] and its variance; update the test ratio."""
        value, sensor, p = self._value, self.sensor, self.terrain.covariance
        # EKF2_MIN_RNG: range of a vehicle that stands on the ground.
        measured = max(sensor.dist_bottom_m, value("EKF2_MIN_RNG"))
        scaled = value("EKF2_RNG_SFE") * sensor.range_m
        # PX4 adds the variance of the vehicle's height to the sensor's.
        variance = float(p[es.POS + 2, es.POS + 2]) + value("EKF2_RNG_NOISE") ** 2 + scaled**2
        state, horizon = self._state, self.terrain.horizon
        then = horizon.seen_from(state).item(2) if horizon.is_past else state.item(es.P + 2)
        self.innovation = measured - (self.terrain.down - then)
        total = self.terrain.clearance_variance() + variance
        gate = max(value("EKF2_RNG_GATE"), 1.0)
        self.ratio = self.innovation**2 / (gate**2 * total)
        self._filter_ratio(now_us)
        return measured, variance

    def _filter_ratio(self, now_us: int) -> None:
        """Add the newest test ratio to the mean (updateAidSourceStatus)."""
        # PX4 bounds the time step of this filter.
        dt = min(1.0, max(0.001, (now_us - self._tested_us) / US_PER_S))
        signed = math.copysign(self.ratio, -self.innovation)
        if self._tested_us == 0:
            self._filtered_ratio = self.ratio
        else:
            share = dt / (dt + _FILTERED_TAU_S)
            mean = self._filtered_ratio + share * (signed - self._filtered_ratio)
            self._filtered_ratio = min(_GREATEST_RATIO, max(-_GREATEST_RATIO, mean))
        self._tested_us = now_us

    def _is_suitable(self, aids: Aids) -> bool:
        """Return whether height and speed are low enough for conditional range height."""
        value, (north, east) = self._value, self._state[es.V : es.V + 2].tolist()
        # Hysteresis: starting needs tighter limits than continuing.
        share, steady = (1.0, 1.0) if self.tells_height else (_TO_BEGIN, _STEADY)
        slow = math.hypot(north, east) <= share * value("EKF2_RNG_A_VMAX")
        low = self._clearance_m < share * value("EKF2_RNG_A_HMAX")
        # Without horizontal aiding the speed estimate has no meaning.
        return low and self.ratio < steady and (slow or not aids.horizontal)

    def _begin_height(self, measured: float, variance: float, now_us: int, *, always: bool) -> None:
        self.tells_height = True
        # Range height beside another reference: it corrects, but the reference stays.
        if int(self._value("EKF2_HGT_REF")) != HEIGHT_BY_RANGE:
            if self.ratio > 1.0:
                self._put_ground(variance, now_us)
            return
        self.is_reference = True
        if always:
            # From here on the ground is the height reference.
            self._put_height(measured, variance)
            self.terrain.down = 0.0
            self._agree(now_us)
        elif self.ratio > 1.0:
            self._put_ground(variance, now_us)
        # While the ground is the reference, ranges do not correct it.
        self.tells_ground = False

    def _fuse(self, measured: float, variance: float, now_us: int, aids: Aids) -> None:
        if self.ratio <= 1.0:
            self.terrain.fuse_range(
                self._state,
                self.innovation,
                variance,
                height=self.tells_height,
                ground=self.tells_ground,
            )
            self.fused_us = now_us
            if self.tells_ground:
                self._ground_us = now_us
        # No other height source: height follows the range after the timeout.
        alone = now_us - aids.height_us > TIMEOUT_US
        if alone and self.tells_height and self.is_reference:
            # PX4 moves the ground with the vehicle here, so that it drifts with every range.
            ground = self.terrain.down
            self._put_height(measured - ground, None)
            self.terrain.down = ground
            # Without a source of vertical speed, its drift would move the height away again.
            if not aids.vertical_speed:
                self._state[es.V + 2] = 0.0
            self._agree(now_us)
        elif self.fused_us is None or now_us - self.fused_us > TIMEOUT_US:
            self._put_ground(variance, now_us)

    def _agree(self, now_us: int) -> None:
        """Record that the estimate has been reset to the measurement."""
        self.innovation = self.ratio = self._filtered_ratio = 0.0
        self.fused_us = now_us

    def _put_ground(self, variance: float, now_us: int) -> None:
        """Reset the terrain height to the newest range."""
        # Resets count so that users of the terrain can detect jumps.
        self.terrain.put_by_range(self.innovation, variance)
        self._resets += 1
        self._agree(now_us)

    def _put_height(self, height_m: float, variance: float | None) -> None:
        """Reset the vehicle's height above z = 0; barometer offset and terrain shift with it.

        A variance [m²] of None leaves the covariance unchanged.
        """
        state = self._state
        moved = -height_m - state.item(es.P + 2)
        # The barometer offset shifts by the same amount: the innovation of the barometer stays.
        state[es.P + 2] += moved
        state[es.BARO_OFFSET] += moved
        if variance is not None:
            # The new height does not depend on the old one.
            reset_variances(self.terrain, {es.POS + 2: variance})
        self.moved(moved)

    def _stop_height(self) -> None:
        self.tells_height = self.is_reference = False

    def _stop(self) -> None:
        self._stop_height()
        self.tells_ground = False

    # --- the ground

    def _begin_ground(self) -> None:
        """Reset the terrain to the known height on the ground."""
        least = self._value("EKF2_MIN_RNG")
        self.terrain.put(self._state.item(es.P + 2) + least, least**2)

    def _follow_ground(self, now_us: int, *, flying: bool) -> None:
        """Maintain the terrain without measurements, and update its validity."""
        unused = self._ground_us is None or now_us - self._ground_us > _UNUSED_US
        if flying:
            # Lift-off: the height above ground is known one last time.
            if not self._flying:
                self._begin_ground()
        elif not self.tells_ground and unused and not self.is_reference:
            self._begin_ground()
        self._flying = flying
        clearance, spread = self._clearance_m, self.terrain.clearance_variance()
        possible = clearance >= 0.0 and self._ground_us is not None and spread > 0.0
        if self._valid:
            # Hysteresis: once valid, an uncertainty of 10 % of the height (at least 0.5 m) is
            # enough.
            self._valid = possible and spread < max(0.1 * clearance, 0.5) ** 2
        else:
            # Validity starts with a recent measurement by ranges or another source.
            times = (self.fused_us if self.tells_ground else None, self._seen_us)
            recent = any(time is not None and now_us - time <= TIMEOUT_US for time in times)
            self._valid = possible and recent


LONGEST_INTERVAL_US = 200_000
"""Maximum interval of ranges (RNG_MAX_INTERVAL) [µs]."""

GREATEST_TILT_COSINE = 0.7071
"""Cosine of the maximum tilt at which the ray measures the ground."""

_AGE_SHARE = 0.005
"""Weight of a new age in the mean: PX4 updates at 100 Hz, over 2 s."""
_GREATEST_AGE_US = 4_000_000.0
_DISCONTINUOUS_US = 2_000_000.0

_STUCK_AFTER_US = 10 * US_PER_S
_MOVES_M = 0.1
"""Time without a valid range [µs] after which the ranges must change by `_MOVES_M` [m]."""

_MEDIAN = 5
"""Number of distances in the median for fog detection."""
_FOG_FACTOR = 2.0


class RangeSensor:
    """Newest range, its validity and the resulting height of the sensor above ground."""

    def __init__(self) -> None:
        """Start without ranges."""
        self.range_m = 0.0
        """Newest range; corrected by the caller for the sensor's mounting position."""
        self.range_us = 0
        """Time of the measurement [µs]."""
        self.is_new = False
        """True if the range arrived in this step."""
        self.is_valid = False
        self.is_regular = False
        """True if ranges arrive at a sufficient rate."""
        self.least_m, self.greatest_m = 0.0, 0.0
        self.cos_tilt = 1.0
        """Cosine of the angle between the ray and straight down."""
        self.quality_s, self.fog_m = 0.0, 0.0
        """Values of EKF2_RNG_QLTY_T, EKF2_RNG_FOG."""
        self._quality = -1
        self._age_us = 0.0
        self._valid_us = self._bad_us = 0
        self._stuck, self._stuck_low, self._stuck_high = False, 0.0, 0.0
        self._blocked = False
        self._recent: deque[float] = deque([0.0] * _MEDIAN, maxlen=_MEDIAN)
        self._median = 0.0

    @property
    def dist_bottom_m(self) -> float:
        """Height of the sensor above ground by the newest range."""
        return self.range_m * self.cos_tilt

    @property
    def is_healthy(self) -> bool:
        """True if a new range can be fused."""
        return self.is_new and self.is_valid

    def take(self, reading: DistanceReading, now_us: int) -> None:
        """Store a range."""
        self.range_m, self.range_us, self._quality = reading.distance_m, now_us, reading.quality
        self.least_m, self.greatest_m = reading.least_m, reading.greatest_m
        self.is_new = True

    def check(self, now_us: int, cos_tilt: float) -> None:
        """Check the newest range; once per step, after `take` if there is a new range.

        `cos_tilt` is the cosine of the angle between the ray and straight down.
        """
        self.cos_tilt = cos_tilt
        age_us = now_us - self.range_us
        # Low-pass of the age: a sensor with many gaps is rejected even after a good sample.
        self._age_us += _AGE_SHARE * (age_us - self._age_us)
        self._age_us = min(self._age_us, _GREATEST_AGE_US)
        if age_us > 2 * LONGEST_INTERVAL_US or self._age_us >= _DISCONTINUOUS_US:
            self.is_valid = self.is_regular = False
            return
        self.is_regular = True
        if not self.is_new:
            return
        # Invalid until all checks pass.
        self.is_valid = False
        # -1 = unknown quality counts as good.
        if self._quality == 0:
            self._bad_us = now_us
        if not (
            now_us - self._bad_us > self.quality_s * US_PER_S
            and cos_tilt > GREATEST_TILT_COSINE
            and self.least_m <= self.range_m <= self.greatest_m
        ):
            return
        self._look_whether_stuck()
        self._look_for_fog()
        if not (self._stuck or self._blocked):
            self.is_valid, self._valid_us = True, self.range_us

    def _look_whether_stuck(self) -> None:
        if self.range_us - self._valid_us <= _STUCK_AFTER_US:
            return
        # Ranges move again.
        if self._stuck_high - self._stuck_low > _MOVES_M:
            self._stuck, self._stuck_low, self._stuck_high = False, 0.0, 0.0
            return
        self._stuck_high = max(self._stuck_high, self.range_m)
        # Below `_MOVES_M` the minimum is not set yet.
        if self._stuck_low < _MOVES_M or self.range_m < self._stuck_low:
            self._stuck_low = self.range_m
        self._stuck = True

    def _look_for_fog(self) -> None:
        """Reject a sudden decrease of the range: fog, rain or dirt on the sensor."""
        fog = self.fog_m
        if fog <= 0.0:
            return
        self._recent.append(self.dist_bottom_m)
        median = sorted(self._recent)[_MEDIAN // 2]
        # A sudden jump from far to near: fog, not ground.
        if not self._blocked and median < fog and self._median - median > _FOG_FACTOR * fog:
            self._blocked = True
        # Twice the limit to leave: hysteresis.
        elif self._blocked and median > _FOG_FACTOR * fog:
            self._blocked = False
        self._median = median


class RangeConsistency:
    """Consistency check of ranges against vertical speed."""

    _TAU_S = 2.0
    _FAST_M_S = 0.5
    """Minimum vertical speed to become consistent again."""
    _PROBATION_US = US_PER_S

    def __init__(self) -> None:
        """Start as consistent."""
        self.is_consistent = True
        self.ratio = 0.0
        """Newest test ratio: 1 = at the gate."""
        self.mean_ratio = 0.0
        """Mean test ratio with the sign of the innovation."""
        self._before_us = 0
        self._before_m = 0.0
        self._inconsistent_us = 0
        self._moved_us = 0

    def update(
        self,
        dist_bottom_m: float,
        variance: float,
        down_m_s: float,
        down_variance: float,
        gate: float,
        now_us: int,
        *,
        sideways: bool,
    ) -> None:
        """Check a range, with its variance [m²], against the estimated downward velocity in flight.

        `gate` is EKF2_RNG_K_GATE; `sideways` is True if the vehicle moves horizontally over
        possibly uneven ground.
        """
        if sideways:
            self._moved_us = now_us
        dt = (now_us - self._before_us) / US_PER_S
        known, before = self._before_us != 0, self._before_m
        self._before_us, self._before_m = now_us, dist_bottom_m
        # The first sample, and large gaps, give no rate.
        if not (known and 0.001 <= dt <= 0.5):
            return
        # A shrinking range must match the downward speed.
        innovation = -(dist_bottom_m - before) / dt - down_m_s
        # Variance of the difference of two ranges, divided by the time between them.
        spread = 2.0 * variance / dt**2 + down_variance
        self.ratio = innovation**2 / spread / gate**2
        share = dt / (dt + self._TAU_S)
        # The sign shows a steady difference; noise cancels in the mean.
        self.mean_ratio += share * (math.copysign(self.ratio, innovation) - self.mean_ratio)
        if abs(self.mean_ratio) >= 1.0:
            # PX4 compares microseconds with 2 here: only current motion counts.
            if now_us - self._moved_us > self._TAU_S:
                self.is_consistent, self._inconsistent_us = False, now_us
        # Consistency returns only with proof: fast motion that agrees after the probation.
        elif (
            abs(down_m_s) > self._FAST_M_S
            and self.ratio < 1.0
            and now_us - self._inconsistent_us > self._PROBATION_US
        ):
            self.is_consistent = True

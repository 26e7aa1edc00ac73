"""Validity checks for the ranges of a range finder.

Source: PX4 1.16, EKF/aid_sources/range_finder: SensorRangeFinder and RangeFinderConsistencyCheck.
"""

from __future__ import annotations

import math
from collections import deque

from airl_mav.core.constants import US_PER_S
from firmware_sim.interfaces import DistanceReading

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

        Args:
            now_us: Current time [µs].
            cos_tilt: Cosine of the angle between the ray and straight down.
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
        """Check a range in flight.

        Args:
            dist_bottom_m: Height above ground.
            variance: Variance of the height [m²].
            down_m_s: Estimated downward velocity.
            down_variance: Variance of the velocity [m²/s²].
            gate: EKF2_RNG_K_GATE.
            now_us: Current time [µs].
            sideways: True if the vehicle moves horizontally over possibly uneven ground.
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

"""Which ranges of a rangefinder can be believed.

Source: PX4 1.16, EKF/aid_sources/range_finder: SensorRangeFinder and RangeFinderConsistencyCheck.
"""

from __future__ import annotations

import math
from collections import deque

from airl_mav.core.constants import US_PER_S
from firmware_sim.interfaces import DistanceReading

LONGEST_INTERVAL_US = 200_000
"""Ranges have to come at least so often (RNG_MAX_INTERVAL) [µs]."""

GREATEST_TILT_COSINE = 0.7071
"""Tilted further than this cosine, the ray is not taken for one to the ground."""

_AGE_SHARE = 0.005
"""Share of a new age in the mean one: PX4 takes it a hundred times a second, over 2 s."""
_GREATEST_AGE_US = 4_000_000.0
_DISCONTINUOUS_US = 2_000_000.0

_STUCK_AFTER_US = 10 * US_PER_S
_MOVES_M = 0.1
"""After so long without a valid range the sensor has to show that its ranges change by so much."""

_MEDIAN = 5
"""Distances of which fog is told."""
_FOG_FACTOR = 2.0


class RangeSensor:
    """The newest range, whether it is valid, and how far below the sensor it says the ground is."""

    def __init__(self) -> None:
        """Begin without any."""
        self.range_m = 0.0
        """The newest range; corrected by whoever knows where the sensor is."""
        self.range_us = 0
        """When it was measured [µs]."""
        self.is_new = False
        """Whether it came in this step."""
        self.is_valid = False
        self.is_regular = False
        """Whether ranges come, and often enough."""
        self.least_m, self.greatest_m = 0.0, 0.0
        self.cos_tilt = 1.0
        """Cosine of the angle between the ray and straight down."""
        self.quality_s, self.fog_m = 0.0, 0.0
        """EKF2_RNG_QLTY_T, EKF2_RNG_FOG."""
        self._quality = -1
        self._age_us = 0.0
        self._valid_us = self._bad_us = 0
        self._stuck, self._stuck_low, self._stuck_high = False, 0.0, 0.0
        self._blocked = False
        self._recent: deque[float] = deque([0.0] * _MEDIAN, maxlen=_MEDIAN)
        self._median = 0.0

    @property
    def dist_bottom_m(self) -> float:
        """How far below the sensor the ground is, by the newest range."""
        return self.range_m * self.cos_tilt

    @property
    def is_healthy(self) -> bool:
        """Whether a new range can be fused."""
        return self.is_new and self.is_valid

    def take(self, reading: DistanceReading, now_us: int) -> None:
        """Take a range."""
        self.range_m, self.range_us, self._quality = reading.distance_m, now_us, reading.quality
        self.least_m, self.greatest_m = reading.least_m, reading.greatest_m
        self.is_new = True

    def check(self, now_us: int, cos_tilt: float) -> None:
        """Look at the newest range; once a step, after `take` where there is a new one.

        Args:
            now_us: Now.
            cos_tilt: Cosine of the angle between the ray and straight down.
        """
        self.cos_tilt = cos_tilt
        age_us = now_us - self.range_us
        self._age_us += _AGE_SHARE * (age_us - self._age_us)
        self._age_us = min(self._age_us, _GREATEST_AGE_US)
        if age_us > 2 * LONGEST_INTERVAL_US or self._age_us >= _DISCONTINUOUS_US:
            self.is_valid = self.is_regular = False
            return
        self.is_regular = True
        if not self.is_new:
            return
        self.is_valid = False
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
        if self._stuck_high - self._stuck_low > _MOVES_M:
            self._stuck, self._stuck_low, self._stuck_high = False, 0.0, 0.0
            return
        self._stuck_high = max(self._stuck_high, self.range_m)
        if self._stuck_low < _MOVES_M or self.range_m < self._stuck_low:
            self._stuck_low = self.range_m
        self._stuck = True

    def _look_for_fog(self) -> None:
        """Refuse a ground that comes near at once: fog, rain or dirt before the sensor."""
        fog = self.fog_m
        if fog <= 0.0:
            return
        self._recent.append(self.dist_bottom_m)
        median = sorted(self._recent)[_MEDIAN // 2]
        if not self._blocked and median < fog and self._median - median > _FOG_FACTOR * fog:
            self._blocked = True
        elif self._blocked and median > _FOG_FACTOR * fog:
            self._blocked = False
        self._median = median


class RangeConsistency:
    """Whether ranges change as the vehicle climbs and sinks."""

    _TAU_S = 2.0
    _FAST_M_S = 0.5
    """Consistent again only where the vehicle climbs or sinks faster than this."""
    _PROBATION_US = US_PER_S

    def __init__(self) -> None:
        """Begin: it is."""
        self.is_consistent = True
        self.ratio = 0.0
        """Newest test ratio: 1 = at the gate."""
        self.mean_ratio = 0.0
        """Its mean, with the sign of the innovation."""
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
        """Take a range in flight.

        Args:
            dist_bottom_m: How far the ground is below.
            variance: Of that [m²].
            down_m_s: The estimated velocity downward.
            down_variance: Of that [m²/s²].
            gate: EKF2_RNG_K_GATE.
            now_us: Now.
            sideways: Whether the vehicle moves over the ground, which need not be flat.
        """
        if sideways:
            self._moved_us = now_us
        dt = (now_us - self._before_us) / US_PER_S
        known, before = self._before_us != 0, self._before_m
        self._before_us, self._before_m = now_us, dist_bottom_m
        if not (known and 0.001 <= dt <= 0.5):
            return
        innovation = -(dist_bottom_m - before) / dt - down_m_s
        # Of a difference of two ranges, divided by the time between them.
        spread = 2.0 * variance / dt**2 + down_variance
        self.ratio = innovation**2 / spread / gate**2
        share = dt / (dt + self._TAU_S)
        self.mean_ratio += share * (math.copysign(self.ratio, innovation) - self.mean_ratio)
        if abs(self.mean_ratio) >= 1.0:
            # PX4 compares microseconds with 2 here: moving now alone counts.
            if now_us - self._moved_us > self._TAU_S:
                self.is_consistent, self._inconsistent_us = False, now_us
        elif (
            abs(down_m_s) > self._FAST_M_S
            and self.ratio < 1.0
            and now_us - self._inconsistent_us > self._PROBATION_US
        ):
            self.is_consistent = True

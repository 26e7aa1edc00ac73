"""Sensor validity: detects silent and frozen sensors.

Source: PX4 1.16, DataValidator and the preflight checks of each sensor. PX4 continues with a frozen
sensor. Here the estimator ignores the sensor, as a real sensor's noise never repeats.

In flight no sensor repeats its values, not even a noise-free one. At rest a noise-free one does.
The monitor learns from the first second at rest whether a sensor has noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.loops import Motors
from airl_mav.core import constants, frames
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import MavlinkEvent, SensorFailure, SensorType
from firmware_sim.engine import record as fields
from firmware_sim.engine.record import CHANGED, FIRST, GPS_ROW, SEEN, Record
from firmware_sim.interfaces import GpsFix, SensorSample

NO_DATA_US = constants.US_PER_S
"""Timeout after which a silent sensor has no valid data [µs]."""

LEARN_US = constants.US_PER_S
"""Time at rest without repetition after which a sensor counts as noisy [µs]."""


CALM_US = 300_000
"""Age of the newest sample below which no sensor type can fail [µs]."""


@dataclass(frozen=True, slots=True)
class SensorKind:
    """Sensor type with its failure criteria."""

    name: str
    """Name in PX4's texts."""
    title: str
    """Name in the pre-flight checks."""
    read: Callable[[SensorSample], Any]
    """Value that must differ from sample to sample; None if the sample lacks this sensor."""
    timeout_us: int
    """Silence after which the sensor has failed."""
    stale_us: int
    """Time of repeated values in flight after which the sensor has failed."""
    event: Callable[[int], MavlinkEvent] | None = None
    """Returns the event for a reason (`SensorFailure`); None = no event in PX4."""


def _mag(sample: SensorSample) -> Any:
    return None if sample.mag is None else tuple(sample.mag.tolist())


def _gps(sample: SensorSample) -> Any:
    fix = sample.gps
    return None if fix is None else (fix.position, *fix.velocity_ned.tolist())


_REASONS = {"TIMEOUT": SensorFailure.TIMEOUT, "STALE": SensorFailure.STALE_DATA}

GYRO = SensorKind(
    *("GYRO", "Gyro 0", lambda s: tuple(s.gyro.tolist()), 500_000, 400_000),
    lambda reason: events.IMU_FAILED.event(SensorType.GYRO, 0, reason),
)
ACCEL = SensorKind(
    *("ACCEL", "Accel 0", lambda s: tuple(s.accel.tolist()), 500_000, 400_000),
    lambda reason: events.IMU_FAILED.event(SensorType.ACCEL, 0, reason),
)
MAG = SensorKind(
    *("MAG", "Compass 0", _mag, 300_000, 2_000_000),
    lambda reason: events.MAG_FAILED.event(0, reason),
)
BARO = SensorKind(
    *("BARO", "Baro 0", lambda s: s.pressure_hpa, 300_000, 2_000_000),
    lambda reason: events.BARO_FAILED.event(0, reason),
)
GPS = SensorKind("GPS", "GPS 0", _gps, 1_000_000, 1_000_000)


class SensorWatch:
    """Monitor of one sensor, updated with each of its samples."""

    def __init__(self, kind: SensorKind, times: NDArray[np.int64]) -> None:
        """Start without samples; `times` (3,) is the sensor's row of `watch` (`engine.record`)."""
        self.kind = kind
        self.value: Any = None
        """Value of the newest sample."""
        self._times = times
        self.noisy: bool | None = None
        """True if samples differ even at rest; None = not known yet."""
        self.repeats = False
        """True if the newest sample equals the one before."""
        self.failed = ""
        """Failure reason: TIMEOUT or STALE; empty = healthy."""

    def take(self, sample: SensorSample) -> None:
        """Process a sample that contains this sensor."""
        value, now_us = self.kind.read(sample), sample.time_us
        self.repeats = value == self.value
        times = self._times
        times[SEEN] = now_us
        # A repetition at any time proves that the source may repeat.
        if self.repeats:
            self.noisy = self.noisy or False
            return
        self.value, times[CHANGED] = value, now_us
        if times[FIRST] < 0:
            times[FIRST] = now_us

    def repeat(self, now_us: int) -> None:
        """Record that the newest sample, from a compiled tick, is a repetition."""
        self.repeats, self._times[SEEN] = True, now_us
        self.noisy = self.noisy or False

    def judge(self, now_us: int, times_us: Sequence[int], *, flying: bool) -> OperatorText | None:
        """Return a text if the sensor fails now; `times_us` is its row of `watch`.

        At rest a noise-free sensor may repeat its values.
        """
        seen_us, changed_us, first_us = times_us
        if seen_us < 0:
            return None
        # A second without a repetition: the sensor has noise.
        if self.noisy is None and first_us >= 0 and seen_us - first_us >= LEARN_US:
            self.noisy = True
        # At rest without noise, repeated values count as new.
        if not (flying or self.noisy):
            self._times[CHANGED] = changed_us = seen_us
        before, self.failed = self.failed, ""
        if now_us - seen_us > self.kind.timeout_us:
            self.failed = "TIMEOUT"
        elif now_us - changed_us > self.kind.stale_us:
            self.failed = "STALE"
        # Report only the start of a failure.
        if not self.failed or before:
            return None
        text, event = f"{self.kind.name} #0 failed: {self.failed}!", self.kind.event
        told = None if event is None else event(_REASONS[self.failed])
        return OperatorText(Severity.EMERGENCY, text, told)


class Valid(NamedTuple):
    """Validity of each sensor's data for flight."""

    gyro: bool
    accel: bool
    mag: bool
    baro: bool
    gps: bool


class SensorMonitor:
    """Monitor of all sensors of the vehicle."""

    def __init__(self, watch: NDArray[np.int64]) -> None:
        """Start without samples, in `watch` (`engine.record`)."""
        self._times = times = watch
        self.gyro, self.accel, self.mag, self.baro, self.gps = self.all = tuple(
            SensorWatch(kind, row)
            for kind, row in zip((GYRO, ACCEL, MAG, BARO, GPS), times, strict=True)
        )
        self.distrusted = False
        """True if `trusted` removes data from the newest sample."""
        self._flying = False

    def looked_at(self, accel: NDArray[np.float64], gyro: NDArray[np.float64]) -> None:
        """Store the inertial measurements of the newest check."""
        self.accel.value, self.gyro.value = tuple(accel.tolist()), tuple(gyro.tolist())

    def take(self, sample: SensorSample) -> None:
        """Process the slow sensors in a tick's sample."""
        self.distrusted = False
        if sample.mag is not None:
            self._take(self.mag, sample)
        if sample.pressure_hpa is not None:
            self._take(self.baro, sample)
        if sample.gps is not None:
            self._take(self.gps, sample)

    def repeated(self, time_us: int, measured: int, repeated: int) -> None:
        """Process the slow sensors of a compiled tick at `time_us`.

        `engine.record` defines the bits of sensors with data, and with repeated data.
        """
        self.distrusted = False
        watched = {fields.MAG: self.mag, fields.PRESSURE: self.baro, fields.GPS: self.gps}
        for bit, watch in watched.items():
            if measured & bit:
                watch.repeats = bool(repeated & bit)
                if watch.repeats:
                    watch.repeat(time_us)
                if self._doubtful(watch):
                    self.distrusted = True

    def _take(self, watch: SensorWatch, sample: SensorSample) -> None:
        watch.take(sample)
        if self._doubtful(watch):
            self.distrusted = True

    def _doubtful(self, watch: SensorWatch) -> bool:
        """Return whether the newest sample must not be fused, from the first repetition."""
        # In flight even the first repetition is not fused.
        return watch.failed == "STALE" or (watch.repeats and self._flying)

    def judge(self, sample: SensorSample, *, flying: bool) -> list[OperatorText]:
        """Check all sensors, including inertial ones; return new failures."""
        now_us, self._flying = sample.time_us, flying
        self.gyro.take(sample)
        self.accel.take(sample)
        texts: list[OperatorText] = []
        for watch, times_us in zip(self.all, self._times.tolist(), strict=True):
            if watch.noisy and not watch.failed and now_us - times_us[CHANGED] < CALM_US:
                continue  # usual case: new data
            text = watch.judge(now_us, times_us, flying=flying)
            if text is not None:
                texts.append(text)
        return texts

    def are_calm(self, now_us: int) -> bool:
        """Return whether every sensor has recently delivered new data."""
        times = zip(self.all, self._times[:, CHANGED].tolist(), strict=True)
        return all(w.noisy and not w.failed and now_us - us < CALM_US for w, us in times)

    def valid(self, now_us: int) -> Valid:
        """Return the sensors with recent data; frozen sensors do not count."""
        data = []
        for watch, (seen_us, changed_us, _) in zip(self.all, self._times.tolist(), strict=True):
            # A frozen sensor still sends: its last change counts.
            newest_us = changed_us if watch.failed == "STALE" else seen_us
            data.append(seen_us >= 0 and now_us - newest_us < NO_DATA_US)
        return Valid._make(data)

    def trusted(self, sample: SensorSample) -> SensorSample:
        """Return a sample without data that must not be fused."""
        return sample._replace(
            mag=None if self._doubtful(self.mag) else sample.mag,
            pressure_hpa=None if self._doubtful(self.baro) else sample.pressure_hpa,
            gps=None if self._doubtful(self.gps) else sample.gps,
        )


class NewestSensors:
    """Newest sample and GPS fix, and the other sensors from a flight controller's record."""

    def __init__(self, record: Record) -> None:
        """Start without samples."""
        self._record = record
        self._sample: SensorSample | None = None
        self._read: Callable[[], SensorSample] | None = None
        """Returns the newest tick's sample; None = `_sample` is the newest."""
        self._fix: GpsFix | None = None
        self._fix_us = -1

    @property
    def gps(self) -> GpsFix | None:
        """Newest fix; None before the first."""
        seen_us = self._record["watch"].item(0, GPS_ROW, SEEN)
        if self._fix is not None and seen_us > self._fix_us:
            # Received in compiled ticks: accuracy and satellites keep their values.
            place, velocity = self._record["gps_position"][0], self._record["gps_velocity"][0]
            self._fix_us = seen_us
            self._fix = self._fix._replace(
                position=frames.local_to_geodetic(place, frames.HOME), velocity_ned=velocity.copy()
            )
        return self._fix

    @property
    def time_us(self) -> int:
        """Time of the newest sample [µs]; 0 before the first."""
        return self._record["time_us"].item(0)

    @property
    def esc_outputs(self) -> Motors | None:
        """Reported motor outputs, 0..1; None = not in the newest sample."""
        # Compiled ticks have no motor outputs.
        return None if self._read or self._sample is None else self._sample.esc_outputs

    @property
    def mag(self) -> frames.Vector:
        """Magnetic field (3,) FRD [gauss]."""
        field: frames.Vector = self._record["mag"][0].copy()
        return field

    @property
    def pressure_hpa(self) -> float:
        """Static pressure [hPa]; NaN before the first sample."""
        return self._record["pressure_hpa"].item(0)

    @property
    def sample(self) -> SensorSample | None:
        """Newest tick's sample; None before the first."""
        if self._read is not None:
            self.take(self._read())
        return self._sample

    def take(self, sample: SensorSample) -> None:
        """Store a tick's sample."""
        self._sample, self._read = sample, None
        if sample.gps is not None:
            self._fix, self._fix_us = sample.gps, sample.time_us

    def follow(self, read: Callable[[], SensorSample]) -> None:
        """Record that compiled ticks ran; `read` returns the newest sample on demand."""
        self._read = read
        # The first fix carries accuracy and satellites, which the record does not hold.
        if self._fix is None:
            self.take(read())

"""The newest sample of each sensor, also of those that are slower than the ticks."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.control.mixer import Motors
from airl_mav.core.frames import HOME, Vector, local_to_geodetic
from firmware_sim.engine.record import GPS_ROW, SEEN, Record
from firmware_sim.interfaces import GpsFix, SensorSample


class NewestSensors:
    """Newest sample, GPS fix, and what the record of a flight controller has of the others."""

    def __init__(self, record: Record) -> None:
        """Begin without a sample."""
        self._record = record
        self._sample: SensorSample | None = None
        self._read: Callable[[], SensorSample] | None = None
        """Returns the newest tick's sample; None = it is `_sample`."""
        self._fix: GpsFix | None = None
        self._fix_us = -1

    @property
    def gps(self) -> GpsFix | None:
        """The newest fix; None before the first."""
        seen_us = self._record["watch"].item(0, GPS_ROW, SEEN)
        if self._fix is not None and seen_us > self._fix_us:
            # Compiled ticks have taken it: accuracy and satellites stay what they are.
            place, velocity = self._record["gps_position"][0], self._record["gps_velocity"][0]
            self._fix_us = seen_us
            self._fix = self._fix._replace(
                position=local_to_geodetic(place, HOME), velocity_ned=velocity.copy()
            )
        return self._fix

    @property
    def time_us(self) -> int:
        """Of the newest sample [µs]; 0 before the first."""
        return self._record["time_us"].item(0)

    @property
    def esc_outputs(self) -> Motors | None:
        """Reported motor outputs, 0..1; None = the newest sample has none."""
        # A compiled tick measures none.
        return None if self._read or self._sample is None else self._sample.esc_outputs

    @property
    def mag(self) -> Vector:
        """(3,) FRD [gauss]."""
        field: Vector = self._record["mag"][0].copy()
        return field

    @property
    def pressure_hpa(self) -> float:
        """[hPa]; NaN before the first sample."""
        return self._record["pressure_hpa"].item(0)

    @property
    def sample(self) -> SensorSample | None:
        """The newest tick's; None before the first."""
        if self._read is not None:
            self.take(self._read())
        return self._sample

    def take(self, sample: SensorSample) -> None:
        """Take a tick's sample."""
        self._sample, self._read = sample, None
        if sample.gps is not None:
            self._fix, self._fix_us = sample.gps, sample.time_us

    def follow(self, read: Callable[[], SensorSample]) -> None:
        """Take note of compiled ticks; `read` returns the newest sample when it is needed."""
        self._read = read
        if self._fix is None:
            self.take(read())

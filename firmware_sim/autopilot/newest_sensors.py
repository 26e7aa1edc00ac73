"""Newest sample of each sensor, including sensors slower than the ticks."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.control.mixer import Motors
from airl_mav.core.frames import HOME, Vector, local_to_geodetic
from firmware_sim.engine.record import GPS_ROW, SEEN, Record
from firmware_sim.interfaces import GpsFix, SensorSample


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
                position=local_to_geodetic(place, HOME), velocity_ned=velocity.copy()
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
    def mag(self) -> Vector:
        """Magnetic field (3,) FRD [gauss]."""
        field: Vector = self._record["mag"][0].copy()
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
        if self._fix is None:
            self.take(read())

"""The newest sample of each sensor, also of those that are slower than the ticks."""

from __future__ import annotations

import math

import numpy as np

from firmware_sim.interfaces import GpsFix, SensorSample


class NewestSensors:
    """Keeps what came last."""

    def __init__(self) -> None:
        self.sample: SensorSample | None = None
        """The newest tick's; None before the first."""
        self.mag = np.zeros(3)
        """(3,) FRD [gauss]."""
        self.pressure_hpa = math.nan
        """[hPa]."""
        self.gps: GpsFix | None = None
        """None before the first fix."""

    def take(self, sample: SensorSample) -> None:
        """Take a tick's sample."""
        self.sample = sample
        if sample.mag is not None:
            self.mag = sample.mag
        if sample.pressure_hpa is not None:
            self.pressure_hpa = sample.pressure_hpa
        if sample.gps is not None:
            self.gps = sample.gps

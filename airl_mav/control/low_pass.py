"""The low-pass filters of PX4's control loops: AlphaFilter and LowPassFilter2p."""

from __future__ import annotations

import math
from typing import NamedTuple

from airl_mav.core.kernels import kernel


class Biquad(NamedTuple):
    """Coefficients of a second-order filter in direct form II."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


LEAST_CUTOFF = 0.001
"""A lower cut-off of a second-order filter is raised to this share of the sample rate, as in PX4's
LowPassFilter2p: below it, the filter's coefficients cancel to rounding noise."""


@kernel
def weight(cutoff_hz: float, dt: float) -> float:
    """Return the weight of a new sample in a first-order low-pass; cut-off 0 = no filter."""
    if cutoff_hz <= 0.0:
        return 1.0
    return dt / (dt + 1.0 / (2.0 * math.pi * cutoff_hz))


@kernel
def butterworth(cutoff_hz: float, dt: float) -> Biquad:
    """Return a second-order Butterworth low-pass; a cut-off of 0 or above Nyquist's = no filter."""
    if cutoff_hz <= 0.0 or cutoff_hz >= 0.5 / dt:
        return Biquad(1.0, 0.0, 0.0, 0.0, 0.0)
    ohm = math.tan(math.pi * max(cutoff_hz, LEAST_CUTOFF / dt) * dt)
    damping = 2.0 * math.cos(math.pi / 4.0) * ohm
    c = 1.0 + damping + ohm * ohm
    b = ohm * ohm / c
    return Biquad(b, 2.0 * b, b, 2.0 * (ohm * ohm - 1.0) / c, (1.0 - damping + ohm * ohm) / c)


@kernel
def settled(f: Biquad, sample: float) -> float:
    """Return what both delay elements hold in the steady state of a constant `sample`."""
    return sample / (1.0 + f.a1 + f.a2)


@kernel
def filtered(f: Biquad, sample: float, newer: float, older: float) -> tuple[float, float]:
    """Return the output and the next value of the newer delay element; the older takes `newer`."""
    now = sample - f.a1 * newer - f.a2 * older
    return f.b0 * now + f.b1 * newer + f.b2 * older, now

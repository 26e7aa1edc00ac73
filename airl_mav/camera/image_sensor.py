"""Lens and image sensor: vignetting, Bayer mosaic, photon noise, sRGB codes; linear, 1 is white."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.appearance import linear_of
from airl_mav.camera.intrinsics import Intrinsics

Light = NDArray[np.float32]
"""Image (h, w) or (h, w, channels), linear."""

_NUMBERS = np.arange(256, dtype=np.float64)

LIGHT_OF: Final[Light] = linear_of(_NUMBERS / 255.0).astype(np.float32)
"""(256,) light of each sRGB code."""

_EDGES: Final[Light] = linear_of((_NUMBERS[:-1] + 0.5) / 255.0).astype(np.float32)
"""(255,) lower bound of light for each code from 1 on, by rounding to the nearest."""


def codes_of(light: Light) -> NDArray[np.uint8]:
    """Return the nearest sRGB codes of light of any shape; 255 beyond white."""
    return np.searchsorted(_EDGES, light, side="right").astype(np.uint8)


def vignette(camera: Intrinsics, share: float) -> Light:
    """Return a lens's transmission (h, w).

    1 - share (r / R)² at a distance r from the optical axis, with R at the most distant pixel: the
    first term of the even polynomials used to calibrate lenses (Goldman, Chen, "Vignette and
    exposure calibration and compensation", ICCV 2005).
    """
    across = np.arange(camera.width) - camera.cx
    down = np.arange(camera.height) - camera.cy
    square = across**2 + down[:, None] ** 2
    through: Light = (1.0 - share * square / square.max()).astype(np.float32)
    return through


def noisy(
    light: Light, gain: float, full_well_e: float, read_noise_e: float, rng: np.random.Generator
) -> Light:
    """Return light (...) as measured by a photon-counting sensor.

    A pixel with the value x holds N = x full_well_e / max(gain, 1) electrons. A gain above 1
    multiplies the count, a gain below 1 is a darker exposure. The count has the variance N
    (Poisson, in its normal approximation), and reading adds read_noise_e² (EMVA 1288, release 4.0,
    section 2). The light is after the gain. Above 1 the sensor saturates.
    """
    full = np.minimum(light, np.float32(1.0))
    per_light = full_well_e / max(gain, 1.0)
    sd_e = np.sqrt(full * np.float32(per_light) + np.float32(read_noise_e**2))
    draws = rng.standard_normal(light.shape, np.float32)
    measured: Light = full + sd_e * draws * np.float32(1.0 / per_light)
    return measured


def mosaic(light: Light) -> Light:
    """Return the pixel values (h, w) behind a Bayer filter RGGB, from RGB light (h, w, 3)."""
    raw = light[..., 1].copy()
    raw[::2, ::2] = light[::2, ::2, 0]
    raw[1::2, 1::2] = light[1::2, 1::2, 2]
    return raw


def demosaiced(raw: Light) -> Light:
    """Return RGB light (h, w, 3) of a mosaic (h, w) by bilinear interpolation."""
    height, width = raw.shape
    red, blue = np.zeros_like(raw), np.zeros_like(raw)
    red[::2, ::2] = blue[1::2, 1::2] = 1.0
    found = np.empty((height, width, 3), np.float32)
    for channel, here in enumerate((red, 1.0 - red - blue, blue)):
        cross = channel == 1
        total, weight = _around(raw * here, cross=cross), _around(here, cross=cross)
        between = total / np.maximum(weight, np.float32(1e-6))
        found[..., channel] = np.where(here > 0.0, raw, between)
    return found


def _around(plane: Light, *, cross: bool) -> Light:
    """Return sums over neighbours: beside, above and below; or all eight, corners by half."""
    p = np.pad(plane, 1)
    beside = p[1:-1, :-2] + p[1:-1, 2:] + p[:-2, 1:-1] + p[2:, 1:-1]
    if cross:
        return beside
    corners = p[:-2, :-2] + p[:-2, 2:] + p[2:, :-2] + p[2:, 2:]
    return beside + np.float32(0.5) * corners

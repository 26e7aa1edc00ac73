"""Image formation of a colour camera: motion blur, exposure control, sensor noise, JPEG.

A finite exposure is the mean of shorter ones along the motion of vehicle and obstacles. Its middle
is the timestamp; velocity and angular rates are constant. A rolling shutter exposes the rows from
the top; the timestamp is the middle of the middle row's exposure.

The gain scales the scene's light before rendering, which preserves the shades of dark scenes. Each
shorter exposure clips light beyond white. Then follow lens, sensor and JPEG. A
grey pixel's light follows from its sRGB code.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour import appearance, picture, profile
from airl_mav.arena.geometry import Arena
from airl_mav.camera import intrinsics, render
from airl_mav.camera.frame import image_of, jpeg_of
from airl_mav.core import constants, streams
from airl_mav.profiles.camera import Camera

MOST_METERED: Final = 5
"""Maximum images to settle a gain: an all-white or all-black image contains little information."""

SETTLED: Final = 0.01
"""Relative change below which a gain is settled."""

LEAST_LIGHT: Final = 1e-5
"""Minimum mean light of an image: a thirtieth of code 1 in every pixel."""


class FormedImage(NamedTuple):
    """Image as in `Frame`."""

    image: NDArray[Any]
    jpeg: bytes | None


class ImageFormation:
    """Image formation of one camera with a table `imaging`, with optional auto-exposure."""

    def __init__(self, camera: Camera, name: str = "") -> None:
        """Prepare a camera of kind rgb or grey; `name` seeds an additional camera's noise."""
        self._own = streams.words_of(name)
        self._imaging = camera.imaging or profile.Imaging()
        self._camera = intrinsics.Intrinsics.of(camera)
        self._mount = render.Mount.of(camera)
        self._period_s = camera.period_us / constants.US_PER_S
        share = self._imaging.vignetting
        self._through = vignette(self._camera, share)[..., None] if share else None
        self.restart()

    @property
    def follows(self) -> bool:
        """True if an image depends on the previous one: auto-exposure with lag."""
        auto = self._imaging.auto_exposure
        return auto is not None and auto.time_constant_s > 0.0

    def restart(self) -> None:
        """Start an episode: the first image sets the gain without lag."""
        self.gain: float | None = None
        """Gain of the newest image; None before the first image."""
        self._frame = 0

    def take(
        self, arena: Arena, elapsed_us: int, motion: render.Motion, seed: int, frame: int
    ) -> FormedImage:
        """Return an image; `elapsed_us` is the time of its mid-exposure and middle row.

        `motion` is the vehicle's then, `seed` the episode's, `frame` the number by the camera's
        rate, skipped frames included. Raises UsageError if a mesh's file is missing or has changed.
        """
        asked = self._imaging
        off = _off_by(asked, seed, self._own)
        if asked.auto_exposure is None:
            self.gain = off * asked.gain
        else:
            self.gain = self._metered(arena, elapsed_us, motion, asked.auto_exposure, off, frame)
        self._frame = frame
        light = self._exposed(arena, elapsed_us, motion, self.gain)
        return self._formed(light, self.gain, seed, frame)

    def _exposed(self, arena: Arena, elapsed_us: int, motion: render.Motion, gain: float) -> Light:
        """Return the light (h, w, channels) of all rows, each at its time in the readout."""
        readout_us = constants.US_PER_MS * self._imaging.readout_ms
        if not readout_us:
            return self._exposed_at(arena, elapsed_us, motion, 0.0, gain)
        height = self._camera.height
        bands = min(self._imaging.readout_bands, height)
        channels = 3 if self._camera.kind == "rgb" else 1
        light = np.empty((height, self._camera.width, channels), np.float32)
        for k in range(bands):
            first, end = k * height // bands, (k + 1) * height // bands
            # Mean time of the band's rows; row r is read at (r + 1/2) / h of the readout.
            middle_us = readout_us * (0.5 * (first + end) / height - 0.5)
            seen = self._exposed_at(arena, elapsed_us, motion, middle_us, gain)
            light[first:end] = seen[first:end]
        return light

    def _exposed_at(
        self, arena: Arena, elapsed_us: int, motion: render.Motion, middle_us: float, gain: float
    ) -> Light:
        """Return the light (h, w, channels) of an exposure centred at timestamp + `middle_us`."""
        asked = self._imaging
        count = asked.samples if asked.exposure_ms else 1
        moments_us = (
            round(middle_us + constants.US_PER_MS * asked.exposure_ms * ((k + 0.5) / count - 0.5))
            for k in range(count)
        )
        lights = (
            LIGHT_OF[self._codes(arena, elapsed_us + since_us, motion, since_us, gain)]
            for since_us in moments_us
        )
        total: Light = reduce(np.add, lights)
        return total if count == 1 else total * np.float32(1.0 / count)

    def _codes(
        self, arena: Arena, elapsed_us: int, motion: render.Motion, since_us: int, gain: float
    ) -> NDArray[np.uint8]:
        """Return the sRGB codes (h, w, channels) at one time, `since_us` after the timestamp."""
        position, quaternion = render.carried_on(motion, since_us / constants.US_PER_S)
        at, attitude = render.camera_pose(np.array(position), np.array(quaternion), self._mount)
        centers = arena.centers_at(elapsed_us)
        return picture.expose_colour(arena, centers, self._camera, at, attitude, gain)

    def _metered(
        self,
        arena: Arena,
        elapsed_us: int,
        motion: render.Motion,
        auto: profile.AutoExposure,
        off: float,
        frame: int,
    ) -> float:
        """Return the gain for the target's mean light, times `off`; extremes saturate."""
        settles = self.gain is None or auto.time_constant_s == 0.0
        gain = 1.0 if settles or self.gain is None else self.gain
        # Clipped pixels hide part of the light, so a settled gain needs several images.
        for _ in range(MOST_METERED if settles else 1):
            mean = _mean_light(self._codes(arena, elapsed_us, motion, 0, gain))
            due = min(
                max(gain * off * auto.target / max(mean, LEAST_LIGHT), auto.least_gain),
                auto.most_gain,
            )
            if not settles:
                # First-order lag of log(gain) over the time since the previous image.
                passed_s = (frame - self._frame) * self._period_s
                share = -math.expm1(-passed_s / auto.time_constant_s)
                return float(gain * (due / gain) ** share)
            done = abs(due / gain - 1.0) < SETTLED
            gain = due
            if done:
                break
        return float(gain)

    def _formed(self, light: Light, gain: float, seed: int, frame: int) -> FormedImage:
        """Return the image of light (h, w, channels) after lens and sensor."""
        asked, channels = self._imaging, light.shape[2]
        # The order of a camera: lens, Bayer filter, photons and readout, demosaicing, sRGB, JPEG.
        if self._through is not None:
            light = light * self._through
        if asked.bayer:
            light = mosaic(light)
        if asked.full_well_e is not None:
            rng = streams.stream(seed, streams.Stream.PHOTONS, frame, *self._own)
            light = noisy(light, gain, asked.full_well_e, asked.read_noise_e, rng)
        if asked.bayer:
            # The sensor saturates before the interpolation.
            light = demosaiced(np.minimum(light, np.float32(1.0)))
        image: NDArray[Any] = codes_of(light)
        if asked.jpeg_quality is None:
            return FormedImage(image, None)
        jpeg = jpeg_of(image, asked.jpeg_quality)
        # The decoded JPEG is the image, so that the image has the compression errors.
        return FormedImage(image_of(jpeg, image.shape[0], image.shape[1], channels), jpeg)


def _off_by(asked: profile.Imaging, seed: int, own: tuple[int, ...]) -> float:
    """Return the random gain factor of an episode; `own` as in `streams.words_of`."""
    if not asked.gain_spread_ev:
        return 1.0
    # Uniform in exposure values, that is in powers of two.
    share = 2.0 * streams.stream(seed, streams.Stream.EXPOSURE, *own).random() - 1.0
    return float(2.0 ** (asked.gain_spread_ev * share))


def _mean_light(codes: NDArray[np.uint8]) -> float:
    """Return the mean luminance of sRGB or grey codes (h, w, channels); 1 is white."""
    weights = appearance.LUMINANCE if codes.shape[2] == 3 else np.ones(1)
    mean = 0.0
    for channel, weight in enumerate(weights.tolist()):
        # A histogram replaces one table look-up per pixel.
        counts = np.bincount(codes[..., channel].ravel(), minlength=256)
        mean += weight * float(counts @ LIGHT_OF.astype(np.float64)) / counts.sum()
    return mean


Light = NDArray[np.float32]
"""Image (h, w) or (h, w, channels), linear."""

_NUMBERS = np.arange(256, dtype=np.float64)

LIGHT_OF: Final[Light] = appearance.linear_of(_NUMBERS / 255.0).astype(np.float32)
"""(256,) light of each sRGB code."""

_EDGES: Final[Light] = appearance.linear_of((_NUMBERS[:-1] + 0.5) / 255.0).astype(np.float32)
"""(255,) lower bound of light for each code from 1 on, by rounding to the nearest."""


def codes_of(light: Light) -> NDArray[np.uint8]:
    """Return the nearest sRGB codes of light of any shape; 255 beyond white."""
    return np.searchsorted(_EDGES, light, side="right").astype(np.uint8)


def vignette(camera: intrinsics.Intrinsics, share: float) -> Light:
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
    # Positions of red and blue in RGGB.
    red[::2, ::2] = blue[1::2, 1::2] = 1.0
    found = np.empty((height, width, 3), np.float32)
    for channel, here in enumerate((red, 1.0 - red - blue, blue)):
        # Green neighbours lie beside, above and below; red and blue ones at the corners too.
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

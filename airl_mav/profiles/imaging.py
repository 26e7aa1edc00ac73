"""Image formation of a colour camera: exposure, lens, sensor and compression."""

from __future__ import annotations

from typing import Any

from pydantic import SerializerFunctionWrapHandler, model_serializer, model_validator

from airl_mav.core.fields import ProfileModel, optional, quantity, switch


class AutoExposure(ProfileModel):
    """A gain that follows the brightness of the image; see `camera.imaging`."""

    target: float = quantity(
        "mean light of the image that it aims at; 1 is white", "1", ge=0.01, le=0.9, default=0.18
    )
    time_constant_s: float = quantity(
        "time in which it covers 63 % of the way to the gain that is due; 0: it is there at once,"
        " which is all that the batch twin has",
        "s",
        ge=0,
        le=10,
        default=0.3,
    )
    least_gain: float = quantity("least gain", "1", ge=0.001, le=1, default=0.05)
    most_gain: float = quantity("greatest gain", "1", ge=1, le=1000, default=16.0)


class Imaging(ProfileModel):
    """Image formation from light to pixel values; every effect is off by default."""

    exposure_ms: float = quantity(
        "exposure time, in which motion blurs the image; the frame's stamp is its middle. No longer"
        " than the time between two frames",
        "ms",
        ge=0,
        le=1000,
        default=0.0,
    )
    samples: int = quantity("images of which an exposure is the mean", "1", ge=1, le=64, default=8)
    readout_ms: float = quantity(
        "readout time of a rolling shutter: of h rows, row r is exposed r / h of it later than the"
        " first. The frame's stamp is the middle of it. 0: a global shutter. No longer than the"
        " time between two frames",
        "ms",
        ge=0,
        le=1000,
        default=0.0,
    )
    readout_bands: int = quantity(
        "bands of rows that are exposed together, at most one for each row: a row's moment is right"
        " to readout_ms / (2 readout_bands), and an image takes so many times as long; only matters"
        " with readout_ms",
        "1",
        ge=1,
        le=480,
        default=16,
    )
    gain: float = quantity(
        "times this the light; 1: a white surface under the irradiance 1 is white",
        "1",
        ge=0.001,
        le=1000,
        default=1.0,
    )
    gain_spread_ev: float = quantity(
        "the gain, or what auto exposure aims at, is off by a power of two from minus to plus this,"
        " drawn with every episode",
        "1",
        ge=0,
        le=8,
        default=0.0,
    )
    auto_exposure: AutoExposure | None = optional(
        "how the gain follows the light; left out: it is `gain`"
    )
    vignetting: float = quantity(
        "share of the light that the farthest corner lacks; it grows with the square of the"
        " distance from the optical axis",
        "1",
        ge=0,
        le=1,
        default=0.0,
    )
    full_well_e: float | None = quantity(
        "electrons that a white pixel holds at a gain of 1 or less, which set the noise of photons;"
        " left out: no noise",
        "1",
        ge=10,
        le=1_000_000,
        default=None,
    )
    read_noise_e: float = quantity(
        "noise of reading a pixel, sd in electrons; only with full_well_e",
        "1",
        ge=0,
        le=10_000,
        default=0.0,
    )
    bayer: bool = switch(
        "whether each pixel measures one colour (mosaic RGGB) and the others are"
        " interpolated bilinearly; only of kind rgb"
    )
    jpeg_quality: int | None = quantity(
        "images are compressed as JPEG of this quality, by libjpeg's scale; left out: they are not",
        "1",
        ge=1,
        le=100,
        default=None,
    )

    @model_serializer(mode="wrap")
    def _without_the_default(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Profiles with a global shutter keep their digests.
        data: dict[str, Any] = dump(self)
        if not self.readout_ms:
            data.pop("readout_ms", None)
            data.pop("readout_bands", None)
        return data

    @model_validator(mode="after")
    def _goes_together(self) -> Imaging:
        if self.read_noise_e and self.full_well_e is None:
            raise ValueError(
                f"read_noise_e = {self.read_noise_e:g}: accepted: 0 without full_well_e"
            )
        if self.gain != 1.0 and self.auto_exposure is not None:
            raise ValueError(f"gain = {self.gain:g}: accepted: 1 with a table auto_exposure")
        return self

"""Profile tables of colour cameras: the appearance of an arena, and image formation.

An appearance is materials, textures, sun, sky and fog. Every pair of numbers is [minimum, maximum],
drawn uniformly for each seed. Colours are sRGB, 0-255.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import Each, ProfileModel, later_field, optional, quantity, switch
from airl_mav.profiles.loading import CheckedFile

if TYPE_CHECKING:
    from airl_mav.profiles.camera import Camera

TextureName = Literal["plain", "checker", "noise", "brick", "foliage"]
SurfaceName = Literal["matt", "glossy", "metal", "glass"]
Colour = Annotated[tuple[int, int, int], Each(0, 255)]
Materials = Annotated[tuple[str, ...], Field(min_length=1)]

WALL_COLOUR = "wall_colour"
"""The plain material whose albedo is the arena's `wall_colour`."""


MOST_IMAGES = 16
"""Maximum images of an arena."""


class ImageFile(CheckedFile):
    """An image that repeats on a surface."""

    file: str = Field(
        min_length=1,
        description="a PNG or JPEG, as wide as it is high; a path from the profile's folder",
    )


class Material(ProfileModel):
    """A material: two albedos, a texture that mixes them or an image, and a reflection model."""

    albedo: Colour = quantity(
        "reflectance, as an sRGB colour, where the pattern is 0: mortar, shade between leaves; with"
        " an image: where that is white",
        "1",
    )
    albedo_2: Colour | None = quantity(
        "reflectance where the pattern is 1: bricks, leaves; left out: as albedo",
        "1",
        default=None,
    )
    texture: TextureName = Field(
        default="plain",
        description="pattern: plain, checker, value noise in three octaves, bricks in mortar, or"
        " leaves over each other",
    )
    size_m: float = quantity(
        "side of a check, length of a brick, width of a leaf, wavelength of the coarsest noise,"
        " width of an image",
        "m",
        ge=0.02,
        le=50,
        default=0.5,
    )
    image: ImageFile | None = later_field(None, "a picture of your own in place of a pattern")
    surface: SurfaceName = later_field(
        "matt",
        "matt (Lambert's law); glossy: matt under clear varnish; metal, whose albedo is the"
        " reflectance of its facets: a mirror where it is smooth; glass: thin panes around nothing,"
        " whose albedo is what each lets through beside what it reflects",
    )
    roughness: Annotated[float, Field(ge=0, le=1)] = later_field(
        0.0,
        "of a glossy surface and of metal: root of the width of the slopes of its facets (GGX); 0:"
        " as smooth as a mirror",
    )

    @model_validator(mode="after")
    def _image_or_pattern(self) -> Material:
        if self.image is not None and self.texture != "plain":
            raise ValueError(f"texture = {self.texture!r}: accepted: none with an image")
        if self.image is not None and self.albedo_2 is not None:
            raise ValueError(f"albedo_2 = {list(self.albedo_2)}: accepted: none with an image")
        if self.roughness and self.surface not in ("glossy", "metal"):
            raise ValueError(
                f"roughness = {self.roughness:g}: accepted: 0 with surface = {self.surface!r}"
            )
        return self


MATERIALS: dict[str, Material] = {
    "plaster": Material(albedo=(222, 214, 196)),
    "concrete": Material(
        albedo=(122, 120, 115), albedo_2=(184, 181, 174), texture="noise", size_m=0.8
    ),
    "gravel": Material(albedo=(96, 90, 80), albedo_2=(176, 168, 152), texture="noise", size_m=0.6),
    "grass": Material(albedo=(66, 92, 42), albedo_2=(128, 148, 76), texture="noise", size_m=0.7),
    "brick": Material(albedo=(206, 196, 182), albedo_2=(170, 84, 62), texture="brick", size_m=0.5),
    "foliage": Material(
        albedo=(30, 56, 24), albedo_2=(124, 158, 70), texture="foliage", size_m=0.25
    ),
    "checker": Material(
        albedo=(38, 38, 40), albedo_2=(232, 232, 228), texture="checker", size_m=0.5
    ),
    "orange": Material(albedo=(240, 130, 30)),
    "bark": Material(albedo=(52, 40, 30), albedo_2=(116, 94, 72), texture="noise", size_m=0.2),
    "wood": Material(albedo=(120, 84, 48), albedo_2=(168, 126, 80), texture="noise", size_m=0.3),
    "steel": Material(albedo=(112, 116, 120)),
    "mirror": Material(albedo=(242, 242, 240), surface="metal"),
    "brushed-steel": Material(albedo=(196, 196, 198), surface="metal", roughness=0.45),
    "lacquer": Material(albedo=(168, 28, 26), surface="glossy", roughness=0.15),
    "wet-asphalt": Material(
        albedo=(38, 38, 40),
        albedo_2=(74, 74, 76),
        texture="noise",
        size_m=0.5,
        surface="glossy",
        roughness=0.3,
    ),
    "glass": Material(albedo=(250, 253, 250), surface="glass"),
}
"""Materials available in every arena."""


def _materials(*default: str) -> Any:
    """Declare the materials of a kind of surface."""
    known = ", ".join((*MATERIALS, WALL_COLOUR))
    return Field(
        default=default,
        description="names, of which one is drawn with equal odds for each surface of this kind:"
        f" {known}, or one of appearance.materials",
    )


def _brightness(least: float, greatest: float) -> Any:
    """Declare the brightness range of a kind of surface."""
    return quantity(
        "factor of the albedo, drawn for each surface; albedos end at 1",
        "1",
        default=(least, greatest),
    )


def _tint(default: float) -> Any:
    """Declare the colour variation of a kind of surface."""
    return quantity(
        "each colour channel's albedo is changed by a factor between 1 - tint and 1 + tint, drawn"
        " for each surface",
        "1",
        ge=0,
        le=1,
        default=default,
    )


Brightness = Annotated[tuple[float, float], Each(0, 4, ascending=True)]


class Surfaces(ProfileModel):
    """Materials of one kind of surface: the four walls together."""

    materials: Materials = _materials(WALL_COLOUR)
    brightness: Brightness = _brightness(1.0, 1.0)
    tint: float = _tint(0.0)


class Floor(Surfaces):
    """Materials of the floor."""

    materials: Materials = _materials("gravel")


class Standing(Surfaces):
    """Materials of each static obstacle."""

    materials: Materials = _materials("brick", "concrete", "foliage", "plaster")
    brightness: Brightness = _brightness(0.8, 1.2)
    tint: float = _tint(0.1)


class Moving(Surfaces):
    """Materials of each moving obstacle."""

    materials: Materials = _materials("orange")


class Sun(ProfileModel):
    """The sun, infinitely far away, with hard shadows."""

    azimuth_deg: Annotated[tuple[float, float], Each(-360, 360, ascending=True)] = quantity(
        "direction it stands in, clockwise from north", "deg", default=(0.0, 360.0)
    )
    elevation_deg: Annotated[tuple[float, float], Each(1, 90, ascending=True)] = quantity(
        "height above the horizon", "deg", default=(30.0, 60.0)
    )
    irradiance: Annotated[tuple[float, float], Each(0, 10, ascending=True)] = quantity(
        "luminous irradiance of a surface that faces it; a white surface under 1 reads full scale;"
        " 0 at night",
        "1",
        default=(0.7, 0.7),
    )
    colour: Colour = quantity("colour of its light", "1", default=(255, 246, 230))


class Sky(ProfileModel):
    """The clear sky: radiance varies from horizon to zenith with the sine of elevation.

    It lights surfaces without shadows, by the share of the sky visible at their tilt.
    """

    irradiance: Annotated[tuple[float, float], Each(0, 10, ascending=True)] = quantity(
        "luminous irradiance of a level surface, in the sun's unit; about 0.01 at night",
        "1",
        default=(0.4, 0.4),
    )
    zenith: Colour = quantity("colour overhead", "1", default=(120, 170, 236))
    horizon: Colour = quantity("colour at the horizon, and of fog", "1", default=(214, 226, 238))


class Fog(ProfileModel):
    """Fog of uniform density in the colour of the horizon."""

    extinction_1_m: Annotated[tuple[float, float], Each(0, 2, ascending=True)] = quantity(
        "extinction coefficient of Beer-Lambert's law; 3 over it is the meteorological optical"
        " range [m]; 0: no fog",
        "1/m",
        default=(0.0, 0.0),
    )
    share: float = quantity(
        "share of the drawn appearances that have fog at all; the air of the others is clear",
        "1",
        ge=0,
        le=1,
        default=1.0,
    )

    @property
    def drawn(self) -> bool:
        """True if any seed may have fog."""
        return self.share > 0.0 and self.extinction_1_m[1] > 0.0


class Appearance(ProfileModel):
    """Appearance for colour cameras, from separate random streams: geometry is independent of it.

    Depth images are also independent of it, except for glass, which depth passes through.
    """

    period: int = quantity(
        "consecutive seeds that share one drawn appearance", "1", ge=1, le=10_000, default=1
    )
    materials: dict[str, Material] = Field(
        default_factory=dict, description="materials of your own, by name"
    )
    floor: Floor = Field(default_factory=Floor, description="the floor")
    walls: Surfaces = Field(default_factory=Surfaces, description="the four walls together")
    static: Standing = Field(default_factory=Standing, description="each static obstacle")
    moving: Moving = Field(default_factory=Moving, description="each obstacle that moves")
    sun: Sun = Field(default_factory=Sun, description="direct light")
    sky: Sky = Field(
        default_factory=Sky, description="background above the walls, and diffuse light"
    )
    fog: Fog = Field(default_factory=Fog, description="fog, which hides distant surfaces")

    @model_validator(mode="after")
    def _materials_are_known(self) -> Appearance:
        known = self.known_materials
        if len(self.images) > MOST_IMAGES:
            raise ValueError(
                f"materials: {len(self.images)} with an image; accepted: {MOST_IMAGES} at most"
            )
        if WALL_COLOUR in self.materials:
            raise ValueError(f"materials.{WALL_COLOUR}: this name stands for the arena's own field")
        for kind in ("floor", "walls", "static", "moving"):
            for name in getattr(self, kind).materials:
                if name not in known:
                    raise ValueError(f"{kind}.materials = {name!r}: accepted: {', '.join(known)}")
        return self

    @property
    def known_materials(self) -> tuple[str, ...]:
        """Names of all materials: shipped, the walls', and custom ones."""
        return (*MATERIALS, WALL_COLOUR, *self.materials)

    @property
    def images(self) -> tuple[ImageFile, ...]:
        """Images of the custom materials, without duplicates, ordered by material name."""
        named = sorted(self.materials.items())
        return tuple(dict.fromkeys(m.image for _, m in named if m.image is not None))

    def may_have(self, surface: SurfaceName, more: Iterable[str] = ()) -> bool:
        """Return whether an obstacle, or a part of `more` materials, may have a kind of surface."""
        kinds = (*self.static.materials, *self.moving.materials, *more)
        return any(self.material(name, (0, 0, 0)).surface == surface for name in kinds)

    def material(self, name: str, wall_colour: tuple[int, int, int]) -> Material:
        """Return a material by name; a custom material overrides a shipped one."""
        if name == WALL_COLOUR:
            return Material(albedo=wall_colour)
        return self.materials[name] if name in self.materials else MATERIALS[name]


class AutoExposure(ProfileModel):
    """Gain that follows the image's brightness; see `airl_mav.addons.colour.image_sensor`."""

    target: float = quantity(
        "mean light of the image that it aims at; 1 is white", "1", ge=0.01, le=0.9, default=0.18
    )
    time_constant_s: float = quantity(
        "time in which it covers 63 % of the way to the gain that is due; 0: it is there at once,"
        " which is all that the vectorized simulator has",
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

    def check(self, camera: Camera) -> None:
        """Raise FieldError for settings that the camera's kind or rate does not support."""
        if self.bayer and camera.kind != "rgb":
            accepted = f"false with a camera of kind {camera.kind!r}"
            raise FieldError("camera.imaging.bayer", True, accepted)
        period_ms = camera.period_us / US_PER_MS
        for name in ("exposure_ms", "readout_ms"):
            if (value := getattr(self, name)) > period_ms:
                accepted = f"value <= {period_ms:.4g} ms, the time between two frames"
                raise FieldError(f"camera.imaging.{name}", value, accepted)

"""Colour image formation against closed forms: blur, metering, noise, mosaic, JPEG."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pydantic import ValidationError
from scipy import stats

from airl_mav.addons.colour.image_sensor import (
    LIGHT_OF,
    ImageFormation,
    codes_of,
    demosaiced,
    mosaic,
    noisy,
    vignette,
)
from airl_mav.addons.colour.profile import Imaging
from airl_mav.arena.geometry import Arena, Shape, Tour
from airl_mav.camera.frame import Frame, FrameError, image_of, jpeg_of
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Motion, expose
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.projections import CameraKind
from tests.unit.test_colour import arena, bodies, sky, sun

LENS: dict[str, Any] = {
    "width_px": 65,
    "height_px": 49,
    "horizontal_fov_deg": 90.0,
    "range_m": 20.0,
    "rate_hz": 20.0,
    "forward_m": 0.0,
    "up_m": 0.0,
    "pitch_up_deg": 0.0,
}
FOCAL = 32.5
DARK, BRIGHT = 0.1, 0.9
HERE = np.array([0.0, 0.0, -2.0])
NORTH = quat_from_euler(0.0, 0.0, 0.0)
AT_REST = Motion.at_rest(HERE, NORTH)


def camera(kind: CameraKind = "rgb", **imaging: Any) -> Camera:
    return Camera.model_validate({**LENS, "kind": kind, "imaging": imaging})


def moving(velocity: tuple[float, ...] = (0, 0, 0), rates: tuple[float, ...] = (0, 0, 0)) -> Motion:
    return Motion(HERE, NORTH, np.array(velocity, float), np.array(rates, float))


def surfaces(brightness: float) -> dict[str, Any]:
    return {"materials": ["w"], "brightness": [brightness, brightness], "tint": 0.0}


def edge(*, irradiance: float = 1.0, speed: float = 0.0) -> Arena:
    """A bright sheet 5 m ahead that begins in the middle of the image, before dark walls.

    It moves east at a speed, and is there at time 5 s.
    """
    sheet = bodies((Shape.BOX, (5.0, 10.0, -2.5), (0.001, 10.0, 2.5), 0.0))
    look: dict[str, Any] = {
        "walls": surfaces(DARK),
        "static": surfaces(BRIGHT),
        "moving": surfaces(BRIGHT),
    }
    scene = arena(sheet, sun=sun(0.0, 45.0, 0.0), sky=sky(irradiance), **look)
    if speed:
        reach = 5.0 * speed
        way = Tour(
            np.array([0.0, 10.0, 20.0]),
            np.array([[5.0, 10.0 - reach], [5.0, 10.0 + reach], [5.0, 10.0 - reach]]),
        )
        scene = replace(scene, tours=(way,))
    return scene


def line_of(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Light along the middle row."""
    return LIGHT_OF[image[24, :, 0]]


# --- all effects off


@pytest.mark.parametrize("kind", ["rgb", "grey"])
def test_a_table_that_asks_for_nothing_changes_no_bit(kind: CameraKind) -> None:
    scene = edge()
    lens = Intrinsics.of(camera(kind))
    plain = expose(scene, scene.centers_at(0), lens, 20.0, HERE, NORTH)
    image, jpeg = ImageFormation(camera(kind)).take(scene, 0, moving((9.0, 3.0, 1.0)), 1, 2)
    assert jpeg is None
    assert image.tobytes() == plain.tobytes()


def test_numbers_are_those_of_their_light() -> None:
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(codes_of(LIGHT_OF[codes]), codes)
    assert codes_of(np.array([-1.0, 5.0], np.float32)).tolist() == [0, 255]


def test_the_default_is_not_written() -> None:
    assert "imaging" not in Camera.model_validate({**LENS, "kind": "rgb"}).model_dump()


# --- motion


def ramp(along_px: float) -> NDArray[np.float64]:
    """Light of the middle row where the edge passes so far during the exposure."""
    share = np.clip((np.arange(65) - 32.0) / abs(along_px) + 0.5, 0.0, 1.0)
    return np.asarray(share)


@pytest.mark.parametrize("samples", [1, 4, 16, 64])
@pytest.mark.parametrize("speed", [-30.0, 10.0, 30.0])
def test_a_vehicle_that_moves_sideways_draws_the_edge_out(samples: int, speed: float) -> None:
    """A thing at the depth z passes f v T / z pixels: the share of the time it covers each."""
    asked: dict[str, Any] = {"exposure_ms": 40.0, "samples": samples}
    image, _ = ImageFormation(camera(**asked)).take(edge(), 0, moving((0.0, speed, 0.0)), 0, 0)
    light = line_of(image)
    share = (light - light[0]) / (light[-1] - light[0])
    wanted = ramp(FOCAL * speed * 0.04 / 5.0)
    # Half a short exposure more or less. Pixel values are rounded to 1/100 of this light.
    assert np.abs(share - wanted).max() <= 0.5 / samples + 0.01


@pytest.mark.parametrize("rate", [-2.0, 1.0, 2.0])
def test_a_vehicle_that_turns_draws_it_out_by_its_angle(rate: float) -> None:
    asked: dict[str, Any] = {"exposure_ms": 50.0, "samples": 64}
    image, _ = ImageFormation(camera(**asked)).take(edge(), 0, moving(rates=(0, 0, rate)), 0, 0)
    light = line_of(image)
    bearing = np.arctan((np.arange(65) - 32.0) / FOCAL)
    wanted = np.clip(bearing / (abs(rate) * 0.05) + 0.5, 0.0, 1.0)
    share = (light - light[0]) / (light[-1] - light[0])
    assert np.abs(share - wanted).max() <= 0.5 / 64 + 0.01


@pytest.mark.parametrize("speed", [-8.0, 8.0])
def test_what_moves_is_drawn_out_before_a_camera_at_rest(speed: float) -> None:
    asked: dict[str, Any] = {"exposure_ms": 50.0, "samples": 64}
    scene = edge(speed=abs(speed))
    elapsed_us = 5_000_000 if speed > 0 else 15_000_000
    image, _ = ImageFormation(camera(**asked)).take(scene, elapsed_us, AT_REST, 0, 0)
    light = line_of(image)
    share = (light - light[0]) / (light[-1] - light[0])
    wanted = ramp(FOCAL * speed * 0.05 / 5.0)
    assert np.abs(share - wanted).max() <= 0.5 / 64 + 0.01


# --- rolling shutter

ROWS = np.arange(9, 35)
"""Image rows that show the sheet."""

LATER_S = 0.05 * ((ROWS + 0.5) / 49.0 - 0.5)
"""Exposure time of each row after the stamp [s], in a readout of 50 ms."""


def begins(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Column in which the sheet begins in each row, before sky, wall or ground."""
    numbers = image[ROWS, :, 0]
    sheet = numbers == numbers[:, -1:]
    assert (np.diff(sheet.astype(int), axis=1) >= 0).all()
    return np.asarray(np.argmax(sheet, axis=1))


def rolled(scene: Arena, motion: Motion, *, at_us: int = 0, **asked: Any) -> NDArray[np.uint8]:
    rolling = {"readout_ms": 50.0, "readout_bands": 480, **asked}
    return ImageFormation(camera(**rolling)).take(scene, at_us, motion, 0, 0).image


@pytest.mark.parametrize("bands", [1, 4, 480])
@pytest.mark.parametrize("speed", [-30.0, 30.0])
def test_an_edge_leans_where_the_vehicle_moves_sideways(speed: float, bands: int) -> None:
    """The edge moves f v / z pixels a second; rows are off by at most half a band's time."""
    found = begins(rolled(edge(), moving((0.0, speed, 0.0)), readout_bands=bands))
    passes = -FOCAL * speed / 5.0
    off = abs(passes) * 0.05 / (2.0 * bands) if bands < 49 else 0.0
    # The first column beyond the edge is less than one away.
    assert np.abs(found - 0.5 - (32.0 + passes * LATER_S)).max() <= 0.5 + off + 1e-3
    if bands == 480:
        assert np.polyfit(LATER_S, found, 1)[0] == pytest.approx(passes, rel=0.1)


@pytest.mark.parametrize("rate", [-6.0, 6.0])
def test_an_edge_leans_where_the_vehicle_turns(rate: float) -> None:
    found = begins(rolled(edge(), moving(rates=(0, 0, rate))))
    wanted = 32.0 - FOCAL * np.tan(rate * LATER_S)
    assert np.abs(found - 0.5 - wanted).max() <= 0.5 + 1e-3
    assert np.ptp(found) >= 4


@pytest.mark.parametrize("speed", [-8.0, 8.0])
def test_what_moves_leans_before_a_camera_at_rest(speed: float) -> None:
    at_us = 5_000_000 if speed > 0 else 15_000_000
    found = begins(rolled(edge(speed=abs(speed)), AT_REST, at_us=at_us))
    wanted = 32.0 + FOCAL * speed / 5.0 * LATER_S
    assert np.abs(found - 0.5 - wanted).max() <= 0.5 + 1e-2
    assert np.ptp(found) >= 1


def test_each_row_of_a_rolling_shutter_is_blurred_about_its_own_moment() -> None:
    image = rolled(edge(), moving((0.0, 30.0, 0.0)), exposure_ms=40.0, samples=16)
    passes = -FOCAL * 30.0 / 5.0
    dark = (ROWS >= 20) & (ROWS <= 27)  # Behind the sheet is the wall.
    for row, later_s in zip(ROWS[dark], LATER_S[dark], strict=True):
        light = LIGHT_OF[image[row, :, 0]]
        share = (light - light[0]) / (light[-1] - light[0])
        along = np.arange(65) - (32.0 + passes * later_s)
        wanted = np.clip(along / abs(passes * 0.04) + 0.5, 0.0, 1.0)
        assert np.abs(share - wanted).max() <= 0.5 / 16 + 0.01


def test_a_rolling_shutter_at_rest_changes_no_bit_and_a_global_one_is_not_written() -> None:
    plain = ImageFormation(camera()).take(edge(), 0, AT_REST, 0, 0).image
    np.testing.assert_array_equal(rolled(edge(), AT_REST, readout_bands=5), plain)
    assert "readout_ms" not in Imaging().model_dump()
    assert Imaging(readout_ms=3.0).model_dump()["readout_bands"] == 16


# --- gain


@pytest.mark.parametrize("gain", [0.25, 2.0])
def test_a_gain_is_as_much_light(gain: float) -> None:
    """A gain equals sun and sky that are brighter by the same factor."""
    image, _ = ImageFormation(camera(gain=gain)).take(edge(irradiance=0.4), 0, AT_REST, 0, 0)
    brighter, _ = ImageFormation(camera()).take(edge(irradiance=0.4 * gain), 0, AT_REST, 0, 0)
    assert np.abs(image.astype(int) - brighter.astype(int)).max() <= 1


@pytest.mark.parametrize("irradiance", [0.01, 0.1, 1.0, 10.0])
def test_settled_auto_exposure_has_the_mean_that_it_aims_at(irradiance: float) -> None:
    auto = {"target": 0.2, "least_gain": 0.001, "most_gain": 1000.0, "time_constant_s": 0.0}
    image, _ = ImageFormation(camera("grey", auto_exposure=auto)).take(
        edge(irradiance=irradiance), 0, AT_REST, 0, 0
    )
    assert LIGHT_OF[image].mean() == pytest.approx(0.2, rel=0.03)


def test_the_gain_stays_within_its_limits() -> None:
    auto = {"target": 0.2, "least_gain": 0.5, "most_gain": 4.0, "time_constant_s": 0.0}
    for irradiance, gain in ((0.01, 4.0), (10.0, 0.5)):
        forming = ImageFormation(camera(auto_exposure=auto))
        forming.take(edge(irradiance=irradiance), 0, AT_REST, 0, 0)
        assert forming.gain == gain


def test_the_gain_follows_with_its_time_constant() -> None:
    """Out of a dark room: the logarithm of the gain decays as a first order lag's step."""
    auto = {"target": 0.1, "time_constant_s": 0.4}
    forming = ImageFormation(camera("grey", auto_exposure=auto))
    forming.take(edge(irradiance=0.3), 0, AT_REST, 0, 0)
    before = forming.gain
    assert before is not None
    gains = []
    for frame in range(1, 25):
        forming.take(edge(irradiance=0.6), 0, AT_REST, 0, frame)
        assert forming.gain is not None
        gains.append(forming.gain)
    passed_s = np.arange(1, 25) / 20.0
    wanted = before * 0.5 ** (1.0 - np.exp(-passed_s / 0.4))
    np.testing.assert_allclose(gains, wanted, rtol=0.02)
    # The time of skipped frames counts, too. A new episode begins settled.
    forming.restart()
    forming.take(edge(irradiance=0.3), 0, AT_REST, 0, 0)
    forming.take(edge(irradiance=0.6), 0, AT_REST, 0, 24)
    assert forming.gain == pytest.approx(gains[-1], rel=0.02)


def test_an_episode_s_exposure_is_off_by_a_power_of_two_of_its_own() -> None:
    forming = ImageFormation(camera(gain_spread_ev=1.0))
    gains = []
    for seed in range(200):
        forming.take(edge(), 0, AT_REST, seed, 0)
        assert forming.gain is not None
        gains.append(forming.gain)
    assert stats.kstest(np.log2(gains), stats.uniform(-1.0, 2.0).cdf).pvalue > 0.01
    forming.take(edge(), 0, AT_REST, 7, 9)
    assert forming.gain == gains[7]


# --- lens and sensor


def test_corners_lack_the_share_of_light_that_is_asked_for() -> None:
    lens = Intrinsics.of(camera())
    through = vignette(lens, 0.6)
    assert through[24, 32] == 1.0
    for corner in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        assert through[corner] == pytest.approx(0.4)
    # Half way to a corner a quarter of it is lacking.
    assert through[12, 16] == pytest.approx(1.0 - 0.6 / 4.0)
    image, _ = ImageFormation(camera(vignetting=0.6)).take(edge(), 0, AT_REST, 0, 0)
    plain, _ = ImageFormation(camera()).take(edge(), 0, AT_REST, 0, 0)
    wanted = codes_of(LIGHT_OF[plain] * through[..., None])
    np.testing.assert_array_equal(image, wanted)


@pytest.mark.parametrize("gain", [0.5, 1.0, 8.0])
@pytest.mark.parametrize("light", [0.0, 0.02, 0.5])
def test_noise_has_the_variance_of_counted_photons(light: float, gain: float) -> None:
    full_well, read = 8000.0, 20.0
    rng = np.random.default_rng(3)
    measured = noisy(np.full(400_000, light, np.float32), gain, full_well, read, rng)
    electrons = light * full_well / max(gain, 1.0)
    sd = math.sqrt(electrons + read * read) * max(gain, 1.0) / full_well
    assert measured.mean() == pytest.approx(light, abs=4.0 * sd / math.sqrt(400_000) + 1e-6)
    assert measured.std() == pytest.approx(sd, rel=0.01)


def test_the_normal_approximation_has_the_quantiles_of_poisson_s_law() -> None:
    full_well, light = 10_000.0, 0.1
    rng = np.random.default_rng(4)
    measured = noisy(np.full(400_000, light, np.float32), 1.0, full_well, 0.0, rng) * full_well
    for share in (0.01, 0.1, 0.5, 0.9, 0.99):
        wanted = stats.poisson(light * full_well).ppf(share)
        # A thousand electrons: the skew is a thirtieth of a standard deviation.
        assert np.quantile(measured, share) == pytest.approx(wanted, abs=3.0)


def test_noise_is_that_of_seed_and_frame() -> None:
    forming = ImageFormation(camera(full_well_e=2000.0, read_noise_e=5.0))
    taken = [forming.take(edge(), 0, AT_REST, *key).image.tobytes()
             for key in ((1, 0), (1, 1), (2, 0), (1, 0))]  # fmt: skip
    assert taken[0] == taken[3]
    assert len(set(taken)) == 3


def test_interpolated_colours_are_means_of_the_nearest_pixels_that_measure_them() -> None:
    """Reference: every pixel computed separately, in loops."""
    rng = np.random.default_rng(5)
    raw = rng.random((7, 10)).astype(np.float32)
    colour = np.array([[(0, 1), (1, 2)][v % 2][u % 2] for v in range(7) for u in range(10)])
    colour = colour.reshape(7, 10)
    found = demosaiced(raw)
    for v in range(7):
        for u in range(10):
            for channel in range(3):
                near = {
                    reach: [
                        raw[v + i, u + j]
                        for i in (-1, 0, 1)
                        for j in (-1, 0, 1)
                        if abs(i) + abs(j) == reach
                        and 0 <= v + i < 7
                        and 0 <= u + j < 10
                        and colour[v + i, u + j] == channel
                    ]
                    for reach in (0, 1, 2)
                }
                nearest = next(values for values in near.values() if values)
                assert found[v, u, channel] == pytest.approx(np.mean(nearest), abs=1e-6)


def test_a_ramp_of_one_colour_passes_the_mosaic_unchanged() -> None:
    ramp_of = np.linspace(0.1, 0.9, 20, dtype=np.float32)[None, :, None]
    light = np.broadcast_to(ramp_of * np.array([1.0, 0.5, 0.2], np.float32), (12, 20, 3))
    back = demosaiced(mosaic(light))
    np.testing.assert_allclose(back[1:-1, 1:-1], light[1:-1, 1:-1], atol=1e-6)


# --- JPEG


@pytest.mark.parametrize("kind", ["rgb", "grey"])
def test_a_jpeg_is_what_the_wire_carries_and_what_is_seen(kind: CameraKind) -> None:
    forming = ImageFormation(camera(kind, jpeg_quality=60))
    image, jpeg = forming.take(edge(), 0, AT_REST, 0, 0)
    assert jpeg is not None
    decoded = np.asarray(Image.open(io.BytesIO(jpeg))).reshape(image.shape)
    np.testing.assert_array_equal(image, decoded)
    plain, _ = ImageFormation(camera(kind)).take(edge(), 0, AT_REST, 0, 0)
    assert 0.0 < np.abs(image.astype(float) - plain).mean() < 5.0
    lens = Intrinsics.of(camera(kind))
    wire = Frame(3, 4, image, lens, jpeg).to_bytes()
    assert len(wire) == 48 + len(jpeg) < image.size
    back = Frame.from_bytes(wire)
    assert back.intrinsics == lens
    assert (back.sequence, back.capture_time_us, back.jpeg) == (3, 4, jpeg)
    np.testing.assert_array_equal(back.image, image)


def test_worse_quality_is_farther_from_the_image() -> None:
    plain, _ = ImageFormation(camera()).take(edge(), 0, AT_REST, 0, 0)
    off = [
        np.abs(image_of(jpeg_of(plain, quality), *plain.shape).astype(float) - plain).mean()
        for quality in (5, 30, 95)
    ]
    assert off[0] > off[1] > off[2]


def test_a_jpeg_that_is_none_or_another_is_no_frame() -> None:
    image, jpeg = ImageFormation(camera(jpeg_quality=60)).take(edge(), 0, AT_REST, 0, 0)
    assert jpeg is not None
    lens = Intrinsics.of(camera())
    wire = Frame(3, 4, image, lens, jpeg).to_bytes()
    other = Frame(3, 4, image, replace(lens, width=64), jpeg).to_bytes()
    grey_one = Frame(3, 4, image, replace(lens, kind="grey"), jpeg).to_bytes()
    for damaged in (wire[:48], wire[:-400], wire[:48] + b"x" * 900, other, grey_one):
        with pytest.raises(FrameError):
            Frame.from_bytes(damaged)


# --- rejected settings


@pytest.mark.parametrize(
    ("kind", "imaging", "told"),
    [
        ("depth", {}, "camera.kind.*'depth'.*camera.imaging; accepted: rgb or grey"),
        ("grey", {"bayer": True}, "camera.imaging.bayer.*false with a camera of kind 'grey'"),
        ("rgb", {"exposure_ms": 51.0}, r"camera.imaging.exposure_ms.*51.*value <= 50 ms"),
        ("rgb", {"readout_ms": 51.0}, r"camera.imaging.readout_ms.*51.*value <= 50 ms"),
        ("rgb", {"read_noise_e": 3.0}, "read_noise_e = 3: accepted: 0 without full_well_e"),
        ("rgb", {"gain": 2.0, "auto_exposure": {}}, "gain = 2: accepted: 1 with a table"),
        ("rgb", {"jpeg_quality": 0}, "jpeg_quality"),
    ],
)
def test_what_does_not_go_together_is_refused(
    kind: CameraKind, imaging: dict[str, Any], told: str
) -> None:
    with pytest.raises((FieldError, ValidationError), match=told):
        camera(kind, **imaging)


def test_an_empty_table_has_the_defaults() -> None:
    assert Imaging() == camera().imaging

"""Atmosphere, home and constants against published tables."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.core import constants
from airl_mav.core.frames import HOME, MAGNETIC_DECLINATION, MAGNETIC_FIELD_NED
from airl_mav.vehicle.atmosphere import altitude_m, pressure_hpa, temperature_c

# U.S. Standard Atmosphere 1976 = ISO 2533 below 32 km, by geopotential altitude:
# altitude [m], pressure [hPa], temperature [K], density [kg/m³].
ISA = [
    (0.0, 1013.25, 288.15, 1.2250),
    (500.0, 954.61, 284.90, 1.1673),
    (1000.0, 898.75, 281.65, 1.1116),
    (5000.0, 540.20, 255.65, 0.73612),
]


@pytest.mark.parametrize(("altitude", "pressure", "kelvin", "density"), ISA)
def test_matches_the_published_table(
    altitude: float, pressure: float, kelvin: float, density: float
) -> None:
    assert pressure_hpa(altitude) == pytest.approx(pressure, abs=0.006)
    assert temperature_c(altitude) + 273.15 == pytest.approx(kelvin, abs=0.005)
    # Ideal gas: ties pressure, temperature and the gas constant to a third column.
    rho = 100.0 * pressure_hpa(altitude) / (constants.GAS_CONSTANT_AIR * kelvin)
    assert rho == pytest.approx(density, rel=1e-4)


@pytest.mark.parametrize(("altitude", "pressure", "_kelvin", "_density"), ISA)
def test_the_inverse_matches_the_table(
    altitude: float, pressure: float, _kelvin: float, _density: float
) -> None:
    # The table has two decimals: 0.005 hPa is 4 cm at sea level, 7 cm at 5 km.
    assert altitude_m(pressure) == pytest.approx(altitude, abs=0.1)


@given(st.floats(-400.0, 11_000.0))
def test_the_inverse_returns_the_altitude(altitude: float) -> None:
    assert altitude_m(pressure_hpa(altitude)) == pytest.approx(altitude, abs=1e-6)


@given(st.floats(-400.0, 10_900.0))
def test_the_air_is_in_hydrostatic_balance(altitude: float) -> None:
    slope = 100.0 * (pressure_hpa(altitude + 0.5) - pressure_hpa(altitude - 0.5))
    kelvin = temperature_c(altitude) + 273.15
    weight = 100.0 * pressure_hpa(altitude) / (287.05287 * kelvin) * 9.80665
    assert slope == pytest.approx(-weight, rel=1e-6)


def test_constants_are_the_defined_ones() -> None:
    assert constants.GRAVITY_M_S2 == 9.80665
    assert constants.SEA_LEVEL_PRESSURE_HPA == 1013.25
    # R* / M of ISO 2533.
    assert pytest.approx(8314.32 / 28.964420, rel=1e-6) == constants.GAS_CONSTANT_AIR
    sea_level = 101_325.0 / (constants.GAS_CONSTANT_AIR * constants.SEA_LEVEL_TEMPERATURE_K)
    assert pytest.approx(sea_level, rel=1e-4) == constants.AIR_DENSITY_KG_M3
    assert math.degrees(1.0) * constants.DEG == pytest.approx(1.0)
    assert pytest.approx(1.0) == constants.TICK_S * 250
    assert constants.TICK_US * 250 == constants.US_PER_S


def test_home_is_px4s() -> None:
    assert (HOME.latitude_deg, HOME.longitude_deg) == (47.397743, 8.545594)
    assert 480.0 < HOME.altitude_m < 500.0


def test_the_magnetic_constants_agree_with_each_other_and_the_model() -> None:
    north, east, down = MAGNETIC_FIELD_NED
    # World Magnetic Model 2020-2025 at Zurich: 0.482 G, 63.6 deg down, 3.2 deg east.
    assert np.linalg.norm(MAGNETIC_FIELD_NED) == pytest.approx(0.482, abs=1e-3)
    dip = math.degrees(math.asin(down / np.linalg.norm(MAGNETIC_FIELD_NED)))
    assert dip == pytest.approx(63.6, abs=0.1)
    assert math.degrees(MAGNETIC_DECLINATION) == pytest.approx(3.2, abs=0.05)
    assert math.tan(MAGNETIC_DECLINATION) == pytest.approx(east / north)
    assert north > 0.0
    assert down > 0.0

"""International Standard Atmosphere below 11 km (ISO 2533)."""

from __future__ import annotations

from airl_mav.core.constants import (
    GAS_CONSTANT_AIR,
    GRAVITY_M_S2,
    SEA_LEVEL_PRESSURE_HPA,
    SEA_LEVEL_TEMPERATURE_K,
    TEMPERATURE_LAPSE_K_M,
    ZERO_CELSIUS_K,
)

_EXPONENT = GRAVITY_M_S2 / (GAS_CONSTANT_AIR * TEMPERATURE_LAPSE_K_M)


def pressure_hpa(altitude_m: float) -> float:
    """Return the static pressure [hPa] at an altitude above mean sea level [m]."""
    ratio = 1.0 - TEMPERATURE_LAPSE_K_M * altitude_m / SEA_LEVEL_TEMPERATURE_K
    return float(SEA_LEVEL_PRESSURE_HPA * ratio**_EXPONENT)


def altitude_m(pressure: float) -> float:
    """Return the altitude above mean sea level [m] of a static pressure [hPa]."""
    ratio = (pressure / SEA_LEVEL_PRESSURE_HPA) ** (1.0 / _EXPONENT)
    return float((1.0 - ratio) * SEA_LEVEL_TEMPERATURE_K / TEMPERATURE_LAPSE_K_M)


def temperature_c(altitude: float) -> float:
    """Return the air temperature [°C] at an altitude above mean sea level [m]."""
    return SEA_LEVEL_TEMPERATURE_K - TEMPERATURE_LAPSE_K_M * altitude - ZERO_CELSIUS_K

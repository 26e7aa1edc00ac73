"""Physical constants with their sources, unit conversions, and definitions for all processes."""

from __future__ import annotations

import math
from typing import Final, Literal

LOOPBACK = "127.0.0.1"


GRAVITY_M_S2: Final = 9.80665
"""Standard gravity [m/s²] (CGPM 1901; PX4's CONSTANTS_ONE_G)."""

AIR_DENSITY_KG_M3: Final = 1.225
"""Air density at sea level, 15 °C [kg/m³] (ISA, ISO 2533)."""

SEA_LEVEL_PRESSURE_HPA: Final = 1013.25
"""ISA static pressure at sea level [hPa]."""

SEA_LEVEL_TEMPERATURE_K: Final = 288.15
"""ISA temperature at sea level [K]."""

TEMPERATURE_LAPSE_K_M: Final = 0.0065
"""ISA temperature lapse rate in the troposphere [K/m]."""

GAS_CONSTANT_AIR: Final = 287.05287
"""Specific gas constant of dry air [J/(kg K)] (ISA)."""

EARTH_RADIUS_M: Final = 6_371_000.0
"""Radius of PX4's azimuthal equidistant local projection [m] (CONSTANTS_RADIUS_OF_EARTH)."""

ZERO_CELSIUS_K: Final = 273.15
"""0 °C [K]."""

C_PER_MAH: Final = 3.6
"""Coulombs in a milliampere-hour."""

G_PER_KG: Final = 1_000
MS_PER_S: Final = 1_000
US_PER_MS: Final = 1_000
US_PER_S: Final = 1_000_000
"""Microseconds in a second."""

TICK_US: Final = 4_000
"""Base tick of plant and autopilot [µs]: 250 Hz, PX4's simulator interface rate."""

TICK_S: Final = TICK_US / US_PER_S
"""Base tick [s]."""

TICK_HZ: Final = US_PER_S // TICK_US
"""Base ticks per second."""

DEG: Final = math.pi / 180.0
"""One degree [rad]."""

TAKEOFF_REACHED_M: Final = 0.2
"""Distance from the take-off altitude at which the climb ends [m]. PX4 needs seconds for the last
decimetres, as its approach halves the rest in 1.4 s."""

TAKEOFF_REACHED_M_S: Final = 0.3
"""Maximum vertical speed at the end of the climb [m/s]."""

MAX_ATTEMPTS: Final = 3
"""Maximum number of attempts for a job or a flight that loses its processes."""
Level = Literal["gym", "lockstep", "sitl", "hil", "firmware", "flight"]
"""Fidelity level, as named in reports."""
CommandKind = Literal["velocity", "attitude", "body_rates"]
"""Type of a policy's commands, equal for all of its actions."""
UNMEASURED_A: Final = -1.0
"""PX4's battery current if the monitor does not measure it [A], as in its simulated battery.
Source: PX4 1.16, msg/versioned/BatteryStatus.msg, current_a."""

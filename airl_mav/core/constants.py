"""Physical constants with their sources, unit conversions, and what holds for all processes."""

from __future__ import annotations

import math
from typing import Final, Literal

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
"""Base ticks a second."""

DEG: Final = math.pi / 180.0
"""One degree [rad]."""

TAKEOFF_REACHED_M: Final = 0.2
"""The climb is over this close to the take-off altitude [m]: PX4's last decimetres take seconds, as
its approach halves the rest in 1.4 s."""

TAKEOFF_REACHED_M_S: Final = 0.3
"""Maximum vertical speed at the end of the climb [m/s]."""

MAX_ATTEMPTS: Final = 3
"""A job or a flight whose processes are lost is begun so many times, the first included."""
Level = Literal["gym", "lockstep", "sitl", "hil", "firmware", "flight"]
"""What flew, as a report calls it: a rung of the fidelity ladder."""
CommandKind = Literal["velocity", "attitude", "body_rates"]
"""What a policy commands: all actions of one are of one kind."""
UNMEASURED_A: Final = -1.0
"""What PX4 tells as the battery's current where its monitor measures none [A]. Its simulated one
does not. Source: PX4 1.16, msg/versioned/BatteryStatus.msg, current_a."""

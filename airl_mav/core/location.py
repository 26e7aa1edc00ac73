"""Where on the globe a rehearsal takes place: PX4's default SITL home, Zurich."""

from __future__ import annotations

from typing import Final

import numpy as np

from airl_mav.core.frames import Geodetic, Vector

HOME: Final = Geodetic(47.397743, 8.545594, 489.4)
"""Home of PX4 SITL: latitude, longitude [deg], altitude above mean sea level [m]."""

MAGNETIC_FIELD_NED: Final[Vector] = np.array([0.2143, 0.0119, 0.4317])
"""Earth's magnetic field at HOME [gauss]: 0.482 G, inclination 63.6°, declination 3.2°
(World Magnetic Model 2020-2025)."""

MAGNETIC_DECLINATION: Final = float(np.arctan2(MAGNETIC_FIELD_NED[1], MAGNETIC_FIELD_NED[0]))
"""Angle from true to magnetic north at HOME [rad], positive east."""

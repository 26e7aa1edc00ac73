"""Compass check: strength and inclination of the measured field against the earth's field.

Source: PX4 1.16, EKF2 `checkMagField` and its parameters. The expected field is the local one
(`core.frames`); PX4 uses the World Magnetic Model.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntFlag
from typing import NamedTuple

import numpy as np

from airl_mav.core.frames import MAGNETIC_FIELD_NED, Vector
from airl_mav.vehicle.rotation import Quat, rotate

STRENGTH_GAUSS = float(np.linalg.norm(MAGNETIC_FIELD_NED))
INCLINATION_RAD = math.asin(MAGNETIC_FIELD_NED[2] / STRENGTH_GAUSS)
"""Inclination [rad], positive down."""

_LEAST_GAUSS = 1e-4
"""Minimum strength of a field with a defined direction."""


class Checked(IntFlag):
    """Bits of EKF2_MAG_CHECK."""

    STRENGTH = 1
    INCLINATION = 2


class FieldCheck(NamedTuple):
    """Tolerances for the measured field."""

    checked: int
    strength_gauss: float
    """Maximum error of the strength [gauss]."""
    inclination_rad: float

    @classmethod
    def read(cls, value: Callable[[str], float]) -> FieldCheck:
        """Read the tolerances with a look-up for PX4 parameters."""
        return cls(
            int(value("EKF2_MAG_CHECK")),
            value("EKF2_MAG_CHK_STR"),
            math.radians(value("EKF2_MAG_CHK_INC")),
        )

    def disturbed(self, field: Vector, attitude: Quat) -> bool:
        """Return whether the field differs from the earth's field.

        Args:
            field: Measured field (3,) FRD [gauss].
            attitude: Rotation from body to world; its heading has no effect.
        """
        strength = float(np.linalg.norm(field))
        if self.checked & Checked.STRENGTH and not (
            abs(strength - STRENGTH_GAUSS) <= self.strength_gauss
        ):
            return True
        if not self.checked & Checked.INCLINATION:
            return False
        _, _, down = rotate(attitude, (field.item(0), field.item(1), field.item(2)))
        inclination = math.asin(max(-1.0, min(1.0, down / max(strength, _LEAST_GAUSS))))
        return not abs(inclination - INCLINATION_RAD) <= self.inclination_rad

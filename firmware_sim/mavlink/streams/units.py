"""Conversion to MAVLink field values: scaled, rounded, saturated, or the "unknown" value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from numba.extending import register_jitable

INT16_MAX: Final = 32_767
INT32_MAX: Final = 2_147_483_647
UINT16_MAX: Final = 65_535
UINT32_MAX: Final = 4_294_967_295

TWO_PI: Final = 2.0 * math.pi


def saturate(value: float, low: int, high: int, unknown: int) -> int:
    """Return `value` rounded and clamped to low..high; `unknown` for NaN."""
    # NaN is the only value that differs from itself.
    if value != value:
        return unknown
    if value >= high:
        return high
    return low if value <= low else round(value)


def int16(value: float, unknown: int = 0) -> int:
    """Return a value for an int16 field."""
    return saturate(value, -INT16_MAX - 1, INT16_MAX, unknown)


def int32(value: float, unknown: int = 0) -> int:
    """Return a value for an int32 field."""
    return saturate(value, -INT32_MAX - 1, INT32_MAX, unknown)


def uint16(value: float, unknown: int = UINT16_MAX) -> int:
    """Return a value for a uint16 field whose maximum means unknown."""
    return saturate(value, 0, UINT16_MAX - 1, unknown)


def uint32(value: float, unknown: int = 0) -> int:
    """Return a value for a uint32 field."""
    return saturate(value, 0, UINT32_MAX, unknown)


def boot_ms(time_us: int) -> int:
    """Return time_boot_ms [ms] of simulated time [µs]; wraps after 49 days, like the field."""
    return time_us // 1_000 & UINT32_MAX


def deg_e7(angle_deg: float) -> int:
    """Return an angle [deg] as degE7."""
    return int32(angle_deg * 1e7)


def mm(length_m: float) -> int:
    """Return a length [m] as int32 millimetres."""
    return int32(length_m * 1e3)


def cm_s(speed_m_s: float) -> int:
    """Return a velocity [m/s] as int16 cm/s."""
    return int16(speed_m_s * 1e2)


def centidegrees(angle_rad: float) -> int:
    """Return an angle [rad] as centidegrees 0..35999, UINT16_MAX when unknown."""
    if not math.isfinite(angle_rad):
        return UINT16_MAX
    return round(math.degrees(angle_rad % TWO_PI) * 100.0) % 36_000


for _function in (saturate, int16, int32, uint16, uint32, boot_ms, deg_e7, mm, cm_s, centidegrees):
    register_jitable(_function)  # callable from kernels and from Python


DIAGONAL = (0, 6, 11, 15, 18, 20)
"""Indices of the diagonal in the upper triangle of a 6 x 6 matrix, in row order."""


def triangle(diagonal: Sequence[float]) -> tuple[float, ...]:
    """Return an upper triangle with a diagonal (6,). Other elements are unknown (NaN)."""
    a, b, c, d, e, f = diagonal
    n = math.nan
    return a, n, n, n, n, n, b, n, n, n, n, c, n, n, n, d, n, n, e, n, f


def percent(share: float) -> int:
    """Return a fraction 0..1 as percent for an int8 field; -1 if unknown."""
    return saturate(share * 100.0, 0, 100, -1)

"""PX4's CRC-32: of parameters, and of files over MAVLink FTP."""

from __future__ import annotations

import zlib

_ALL_ONES = 0xFFFF_FFFF


def crc32part(data: bytes, crc: int = 0) -> int:
    """Return the CRC-32 of what came before (`crc`) and of `data`.

    zlib inverts before and after; PX4's crc32part() does not.
    """
    return zlib.crc32(data, crc ^ _ALL_ONES) ^ _ALL_ONES

"""What MAVSDK's library offers and MAVSDK-Python 4.1 does not wrap, or wraps slowly."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

from mavsdk import Mavsdk

CHUNK = 65_536
"""Bytes that are fed at a time; MAVSDK's parser puts a divided frame together again."""


def exchange(mavsdk: Mavsdk, sent: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """Take over the bytes of a `raw://` connection; see `link.MavsdkLink.exchange_raw`."""
    library, handle = mavsdk._lib, mavsdk._handle
    mavsdk.subscribe_raw_bytes_to_be_sent(sent)
    # MAVSDK-Python's own function makes a ctypes array type for every length of `data`: 0.1 ms.
    buffer = (ctypes.c_uint8 * CHUNK)()
    pass_bytes = library.mavsdk_pass_received_raw_bytes

    def feed(data: bytes) -> None:
        for start in range(0, len(data), CHUNK):
            chunk = data[start : start + CHUNK]
            ctypes.memmove(buffer, chunk, len(chunk))
            pass_bytes(handle, buffer, len(chunk))

    return feed


def set_timeout(mavsdk: Mavsdk, seconds: float) -> None:
    """Let MAVSDK repeat what has not been answered after so long [wall s]."""
    call = mavsdk._lib.mavsdk_set_timeout_s
    call.argtypes = [ctypes.c_void_p, ctypes.c_double]
    call(mavsdk._handle, seconds)

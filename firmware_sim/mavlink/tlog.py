"""tlog: raw MAVLink with receive times, readable by MAVProxy, QGroundControl and pymavlink.

A record is an 8-byte big-endian time [µs since 1970, UTC] and one frame.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from airl_mav.core.log_file import LogFile

_TIME = struct.Struct(">Q")
_LINK_BITS = 0b11
"""MAVProxy keeps a link number in a time's two lowest bits; ours is 0."""


class TlogWriter(LogFile):
    """Writes a log of MAVLink frames."""

    def __init__(
        self, path: Path, start_unix_us: int, on_lost: Callable[[str], None] = lambda _: None
    ) -> None:
        """Open the file, whose final name is `path`; see `LogFile`.

        `start_unix_us` is the calendar time of simulated time 0 [µs since 1970, UTC].
        """
        super().__init__(path, on_lost)
        self._start_unix_us = start_unix_us

    def beside(self, name: str) -> TlogWriter:
        """Open another log of the same times: flight-001.NAME.tlog beside flight-001.tlog.

        Raises OSError.
        """
        path = self.path.with_name(f"{self.path.stem}.{name}{self.path.suffix}")
        return TlogWriter(path, self._start_unix_us, self.on_lost)

    def write(self, time_us: int, *frames: bytes) -> None:
        """Add frames, sent or received at simulated `time_us` [µs]."""
        stamp = _TIME.pack(self._start_unix_us + time_us & ~_LINK_BITS)
        self.add(time_us, *(part for frame in frames for part in (stamp, frame)))

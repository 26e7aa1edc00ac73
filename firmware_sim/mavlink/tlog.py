"""tlog: raw MAVLink with receive times, readable by MAVProxy, QGroundControl and pymavlink.

A record is an 8-byte big-endian time [µs since 1970, UTC] and one frame.
"""

from __future__ import annotations

import struct
from pathlib import Path

from airl_mav.core.constants import US_PER_S

PARTIAL_SUFFIX = ".part"
"""Added to the file's name until the log is complete."""

_TIME = struct.Struct(">Q")
_LINK_BITS = 0b11
"""MAVProxy keeps a link number in a time's two lowest bits; ours is 0."""

_FLUSH_BYTES = 65_536
_FLUSH_US = US_PER_S


class TlogWriter:
    """Writes a log under a temporary name and renames it when closed.

    Whole records are written, at the latest after one second of simulated time: a killed process
    leaves a valid log under the temporary name that lacks its last second at most.
    """

    def __init__(self, path: Path, start_unix_us: int) -> None:
        """Open the file, whose final name is `path`.

        `start_unix_us` is the calendar time of simulated time 0 [µs since 1970, UTC].
        """
        self.path = path
        self.partial_path = path.with_name(path.name + PARTIAL_SUFFIX)
        self._start_unix_us = start_unix_us
        self._buffer = bytearray()
        self._flushed_us: int | None = None
        self._file = self.partial_path.open("wb", buffering=0)

    def write(self, time_us: int, frame: bytes) -> None:
        """Add one frame, sent or received at simulated `time_us` [µs]."""
        self._buffer += _TIME.pack(self._start_unix_us + time_us & ~_LINK_BITS)
        self._buffer += frame
        if self._flushed_us is None:
            self._flushed_us = time_us
        if len(self._buffer) >= _FLUSH_BYTES or time_us - self._flushed_us >= _FLUSH_US:
            self.flush()
            self._flushed_us = time_us

    def flush(self) -> None:
        """Write out what is buffered."""
        view = memoryview(bytes(self._buffer))
        while view:
            view = view[self._file.write(view) :]
        self._buffer.clear()

    def close(self) -> None:
        """Complete the log and give it its final name; harmless when called again."""
        if self._file.closed:
            return
        self.flush()
        self._file.close()
        self.partial_path.replace(self.path)

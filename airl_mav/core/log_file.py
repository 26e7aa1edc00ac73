"""A file that grows during a flight: under a temporary name until it is whole."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from airl_mav.core.constants import US_PER_S

PARTIAL_SUFFIX = ".part"
"""Added to the file's name until the log is complete."""

_FLUSH_BYTES = 65_536
_FLUSH_US = US_PER_S


class LogFile:
    """Writer of whole records, at the latest after one second of simulated time.

    A killed process leaves a valid log under the temporary name. It lacks its last second at most.
    A log that cannot be written any more, on a full disk, ends with its last whole record. The
    program continues without it.
    """

    def __init__(self, path: Path, on_lost: Callable[[str], None] = lambda _: None) -> None:
        """Open the file, or raise OSError. `on_lost` is called once if writing fails."""
        self.path = path
        self.on_lost = on_lost
        self.lost = False
        """Whether it ended early."""
        self.failure: OSError | None = None
        self.partial_path = path.with_name(path.name + PARTIAL_SUFFIX)
        self._buffer = bytearray()
        self._written = 0
        self._flushed_us: int | None = None
        self._file = self.partial_path.open("wb", buffering=0)

    @property
    def size_bytes(self) -> int:
        """Size by now, with what is not yet written."""
        return self._written + len(self._buffer)

    @property
    def written_bytes(self) -> int:
        """Size of what stands in the file by now."""
        return self._written

    @property
    def closed(self) -> bool:
        """Whether the log is complete."""
        return self._file.closed

    def add(self, time_us: int, *parts: bytes) -> None:
        """Add one record, in parts, at simulated `time_us` [µs]."""
        if self.lost:
            return
        for part in parts:
            self._buffer += part
        if self._flushed_us is None:
            self._flushed_us = time_us
        if len(self._buffer) >= _FLUSH_BYTES or time_us - self._flushed_us >= _FLUSH_US:
            self.flush()
            self._flushed_us = time_us

    def flush(self) -> None:
        """Write out what is buffered."""
        whole = self._written
        view = memoryview(bytes(self._buffer))
        self._buffer.clear()
        try:
            while view:
                count = self._file.write(view)
                self._written += count
                view = view[count:]
        except OSError as error:
            self._end(error, whole)

    def close(self) -> None:
        """Complete the log and give it its final name; harmless when called again.

        Of one that never had a record nothing is left.
        """
        if self._file.closed:
            return
        self.flush()
        try:
            self._file.close()
            if self.lost and not self._written:
                self.partial_path.unlink()
            else:
                self.partial_path.replace(self.path)
        except OSError as error:
            self._end(error, self._written)

    def discard(self) -> None:
        """Close the file, and leave nothing of it."""
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self.partial_path.unlink(missing_ok=True)

    def _end(self, error: OSError, whole: int) -> None:
        """Write nothing any more, and leave the whole records, of so many bytes."""
        with suppress(OSError, ValueError):  # not a file that could be cut, or closed by now
            self._file.truncate(whole)
        self._written = whole
        if not self.lost:
            self.lost, self.failure = True, error
            self.on_lost(f"{self.path}: {error.strerror}; the log ends after {whole} bytes")

"""Log file written during a flight, under a temporary name until it is complete."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from airl_mav.core.constants import US_PER_S

PARTIAL_SUFFIX = ".part"
"""Suffix of the file's name until the log is complete."""

_FLUSH_BYTES = 65_536
_FLUSH_US = US_PER_S


class LogFile:
    """Writer of complete records, at the latest after one second of simulated time.

    A killed process leaves a valid log under the temporary name, which lacks at most its last
    second. If writing fails, for example on a full disk, the log ends with its last complete
    record. The program continues without it.
    """

    def __init__(self, path: Path, on_lost: Callable[[str], None] = lambda _: None) -> None:
        """Open the file, or raise OSError. `on_lost` is called once if writing fails."""
        self.path = path
        self.on_lost = on_lost
        self.lost = False
        """True if the log has ended early."""
        self.failure: OSError | None = None
        self.partial_path = path.with_name(path.name + PARTIAL_SUFFIX)
        self._buffer = bytearray()
        self._written = 0
        self._flushed_us: int | None = None
        self._file = self.partial_path.open("wb", buffering=0)

    @property
    def size_bytes(self) -> int:
        """Current size, including buffered data [bytes]."""
        return self._written + len(self._buffer)

    @property
    def written_bytes(self) -> int:
        """Current size of the file [bytes]."""
        return self._written

    @property
    def closed(self) -> bool:
        """True if the log is complete."""
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
        """Write buffered data to the file."""
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
        """Complete the log and rename it to its final name; may be called repeatedly.

        A lost log without records is deleted.
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
        """Close and delete the file."""
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self.partial_path.unlink(missing_ok=True)

    def _end(self, error: OSError, whole: int) -> None:
        """Stop writing, and truncate the file to its complete records of `whole` bytes."""
        with suppress(OSError, ValueError):  # not a regular file, or closed
            self._file.truncate(whole)
        self._written = whole
        if not self.lost:
            self.lost, self.failure = True, error
            self.on_lost(f"{self.path}: {error.strerror}; the log ends after {whole} bytes")

"""Flight logs of a folder, for clients to list and download."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.port import LogEntry, OpenLog
from firmware_sim.flight_log.flight_log import FlightLog

ULOG_SUFFIX = ".ulg"

OPEN_FILES = 8
"""Maximum number of log files kept open for downloads, which read a few bytes per tick."""


class LogFolder:
    """Complete logs by name, then the open log; rescans changed folders. Implements `LogStore`."""

    def __init__(self, folder: Path, current: FlightLog) -> None:
        """Set the folder and the log currently written in it."""
        self._folder = folder
        self._current = current
        self._complete: Sequence[Path] = ()
        self._seen: tuple[int, bool] | None = None
        """Folder change time [ns] and closed flag of the log when `_complete` was scanned."""
        self._files: OrderedDict[Path, BinaryIO] = OrderedDict()
        """Open files; the most recently read file is last."""

    def entries(self) -> Sequence[LogEntry]:
        """Return the logs; the log currently written is last."""
        entries = [_entry(path) for path in self._completed()]
        if not self._current.writer.closed:
            began_s = self._current.began_unix_us // US_PER_S
            entries.append(LogEntry(began_s, self._current.writer.size_bytes))
        return entries

    def read(self, number: int, offset: int, count: int) -> bytes:
        """Return up to `count` bytes of a log, fewer at the end; b"" for a missing log."""
        complete = self._completed()
        if 0 <= number < len(complete):
            path = complete[number]
        elif number == len(complete) and not self._current.writer.closed:
            path = self._current.writer.partial_path
            if offset + count > self._current.writer.written_bytes:
                self._current.writer.flush()
        else:
            return b""
        try:
            file = self._opened(path)
            file.seek(offset)
            return file.read(count)
        except OSError:
            return b""  # removed by another program

    def open_log(self) -> OpenLog | None:
        """Return the log currently written; None = no open log."""
        log = self._current.writer
        if log.closed:
            return None
        return OpenLog(len(self._completed()), log.head_bytes, log.size_bytes)

    def close(self) -> None:
        """Close all files open for downloads. Idempotent."""
        while self._files:
            self._files.popitem()[1].close()

    def _completed(self) -> Sequence[Path]:
        seen = self._folder.stat().st_mtime_ns, self._current.writer.closed
        if seen != self._seen:
            self.close()
            self._seen = seen
            self._complete = sorted(self._folder.glob(f"*{ULOG_SUFFIX}"))
        return self._complete

    def _opened(self, path: Path) -> BinaryIO:
        file = self._files.get(path)
        if file is None:
            if len(self._files) >= OPEN_FILES:
                self._files.popitem(last=False)[1].close()
            file = self._files[path] = path.open("rb", buffering=0)
        self._files.move_to_end(path)
        return file


def _entry(path: Path) -> LogEntry:
    try:
        stat = path.stat()
    except OSError:
        return LogEntry(0, 0)  # removed by another program
    return LogEntry(int(stat.st_mtime), stat.st_size)

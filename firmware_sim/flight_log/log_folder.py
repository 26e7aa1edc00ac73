"""The logs of a folder, as clients list and download them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.port import LogEntry, OpenLog
from firmware_sim.flight_log.flight_log import FlightLog

ULOG_SUFFIX = ".ulg"
"""Of a vehicle's own log."""


class LogFolder:
    """Complete logs by their names, then the one that is being written. Implements `LogStore`."""

    def __init__(self, folder: Path, current: FlightLog) -> None:
        """Take the folder, and the log that is being written in it."""
        self._folder = folder
        self._current = current

    def entries(self) -> Sequence[LogEntry]:
        """Return the logs, the one that is being written last."""
        found = [(path.stat(), path) for path in self._complete()]
        entries = [LogEntry(int(stat.st_mtime), stat.st_size) for stat, _ in found]
        if not self._current.closed:
            began_s = self._current.began_unix_us // US_PER_S
            entries.append(LogEntry(began_s, self._current.size_bytes))
        return entries

    def read(self, number: int, offset: int, count: int) -> bytes:
        """Return up to `count` bytes of a log, fewer at its end; none when there is no such log."""
        complete = self._complete()
        if 0 <= number < len(complete):
            path = complete[number]
        elif number == len(complete) and not self._current.closed:
            path = self._current.partial_path
            if offset + count > path.stat().st_size:
                self._current.flush()
        else:
            return b""
        with path.open("rb") as file:
            file.seek(offset)
            return file.read(count)

    def open_log(self) -> OpenLog | None:
        """Return the log that is being written, None when there is none."""
        log = self._current
        if log.closed:
            return None
        return OpenLog(len(self._complete()), log.head_bytes, log.size_bytes)

    def _complete(self) -> list[Path]:
        return sorted(self._folder.glob(f"*{ULOG_SUFFIX}"))

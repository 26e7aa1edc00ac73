"""ULog flight log of one vehicle, and the folder of its logs."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from airl_mav import __version__
from airl_mav.core import constants
from firmware_sim import interfaces
from firmware_sim.addons.flight_log import topics, ulog_writer
from firmware_sim.autopilot import autopilot, autopilot_state, parameter_store, snapshot
from firmware_sim.engine.record import FLOWN_TICK, TRUE_TICK, Record
from firmware_sim.mavlink.streams import status

POLL_US = 5 * constants.TICK_US
"""Interval of checks for due topics of the newest state [µs]."""

BUFFERED = constants.TICK_HZ
"""Maximum number of ticks before they are logged."""

_DATA_FORMAT = 2
"""ver_data_format: selects the field names in Flight Review, the same for PX4 1.16 to 1.18."""


def described(flight_sw_version: int) -> tuple[tuple[str, str | int], ...]:
    """Return vehicle information by ULog key, in addition to the name."""
    return (
        ("ver_sw", f"airl-mav {__version__}"),
        ("ver_sw_branch", "built-in"),
        ("ver_sw_release", flight_sw_version),
        ("ver_hw", "PX4_SITL"),
        ("ver_data_format", _DATA_FORMAT),
        ("sys_uuid", f"{status.UID:036x}"),
        ("int32_t time_ref_utc", 0),
    )


class UlogFlightLog:
    """Flight log of a vehicle in a .ulg file."""

    def __init__(
        self,
        path: Path,
        parameters: parameter_store.Parameters,
        start_us: int,
        boot_unix_us: int,
        on_lost: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Open the log; see `UlogWriter`.

        `path` is the final name, set on closing; `boot_unix_us` is the calendar time of simulated
        time 0 [µs since 1970].
        """
        self._boot_unix_us = boot_unix_us
        self.began_unix_us = boot_unix_us + start_us
        """Calendar time of the start of the log [µs since 1970]."""
        self._due_us = [start_us] * len(topics.TOPICS)
        self._poll_us = start_us
        self._last: dict[int, bytes] = {}
        """Newest message of each topic of the state, without its timestamp."""
        self._flown, self._truths = (np.zeros(BUFFERED, kind) for kind in (FLOWN_TICK, TRUE_TICK))
        """Ticks to be logged."""
        self._count = 0
        """Number of ticks to be logged."""
        self._state: snapshot.AutopilotState | None = None
        """State after the newest tick."""
        self._seen: tuple[object, object] = None, None
        """Revision and status at the newest look at the state."""
        self._parameters = parameters
        self._known = dict(_values(parameters))
        self.folder = LogFolder(path.parent, self)
        """All logs in the log's folder."""
        self.stop_listening: Callable[[], None] = lambda: None
        """Unsubscribe from parameter changes."""
        self.writer = ulog_writer.UlogWriter(
            path,
            start_us,
            [logged.topic for logged in topics.TOPICS],
            (("sys_name", "airl-mav"), *described(parameters.release.flight_sw_version)),
            self._known.items(),
            on_lost,
        )

    def after_ticks(self, flown: Record, truths: Record, state: snapshot.AutopilotState) -> None:
        """Log the due topics of n ticks, from their logs and the final autopilot state."""
        if self.writer.lost or self.writer.closed:
            return
        status, end = state.status, self._count + len(flown)
        if end > BUFFERED or (self._state is not None and self._state.status is not status):
            self._log_ticks()
            end = len(flown)
        self._flown[self._count : end], self._truths[self._count : end] = flown, truths
        self._count, self._state = end, state
        revision, seen = state.revision, self._seen
        changed = status is not seen[1] or (revision is not None and revision is not seen[0])
        if changed or state.time_us >= self._poll_us:
            self._seen = revision, status
            # A state without a revision may have changed.
            self._log_state(state, changed=changed or revision is None)

    def text(self, message: autopilot_state.OperatorText, time_us: int) -> None:
        """Log an operator text."""
        if not self.writer.closed:
            self._log_ticks()
            self.writer.text(time_us, message.severity, message.text)

    def parameters_changed(self) -> None:
        """Log the parameters with changed values."""
        self._log_ticks()
        for name, value in _values(self._parameters):
            if self._known[name] != value:
                self._known[name] = value
                self.writer.parameter(name, value)

    def close(self) -> None:
        """Complete the log and rename it to the final name. Idempotent."""
        self.stop_listening()
        self.stop_listening = lambda: None
        if not self.writer.closed:
            self._log_ticks()
        self.writer.close()

    def discard(self) -> None:
        """Complete the log, and close all files open for downloads."""
        self.close()
        self.folder.close()

    def command(self, values: ulog_writer.Values, time_us: int) -> None:
        """Log a command of a client as vehicle_command."""
        if not self.writer.closed:
            number = next(i for i, each in enumerate(topics.TOPICS) if each.rows == "event")
            self.writer.sample(number, time_us, values)

    def _log_ticks(self) -> None:
        """Log the buffered ticks."""
        count, self._count = self._count, 0
        if count == 0 or self._state is None:
            return
        flown, truths = self._flown[:count], self._truths[:count]
        for number, logged in enumerate(topics.TOPICS):
            if logged.rows in ("flown", "truth"):
                due, true = (
                    each[each["time_us"] % logged.interval_us == 0] for each in (flown, truths)
                )
                self._log(number, topics.Moment(due, true, self._state, self._boot_unix_us))

    def _log_state(self, state: snapshot.AutopilotState, *, changed: bool) -> None:
        """Log the topics of the newest state that are due or have changed."""
        now_us, newest = state.time_us, slice(self._count - 1, self._count)
        moment = topics.Moment(self._flown[newest], self._truths[newest], state, self._boot_unix_us)
        self._poll_us = now_us + POLL_US
        for number, logged in enumerate(topics.TOPICS):
            due = now_us >= self._due_us[number]
            if logged.rows == "state" and (due or (changed and logged.changes)):
                self._log(number, moment, again=due and not logged.time)

    def _log(self, number: int, moment: topics.Moment, *, again: bool = True) -> None:
        """Log the messages of a topic; unless `again`, only if they differ from the last one."""
        logged = topics.TOPICS[number]
        rows = logged.messages(moment)
        if rows is None:
            return
        if logged.rows == "state":
            content = rows.tobytes()[0 if logged.time else ulog_writer.HEAD_BYTES :]
            if content == self._last.get(number) and not again:
                return
            self._last[number] = content
            self._due_us[number] = moment.state.time_us + logged.interval_us
        self.writer.samples(number, rows)


def _values(parameters: parameter_store.Parameters) -> Iterable[tuple[str, int | float]]:
    for index in range(len(parameters)):
        parameter = parameters.by_index(index)
        if parameter is not None:
            yield parameter.name, parameter.value


OPEN_FILES = 8
"""Maximum number of log files kept open for downloads, which read a few bytes per tick."""


class LogFolder(interfaces.LogStore):
    """Complete logs by name, then the open log; rescans changed folders."""

    def __init__(self, folder: Path, current: UlogFlightLog) -> None:
        """Set the folder and the log currently written in it."""
        self._folder = folder
        self._current = current
        self._complete: Sequence[Path] = ()
        self._scanned: tuple[int, bool] | None = None
        """Folder change time [ns] and closed flag of the log when `_complete` was scanned."""
        self._files: OrderedDict[Path, BinaryIO] = OrderedDict()
        """Open files; the most recently read file is last."""

    def entries(self) -> Sequence[interfaces.LogEntry]:
        """Return the logs; the log currently written is last."""
        entries = [_entry(path) for path in self._completed()]
        if not self._current.writer.closed:
            began_s = self._current.began_unix_us // constants.US_PER_S
            entries.append(interfaces.LogEntry(began_s, self._current.writer.size_bytes))
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

    def open_log(self) -> interfaces.OpenLog | None:
        """Return the log currently written; None = no open log."""
        log = self._current.writer
        if log.closed:
            return None
        return interfaces.OpenLog(len(self._completed()), log.head_bytes, log.size_bytes)

    def command(self, values: tuple[float, ...], time_us: int) -> None:
        """Log a command of a client."""
        self._current.command(values, time_us)

    def close(self) -> None:
        """Close all files open for downloads. Idempotent."""
        while self._files:
            self._files.popitem()[1].close()

    def _completed(self) -> Sequence[Path]:
        state = self._folder.stat().st_mtime_ns, self._current.writer.closed
        if state != self._scanned:
            self.close()
            self._scanned = state
            self._complete = sorted(self._folder.glob(f"*{interfaces.ULOG_SUFFIX}"))
        return self._complete

    def _opened(self, path: Path) -> BinaryIO:
        file = self._files.get(path)
        if file is None:
            if len(self._files) >= OPEN_FILES:
                self._files.popitem(last=False)[1].close()
            file = self._files[path] = path.open("rb", buffering=0)
        self._files.move_to_end(path)
        return file


def _entry(path: Path) -> interfaces.LogEntry:
    try:
        stat = path.stat()
    except OSError:
        return interfaces.LogEntry(0, 0)  # removed by another program
    return interfaces.LogEntry(int(stat.st_mtime), stat.st_size)


def open_flight_log(
    path: Path,
    port: autopilot.BuiltinAutopilot,
    start_us: int,
    boot_unix_us: int,
    on_lost: Callable[[str], None],
) -> UlogFlightLog:
    """Open the flight log of an autopilot, which offers it to clients; see `UlogFlightLog`."""
    log = UlogFlightLog(path, port.parameters, start_us, boot_unix_us, on_lost)
    log.stop_listening = port.parameters.on_change(log.parameters_changed)
    port.logs = log.folder
    return log

"""ULog flight log of one vehicle, and the folder of its logs."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, cast

from airl_mav.core import constants, frames
from firmware_sim import interfaces
from firmware_sim.addons.flight_log import topics, ulog_writer
from firmware_sim.autopilot import autopilot_state, parameter_store, snapshot
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.engine.dynamics import POSITION, QUATERNION, RATES, VELOCITY
from firmware_sim.engine.record import Record

# ruff: noqa: D102 (`AutopilotState` documents the properties of `FlownState`)


def truth_of(tick: Any) -> interfaces.TrueState:
    """Return the true state of a tick of an aircraft (`engine.record.TRUE_TICK`)."""
    row = tick["motion"].copy()
    power_w, charge = float(tick["power_w"]), float(tick["charge"])
    parts = row[POSITION], row[VELOCITY], row[QUATERNION], row[RATES]
    return interfaces.TrueState(int(tick["time_us"]), *parts, power_w, charge)


class FlownState:
    """Autopilot state of one tick, from the log of the tick. Implements `AutopilotState`.

    Status, home and parameters are not in the log: they are from the end of the ticks.
    """

    def __init__(self, state: snapshot.AutopilotState, tick: Any) -> None:
        """Combine the state after all ticks with one tick's log (`engine.record.FLOWN_TICK`)."""
        self._state, self._tick = state, tick

    def __getattr__(self, name: str) -> Any:
        return getattr(self._state, name)

    @property
    def time_us(self) -> int:
        return int(self._tick["time_us"])

    @property
    def estimate(self) -> autopilot_state.StateEstimate:
        row: frames.Vector = self._tick["state"].copy()
        return autopilot_state.StateEstimate(
            self.time_us,
            row[es.P : es.V],
            row[es.V : es.Q],
            row[es.ACCELERATION : es.SIGMA],
            row[es.Q : es.RATES],
            row[es.RATES : es.GYRO_BIAS],
            row[es.GYRO_BIAS : es.ACCEL_BIAS],
            row[es.ACCEL_BIAS : es.BARO_OFFSET],
            row[es.SIGMA : es.RATIO],
            row[es.RATIO :],
            bool(self._tick["healthy"]),
        )

    @property
    def setpoint(self) -> autopilot_state.Setpoint:
        return snapshot.setpoint_of(self._tick, self._output(7, 10))

    attitude_setpoint = property(lambda self: self._output(0, 4))
    rate_setpoint = property(lambda self: self._output(4, 7))
    thrust_setpoint = property(lambda self: self._tick["output"].item(10))
    accel = property(lambda self: self._tick["accel"].copy())
    gyro = property(lambda self: self._tick["gyro"].copy())
    mag = property(lambda self: self._tick["mag"].copy())
    pressure_hpa = property(lambda self: self._tick["pressure_hpa"].item())
    temperature_c = property(lambda self: self._tick["temperature_c"].item())
    motors = property(lambda self: tuple(self._tick["motors"].tolist()))
    battery = property(lambda self: interfaces.BatterySample(*self._tick["battery"].tolist()))

    def _output(self, first: int, end: int) -> frames.Vector:
        values: frames.Vector = self._tick["output"][first:end].copy()
        return values


GRID_US = 5 * constants.TICK_US
"""Interval of checks for due topics [µs]; all topic intervals are multiples of it."""

_DATA_FORMAT = 2
"""ver_data_format: selects the field names in Flight Review, the same for PX4 1.16 to 1.18."""


def described(flight_sw_version: int) -> tuple[tuple[str, str | int], ...]:
    """Return vehicle information by ULog key, in addition to the name."""
    return (
        ("ver_hw", "PX4_SITL"),
        ("ver_sw_release", flight_sw_version),
        ("ver_data_format", _DATA_FORMAT),
    )


_SAMPLES = 0
"""Number of `SENSOR_COMBINED` in the file, before the topics of `TOPICS` in order."""


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
        self._last: list[ulog_writer.Values | None] = [None] * len(topics.TOPICS)
        self._truth: Any = None
        """True state after the newest tick (`engine.record.TRUE_TICK`)."""
        self._parameters = parameters
        self._known = dict(_values(parameters))
        self.folder = LogFolder(path.parent, self)
        """All logs in the log's folder."""
        self.stop_listening: Callable[[], None] = lambda: None
        """Unsubscribe from parameter changes."""
        self.writer = ulog_writer.UlogWriter(
            path,
            start_us,
            (topics.SENSOR_COMBINED, *(logged.topic for logged in topics.TOPICS)),
            (("sys_name", "airl-mav"), *described(parameters.release.flight_sw_version)),
            self._known.items(),
            on_lost,
        )

    def after_ticks(self, flown: Record, truths: Record, state: snapshot.AutopilotState) -> None:
        """Log the due topics of n ticks, from their logs and the final autopilot state."""
        if self.writer.lost or self.writer.closed:
            return
        rows = (flown[name].tolist() for name in ("time_us", "gyro", "accel"))
        for k, (time_us, gyro, accel) in enumerate(zip(*rows, strict=True)):
            self.writer.sample(_SAMPLES, time_us, topics.sensor_combined(gyro, accel))
            truth = truths[k - 1] if k else self._truth
            if time_us % GRID_US == 0 and truth is not None:
                logged = cast(snapshot.AutopilotState, FlownState(state, flown[k]))
                moment = topics.Moment(logged, truth_of(truth), self._boot_unix_us + time_us)
                self._log(moment, time_us)
        self._truth = truths[-1].copy()

    def text(self, message: autopilot_state.OperatorText, time_us: int) -> None:
        """Log an operator text."""
        if not self.writer.closed:
            self.writer.text(time_us, message.severity, message.text)

    def parameters_changed(self) -> None:
        """Log the parameters with changed values."""
        for name, value in _values(self._parameters):
            if self._known[name] != value:
                self._known[name] = value
                self.writer.parameter(name, value)

    def close(self) -> None:
        """Complete the log and rename it to the final name. Idempotent."""
        self.stop_listening()
        self.stop_listening = lambda: None
        self.writer.close()

    def discard(self) -> None:
        """Complete the log, and close all files open for downloads."""
        self.close()
        self.folder.close()

    def _log(self, moment: topics.Moment, now_us: int) -> None:
        due_us, last = self._due_us, self._last
        for i, logged in enumerate(topics.TOPICS):
            due = now_us >= due_us[i]
            if not due and not logged.on_change:
                continue
            values = logged.values(moment)
            if values is None or (not due and values == last[i]):
                continue
            last[i] = values
            due_us[i] = now_us + logged.interval_us
            self.writer.sample(1 + i, now_us, values)


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
    autopilot: BuiltinAutopilot,
    start_us: int,
    boot_unix_us: int,
    on_lost: Callable[[str], None],
) -> UlogFlightLog:
    """Open the flight log of an autopilot, which offers it to clients; see `UlogFlightLog`."""
    log = UlogFlightLog(path, autopilot.parameters, start_us, boot_unix_us, on_lost)
    log.stop_listening = autopilot.parameters.on_change(log.parameters_changed)
    autopilot.logs = log.folder
    return log

"""Record of a batch twin's flight: its path at 50 Hz and the stamps of its decisions.

The files are those of a rehearsal (docs/run-folder.md), so that one report serves all levels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S, CommandKind
from airl_mav.envs.fleet import Fleet, Verdict
from airl_mav.flight.trajectory import SAMPLE_US, Trajectory
from airl_mav.latency.stamps import NO_STAMP, SETPOINTS

STATE = 12
"""Columns of a sample: time [µs], position, velocity, quaternion, mean power. Whole microseconds
are exact in a float64 for centuries."""

STAMPS = (
    "capture_us",
    "decoded_us",
    "infer_start_us",
    "action_ready_us",
    "sent_us",
    "motor_us",
    "held_until_us",
)
"""Stamps of a decision, as in `latency.npz`; link and control are one here, so nothing says when
the autopilot accepted the setpoint."""


class _Tables:
    """A growing table for each of n slots."""

    def __init__(self, n: int, width: int, dtype: type[np.generic]) -> None:
        self._rows: NDArray[Any] = np.zeros((n, 256, width), dtype)
        self._count = np.zeros(n, np.int64)

    def clear(self, i: int) -> None:
        """Forget the rows of a slot."""
        self._count[i] = 0

    def append(self, who: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Add one row to each slot of `who` (k,); values (k, width)."""
        at = self._count[who]
        if at.size and at.max() == self._rows.shape[1]:
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)], axis=1)
        self._rows[who, at] = values
        self._count[who] += 1

    def of(self, i: int) -> NDArray[Any]:
        """Return a copy of the rows of a slot."""
        rows: NDArray[Any] = self._rows[i, : self._count[i]].copy()
        return rows


class Trace:
    """Records n flights; a slot's record lasts until its next flight begins."""

    def __init__(self, n: int, commands: CommandKind = "velocity") -> None:
        """Record n flights of policies that command a velocity, or what else `commands` says."""
        self._column = SETPOINTS[commands]
        self._samples = _Tables(n, STATE, np.float64)
        self._stamps = _Tables(n, len(STAMPS), np.int64)
        self._setpoints = _Tables(n, 4, np.float32)
        self._sampled_us = np.zeros(n, np.int64)
        self._sampled_j = np.zeros(n)
        self._deciding = self._started_us = np.zeros(0, np.int64)
        self.seen_us = np.zeros(n, np.int64)
        """(n,) when the frames were taken that are being decided on [µs]."""

    def begin(self, i: int, fleet: Fleet) -> None:
        """Begin the record of slot i, whose vehicle is at the start."""
        for tables in (self._samples, self._stamps, self._setpoints):
            tables.clear(i)
        self._take(fleet, np.array([i]))

    def next_us(self, fleet: Fleet) -> NDArray[np.int64]:
        """Return when the next samples are due (n,) [µs]."""
        return (fleet.time_us // SAMPLE_US + 1) * SAMPLE_US

    def sample(self, fleet: Fleet) -> None:
        """Sample the flights that have come to the time of a sample, or to their end."""
        # A flight's last moment is kept wherever it falls, as `TrajectoryRecorder` does.
        due = (fleet.time_us % SAMPLE_US == 0) | (fleet.verdict != Verdict.FLYING)
        self._take(fleet, np.flatnonzero(due & (fleet.time_us > self._sampled_us)))

    def _take(self, fleet: Fleet, who: NDArray[np.int64]) -> None:
        """Sample the vehicles of `who` (k,)."""
        now = fleet.time_us[who]
        first = now == 0
        passed_s = np.where(first, 1.0, (now - self._sampled_us[who]) / US_PER_S)
        mean_w = np.where(first, 0.0, (fleet.energy[who] - self._sampled_j[who]) / passed_s)
        state = [fleet.position[who], fleet.velocity[who], fleet.quaternion[who]]
        self._samples.append(who, np.column_stack([now, *state, mean_w]))
        self._sampled_us[who], self._sampled_j[who] = now, fleet.energy[who]

    def deciding(self, fleet: Fleet, seen_us: NDArray[np.int64]) -> None:
        """Note that every flight that goes on begins a decision, on a frame of that time (n,)."""
        self._deciding = np.flatnonzero(fleet.verdict == Verdict.FLYING)
        self._started_us, self.seen_us = fleet.time_us.copy(), seen_us.copy()

    def decided(
        self,
        fleet: Fleet,
        setpoint: NDArray[np.float64],
        t2_us: NDArray[np.int64],
        transport_us: NDArray[np.int64],
        link_us: NDArray[np.int64],
    ) -> None:
        """Note the decision that `deciding` began, once it has been flown.

        Args:
            fleet: As it is when the next decision begins.
            setpoint: (n, 4) what was decided, as `Fleet.setpoint`.
            t2_us: (n,) inference as modelled, before it was rounded to ticks [µs].
            transport_us: (n,) capture to decoded [µs].
            link_us: (n,) setpoint sent to first motor command [µs].
        """
        who = self._deciding
        capture, start, end = self.seen_us[who], self._started_us[who], fleet.time_us[who]
        # The frame of the start is there at once.
        decoded = np.minimum(capture + transport_us[who], start)
        sent = start + t2_us[who]
        rows = np.column_stack([capture, decoded, start, sent, sent, sent + link_us[who], end])
        # What lies behind the end of the flight never came; nor does a hold without its action.
        rows[rows > end[:, None]] = NO_STAMP
        rows[sent > end, -1] = NO_STAMP
        self._stamps.append(who, rows)
        self._setpoints.append(who, setpoint[who])

    def trajectory(self, i: int) -> Trajectory:
        """Return the path of slot i: a row at the start, every 20 ms, and at the end.

        No power flows before the first row: it has that of the second.
        """
        rows = self._samples.of(i)
        if len(rows) > 1:
            rows[0, 11] = rows[1, 11]
        return Trajectory(
            rows[:, 0].astype(np.int64), rows[:, 1:4], rows[:, 4:7], rows[:, 7:11], rows[:, 11]
        )

    def latency(self, i: int) -> dict[str, NDArray[Any]]:
        """Return the decisions of slot i by column: `STAMPS` (k,) [µs] and setpoints (k, 4)."""
        stamps = self._stamps.of(i)
        columns = {name: stamps[:, k].copy() for k, name in enumerate(STAMPS)}
        return {**columns, self._column: self._setpoints.of(i)}

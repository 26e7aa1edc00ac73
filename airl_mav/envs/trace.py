"""Record of a batch twin's flight: its path at 50 Hz and the timestamps of its decisions.

The files have the format of a rehearsal (docs/run-folder.md), so all levels use the same report.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S, CommandKind
from airl_mav.envs.fleet import Fleet, FlightStatus
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
"""Timestamps of a decision, as in `latency.npz`; link and control are combined, so the time of
acceptance by the autopilot is missing."""


class _Tables:
    """Growing table for each of n slots."""

    def __init__(self, n: int, width: int, dtype: type[np.generic]) -> None:
        self._rows: NDArray[Any] = np.zeros((n, 256, width), dtype)
        self._count = np.zeros(n, np.int64)

    def clear(self, i: int) -> None:
        """Delete the rows of a slot."""
        self._count[i] = 0

    def append(self, who: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Add one row to each slot of `who` (k,); values (k, width)."""
        at = self._count[who]
        if at.size and at.max() == self._rows.shape[1]:
            # Doubling keeps the cost of growth constant per row.
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)], axis=1)
        self._rows[who, at] = values
        self._count[who] += 1

    def of(self, i: int) -> NDArray[Any]:
        """Return a copy of the rows of a slot."""
        rows: NDArray[Any] = self._rows[i, : self._count[i]].copy()
        return rows


class Trace:
    """Recorder of n flights; a slot's record is kept until its next flight starts."""

    def __init__(self, n: int, commands: CommandKind = "velocity") -> None:
        """Create a recorder for policies with a command type, by default velocity."""
        self._column = SETPOINTS[commands]
        self._samples = _Tables(n, STATE, np.float64)
        self._stamps = _Tables(n, len(STAMPS), np.int64)
        self._setpoints = _Tables(n, 4, np.float32)
        self._sampled_us = np.zeros(n, np.int64)
        self._sampled_j = np.zeros(n)
        self._deciding = self._started_us = np.zeros(0, np.int64)
        self.seen_us = np.zeros(n, np.int64)
        """(n,) capture times of the frames of the present decisions [µs]."""

    def begin(self, i: int, fleet: Fleet) -> None:
        """Start the record of slot i, with its vehicle at the start."""
        for tables in (self._samples, self._stamps, self._setpoints):
            tables.clear(i)
        self._take(fleet, np.array([i]))

    def next_us(self, fleet: Fleet) -> NDArray[np.int64]:
        """Return the times of the next samples (n,) [µs]."""
        return (fleet.time_us // SAMPLE_US + 1) * SAMPLE_US

    def sample(self, fleet: Fleet) -> None:
        """Sample the flights that are at a sampling time, or at their end."""
        # The final state is always recorded, as in `TrajectoryRecorder`.
        due = (fleet.time_us % SAMPLE_US == 0) | (fleet.verdict != FlightStatus.FLYING)
        self._take(fleet, np.flatnonzero(due & (fleet.time_us > self._sampled_us)))

    def _take(self, fleet: Fleet, who: NDArray[np.int64]) -> None:
        """Sample the vehicles of `who` (k,)."""
        now = fleet.time_us[who]
        first = now == 0
        # The first sample has no interval; 1 s avoids a division by zero.
        passed_s = np.where(first, 1.0, (now - self._sampled_us[who]) / US_PER_S)
        mean_w = np.where(first, 0.0, (fleet.energy[who] - self._sampled_j[who]) / passed_s)
        state = [fleet.position[who], fleet.velocity[who], fleet.quaternion[who]]
        self._samples.append(who, np.column_stack([now, *state, mean_w]))
        self._sampled_us[who], self._sampled_j[who] = now, fleet.energy[who]

    def deciding(self, fleet: Fleet, seen_us: NDArray[np.int64]) -> None:
        """Start a decision of every active flight, on a frame captured at `seen_us` (n,)."""
        self._deciding = np.flatnonzero(fleet.verdict == FlightStatus.FLYING)
        self._started_us, self.seen_us = fleet.time_us.copy(), seen_us.copy()

    def decided(
        self,
        fleet: Fleet,
        setpoint: NDArray[np.float64],
        t2_us: NDArray[np.int64],
        transport_us: NDArray[np.int64],
        link_us: NDArray[np.int64],
    ) -> None:
        """Record the decision that `deciding` started, after its completion.

        Args:
            fleet: State at the start of the next decision.
            setpoint: (n, 4) result of the decision, as `Fleet.setpoint`.
            t2_us: (n,) inference as modelled, before rounding to ticks [µs].
            transport_us: (n,) capture to decoded frame [µs].
            link_us: (n,) setpoint sent to first motor command [µs].
        """
        who = self._deciding
        capture, start, end = self.seen_us[who], self._started_us[who], fleet.time_us[who]
        # The first frame of a flight is available at once.
        decoded = np.minimum(capture + transport_us[who], start)
        sent = start + t2_us[who]
        rows = np.column_stack([capture, decoded, start, sent, sent, sent + link_us[who], end])
        # Clear events after the end of the flight, and holds of unsent actions.
        rows[rows > end[:, None]] = NO_STAMP
        rows[sent > end, -1] = NO_STAMP
        self._stamps.append(who, rows)
        self._setpoints.append(who, setpoint[who])

    def trajectory(self, i: int) -> Trajectory:
        """Return the path of slot i: a row at the start, every 20 ms, and at the end.

        The first row has no preceding interval; its mean power is copied from the second row.
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

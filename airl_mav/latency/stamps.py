"""Decision log: one row of stamps per decision. numpy and the standard library only.

Raw integers go into one preallocated block. Everything else is computed after the flight. Recording
costs about 0.3 µs on a desktop core.
"""

from __future__ import annotations

import struct
from collections.abc import Container, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import CommandKind

NO_STAMP = -1
"""Missing time: no frame, or a setpoint that was not accepted."""

STAMPS = (
    "capture_us",
    "decoded_us",
    "infer_start_us",
    "action_ready_us",
    "sent_us",
    "held_until_us",
)
"""Columns of simulated time [µs], in chronological order."""

SETPOINT, ATTITUDE, RATES = "setpoint", "attitude_setpoint", "rates_setpoint"
SETPOINTS: Mapping[CommandKind, str] = MappingProxyType(
    {"velocity": SETPOINT, "attitude": ATTITUDE, "body_rates": RATES}
)
"""Column of the setpoints by command kind, so that kinds cannot be confused."""

ROW = np.dtype([(name, "<i8") for name in STAMPS] + [("setpoint", "<f4", (4,))])
"""One decision, 64 bytes: the stamps, then the setpoint as the link sends it (float32)."""

_PACK = struct.Struct("<6q4f")


class DecisionLog:
    """Stamps of every decision of one episode. One writer; readers get copies."""

    __slots__ = ("_block", "_bytes", "_count", "_setpoints")

    def __init__(self, capacity: int = 4096, *, commands: CommandKind = "velocity") -> None:
        """Reserve space for `capacity` (>= 1) decisions; it doubles when full."""
        if capacity < 1:
            raise ValueError(f"capacity={capacity}: must be >= 1")
        self._setpoints = SETPOINTS[commands]
        self._block = np.zeros(capacity * ROW.itemsize, np.uint8)
        self._bytes = self._block.data
        self._count = 0

    def __len__(self) -> int:
        """Return the number of decisions recorded."""
        return self._count

    def record(
        self,
        capture_us: int,
        decoded_us: int,
        infer_start_us: int,
        action_ready_us: int,
        sent_us: int,
        held_until_us: int,
        setpoint: tuple[float, float, float, float],
    ) -> None:
        """Append one decision. Times in simulated µs, `NO_STAMP` if missing.

        The setpoint contains the four numbers that the autopilot receives, as `SETPOINTS` names
        them.
        """
        offset = self._count * ROW.itemsize
        if offset == len(self._bytes):
            self._grow()
        _PACK.pack_into(
            self._bytes,
            offset,
            capture_us,
            decoded_us,
            infer_start_us,
            action_ready_us,
            sent_us,
            held_until_us,
            *setpoint,
        )
        self._count += 1

    def _grow(self) -> None:
        """Double the block: amortised, a record stays O(1)."""
        self._block = np.concatenate([self._block, np.zeros_like(self._block)])
        self._bytes = self._block.data

    def columns(self) -> dict[str, NDArray[np.int64] | NDArray[np.float32]]:
        """Return a copy of each column by name: stamps int64 (n,), setpoints float32 (n, 4)."""
        count = self._count
        rows = self._block[: count * ROW.itemsize].view(ROW)
        return {name: rows[name].copy() for name in STAMPS} | {
            self._setpoints: rows["setpoint"].copy()
        }


def setpoint_column(columns: Container[str]) -> str | None:
    """Return the name of the setpoint column; None if missing."""
    return next((name for name in SETPOINTS.values() if name in columns), None)


def commanded(columns: Container[str]) -> CommandKind:
    """Return the kind of the setpoints; velocity if missing."""
    return next((kind for kind, name in SETPOINTS.items() if name in columns), "velocity")

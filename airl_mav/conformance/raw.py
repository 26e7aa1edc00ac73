"""A stream of raw setpoints that can be stopped while heartbeats go on, which MAVSDK's cannot."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from airl_mav.conformance.session import Session
from airl_mav.conformance.words import LOCAL_NED
from airl_mav.core.constants import US_PER_S
from companion.interfaces import LinkError

PERIOD_S = 0.05
"""As MAVSDK repeats its setpoints, 20 Hz [s]."""

# SET_POSITION_TARGET_LOCAL_NED.type_mask: a bit says what to ignore.
VELOCITY_AND_YAW = 0x9C7
VELOCITY = 0xDC7
VELOCITY_FORCE_BIT = 0xFC7
IGNORE_ALL = 0xDFF


class RawSetpoint(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED; None is NaN."""

    frame: int = LOCAL_NED
    mask: int = VELOCITY_AND_YAW
    vx: float | None = 0.0
    vy: float | None = 0.0
    vz: float | None = 0.0
    yaw_rad: float = 0.0


class RawStream:
    """Sends the newest setpoint 20 times a second, by the session's clock."""

    def __init__(self, session: Session, setpoint: RawSetpoint) -> None:
        self._session, self._setpoint = session, setpoint
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="setpoints", daemon=True)
        self._thread.start()

    def fly(self, setpoint: RawSetpoint) -> None:
        """Send another setpoint from now on."""
        self._setpoint = setpoint
        self._send()

    def stop(self) -> None:
        """Stop sending; nothing is sent after it returns."""
        self._stop.set()
        self._thread.join()

    def _send(self) -> None:
        frame, mask, vx, vy, vz, yaw_rad = self._setpoint
        zeros = dict.fromkeys(("x", "y", "z", "afx", "afy", "afz", "yaw_rate"), 0.0)
        self._session.send(
            "SET_POSITION_TARGET_LOCAL_NED",
            {
                "time_boot_ms": 0,
                "coordinate_frame": frame,
                "type_mask": mask,
                **zeros,
                "vx": vx,
                "vy": vy,
                "vz": vz,
                "yaw": yaw_rad,
            },
        )

    def _run(self) -> None:
        clock = self._session.clock
        due_us = clock.time_us()
        while not self._stop.is_set():
            try:
                self._send()
            except LinkError:
                return  # The flight finds out by its silence.
            # What was missed is not made up for in a burst.
            due_us = max(due_us + int(PERIOD_S * US_PER_S), clock.time_us())
            clock.sleep_until(due_us, self._stop)


@contextmanager
def raw_stream(session: Session, setpoint: RawSetpoint) -> Iterator[RawStream]:
    """Stream raw setpoints for as long as the context lasts, at the latest."""
    stream = RawStream(session, setpoint)
    try:
        yield stream
    finally:
        stream.stop()

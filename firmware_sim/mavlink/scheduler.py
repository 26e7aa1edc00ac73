"""Streams of a link: PX4's default rates, and when each is due, in integer µs of simulated time.

The rates are measured on a real PX4 1.16 SITL. Messages that PX4 sends and we do not are left out:
EVENT and CURRENT_EVENT_SEQUENCE, LINK_NODE_STATUS (its counts depend on when clients speak, and a
flight's telemetry must not), OPEN_DRONE_ID_*. The tables' order is the order on the wire when
several messages are due in the same tick.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from airl_mav.core.constants import TICK_US, US_PER_S

ONBOARD_HZ: Mapping[str, float] = MappingProxyType(
    {
        "HEARTBEAT": 1.0,
        "TIMESYNC": 10.0,
        "ATTITUDE": 100.0,
        "ATTITUDE_QUATERNION": 50.0,
        "LOCAL_POSITION_NED": 30.0,
        "ODOMETRY": 30.0,
        "GLOBAL_POSITION_INT": 50.0,
        "HIGHRES_IMU": 50.0,
        "ALTITUDE": 10.0,
        "ATTITUDE_TARGET": 10.0,
        "POSITION_TARGET_LOCAL_NED": 10.0,
        "POSITION_TARGET_GLOBAL_INT": 10.0,
        "SERVO_OUTPUT_RAW": 10.0,
        "VFR_HUD": 10.0,
        "GPS_RAW_INT": 10.0,
        "EXTENDED_SYS_STATE": 5.0,
        "SYS_STATUS": 5.0,
        "ESTIMATOR_STATUS": 1.0,
        "PING": 1.0,
        "SCALED_PRESSURE": 1.0,
        "SYSTEM_TIME": 1.0,
        "MISSION_CURRENT": 1.0,
        "BATTERY_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "VIBRATION": 0.5,
        "CURRENT_MODE": 0.5,
        "TIME_ESTIMATE_TO_TARGET": 0.5,
        "ORBIT_EXECUTION_STATUS": 5.0,
        "ESC_INFO": 10.0,
        "ESC_STATUS": 10.0,
        "RC_CHANNELS": 20.0,
        "DISTANCE_SENSOR": 10.0,
        "OPTICAL_FLOW_RAD": 10.0,
    }
)
"""Onboard (API) link, 14580 -> 14540 [Hz]."""

GCS_HZ: Mapping[str, float] = MappingProxyType(
    {
        "HEARTBEAT": 1.0,
        "ATTITUDE": 50.0,
        "ATTITUDE_QUATERNION": 50.0,
        "LOCAL_POSITION_NED": 50.0,
        "GLOBAL_POSITION_INT": 50.0,
        "ATTITUDE_TARGET": 50.0,
        "POSITION_TARGET_LOCAL_NED": 50.0,
        "POSITION_TARGET_GLOBAL_INT": 1.0,
        "SERVO_OUTPUT_RAW": 50.0,
        "GPS_RAW_INT": 5.0,
        "VFR_HUD": 4.0,
        "ALTITUDE": 1.0,
        "EXTENDED_SYS_STATE": 1.0,
        "SCALED_PRESSURE": 1.0,
        "SYS_STATUS": 1.0,
        "MISSION_CURRENT": 1.0,
        "BATTERY_STATUS": 0.5,
        "ESTIMATOR_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "PING": 0.1,
        "VIBRATION": 0.1,
        "CURRENT_MODE": 0.5,
        "TIME_ESTIMATE_TO_TARGET": 0.5,
        "ORBIT_EXECUTION_STATUS": 5.0,
        "ESC_INFO": 1.0,
        "ESC_STATUS": 1.0,
        "RC_CHANNELS": 5.0,
        "DISTANCE_SENSOR": 0.5,
        "OPTICAL_FLOW_RAD": 1.0,
    }
)
"""Ground station link, 18570 -> 14550 [Hz]."""


PAYLOAD_RATE = 0.1432
"""PX4 gives the payload link 4,000 bytes a second, and slows its streams down to fit. Measured."""

PAYLOAD_HZ: Mapping[str, float] = MappingProxyType(
    {
        name: hz if name in ("HEARTBEAT", "PING", "MISSION_CURRENT", "GPS_RAW_INT") else slowed
        for name, hz, slowed in ((name, hz, hz * PAYLOAD_RATE) for name, hz in ONBOARD_HZ.items())
    }
)
"""Payload link, 14280 -> 14030 [Hz]: PX4's onboard mode, slower."""

GIMBAL_HZ: Mapping[str, float] = MappingProxyType(
    {"HEARTBEAT": 1.0, "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE": 20.0, "MISSION_CURRENT": 1.0}
)
"""Gimbal link, 13030 -> 13280 [Hz]."""


def interval_us(rate_hz: float) -> int:
    """Return the interval of a rate [µs]; 0 Hz gives 0 (off)."""
    return round(US_PER_S / rate_hz) if rate_hz > 0.0 else 0


OFF = 0
"""Interval of a stream that is not sent."""

_NEVER = np.iinfo(np.int64).max
_NONE: Mapping[str, int] = MappingProxyType({})


class StreamScheduler:
    """Intervals and due times of one link's streams.

    A stream keeps its phase: the next due time is the last one plus the interval, not the time it
    was sent, so rates are exact over any span. First due times are staggered by one tick each, so
    that the slow streams do not all fall into the same tick. A stream is due at most once per
    call; one that fell behind skips what it missed.

    Fast streams are packed by compiled code (`telemetry`), which takes the arrays; `due` names the
    others.
    """

    def __init__(
        self,
        names: Sequence[str],
        default_us: Mapping[str, int],
        fast: Mapping[str, int] = _NONE,
        every_us: int = 0,
    ) -> None:
        """Start at simulated time 0 with the default intervals [µs].

        Args:
            names: All streams, in their order within a tick.
            default_us: Their intervals; one without a default is off.
            fast: Places of the fast streams in the table of compiled code.
            every_us: Grid of the others, from the first tick on [µs]; 0 = any tick.
        """
        self._every_us = every_us or 1
        self._names = tuple(names)
        self._index = {name: i for i, name in enumerate(self._names)}
        self._default = [default_us.get(name, OFF) for name in self._names]
        self.numbers = np.array([fast.get(name, -1) for name in self._names], np.int64)
        """(s,) places of the fast streams in the table; -1 = not a fast stream."""
        self.intervals_us = np.array(self._default, np.int64)
        """(s,) intervals [µs]; `OFF` = not sent."""
        self.due_us = np.zeros(len(self._names), np.int64)
        """(s,) next times of the fast streams [µs]."""
        self._slow_due_us: dict[int, int] = {}
        """Next times of the other streams that are sent [µs], by their place."""
        self.fast_us = 0
        """When the next of the fast streams is due, or earlier [µs]."""
        self._next_us = 0
        """When the next of the others is due [µs]."""
        self.quiet: set[str] = set()
        """Slow streams that had nothing to send when they were due: no sensor, no radio."""
        self.wake_us = 0
        """The earlier of the two [µs]: before, there is nothing to do."""
        self._rebase_pending = False
        self._rebase(0)

    def interval_us(self, name: str) -> int:
        """Return a stream's interval [µs], `OFF` when it is not sent."""
        return self.intervals_us.item(self._index[name])

    def default_us(self, name: str) -> int:
        """Return a stream's default interval [µs], `OFF` when it is off by default."""
        return self._default[self._index[name]]

    def set_interval(self, name: str, interval_us: int, now_us: int) -> None:
        """Send a stream every `interval_us` [µs] from `now_us` on, or stop it (`OFF`)."""
        if interval_us < 0:
            raise ValueError(f"interval_us={interval_us}: must be >= 0")
        index = self._index[name]
        if interval_us == self.intervals_us[index]:
            return
        self.intervals_us[index] = interval_us
        self._plan(index, now_us)
        self.wake_us = self._next_us = self.fast_us = min(self.wake_us, now_us)

    def restart(self) -> None:
        """Keep the intervals, take the time base from the next call (it may have jumped)."""
        self._rebase_pending = True
        self.wake_us = 0

    def packed(self, next_us: int) -> None:
        """Take note that fast streams were packed. The next of them is due at `next_us` [µs]."""
        self.fast_us = next_us
        self.wake_us = min(next_us, self._next_us)

    def next_slow_us(self, now_us: int) -> float:
        """Return when slow streams are sent next, at or after `now_us` [µs], but for quiet ones."""
        if self._rebase_pending:
            return now_us
        names, quiet = self._names, self.quiet
        due = [due_us for i, due_us in self._slow_due_us.items() if names[i] not in quiet]
        return self.grid_us(max(now_us, min(due, default=_NEVER)))

    def grid_us(self, time_us: int) -> int:
        """Return the first time of the grid at or after another time [µs]."""
        return TICK_US - (TICK_US - time_us) // self._every_us * self._every_us

    def is_time(self, now_us: int) -> bool:
        """Return whether slow streams may be sent at `now_us` [µs]."""
        return (now_us - TICK_US) % self._every_us == 0

    def due(self, now_us: int) -> list[str]:
        """Return the streams to send at `now_us` [µs] and plan their next time."""
        begins = self._rebase_pending  # the first heartbeat does not wait
        if begins:
            self._rebase(now_us)
        if now_us < self._next_us or not (begins or self.is_time(now_us)):
            return []
        plan, names = self._slow_due_us, []
        for due_us, i in sorted([(due_us, i) for i, due_us in plan.items() if due_us <= now_us]):
            interval_us = self.intervals_us.item(i)
            plan[i] = due_us + interval_us * (1 + (now_us - due_us) // interval_us)
            names.append(self._names[i])
        self._next_us = min(plan.values(), default=_NEVER)
        self.wake_us = min(self.fast_us, self._next_us)
        return names

    def _plan(self, index: int, due_us: int) -> None:
        """Plan the next time of a stream that is sent, or forget one that is not."""
        sent = self.intervals_us.item(index) != OFF
        if self.numbers.item(index) >= 0:
            self.due_us[index] = due_us if sent else _NEVER
        elif sent:
            self._slow_due_us[index] = due_us
        else:
            self._slow_due_us.pop(index, None)

    def _rebase(self, now_us: int) -> None:
        self._rebase_pending = False
        if self._every_us > 1:
            now_us = TICK_US + (now_us - TICK_US - 1) // self._every_us * self._every_us
        for i, interval_us in enumerate(self.intervals_us.tolist()):
            self._plan(i, now_us if interval_us == OFF else now_us + i * TICK_US % interval_us)
        self.wake_us = self._next_us = self.fast_us = now_us

"""Limits on received MAVLink data: frames per client, time per tick, and operator warnings.

Too much MAVLink processing delays a tick. The idle time before the next tick delays nothing, so the
limit there is higher.
"""

from __future__ import annotations

from airl_mav.core.clock import Clock
from airl_mav.core.constants import TICK_US, US_PER_S
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity

FRAMES_PER_S = 2_000
"""Sustained frame rate of one client [1/s]: eight times the rate of a setpoint per tick."""

BURST_FRAMES = 500
"""Maximum burst of one client [frames]: a ground station requests up to 500 parameters at once."""


class Allowance:
    """Generic cell rate algorithm (ITU-T I.371) in integer microseconds of simulated time.

    Counts frames and reads no clock: the result depends only on frames and their simulated times.
    """

    def __init__(self, per_s: int = FRAMES_PER_S, burst: int = BURST_FRAMES) -> None:
        """Allow a sustained rate of `per_s` frames per second, and bursts of `burst` frames."""
        self._each_us = US_PER_S // per_s
        self._ahead_us = self._each_us * burst
        self._until_us = 0
        """Simulated time at which the counted frames no longer limit the rate [µs]."""

    def left(self, now_us: int) -> bool:
        """Return True if another frame is allowed at simulated `now_us` [µs]."""
        return self._until_us - now_us < self._ahead_us

    def take(self, frames: int, now_us: int) -> None:
        """Count frames received at simulated `now_us` [µs]."""
        self._until_us = max(self._until_us, now_us) + self._each_us * frames

    def renew(self) -> None:
        """Reset the counted frames, because simulated time may restart."""
        self._until_us = 0


LISTEN_US = TICK_US // 8
"""Maximum time per tick for received data of one link [µs of the pacing clock]. The rest waits for
the next tick."""

IDLE_LISTEN_US = TICK_US // 4
"""Maximum additional time for received data of all links while the simulator is idle before the
next tick [µs of the pacing clock]. During a flood the companion, on the same host, needs part of
the processor."""

BULK_RESERVE_US = TICK_US // 8
"""Time before the next tick at which bulk transfers stop, to read received data [µs of the pacing
clock]."""


class TickTime:
    """Time before the next tick, common to all links."""

    def __init__(self, clock: Clock | None) -> None:
        """Store the pacing clock; None = no pacing, so time is unlimited."""
        self.clock = clock
        self.next_us = 0
        """Simulated time at which the next tick starts [µs]."""
        self.idle_us = IDLE_LISTEN_US
        """Remaining idle time for received data before the next tick [µs]."""

    def renew(self, next_us: int) -> None:
        """Start the time budget that ends with the tick at simulated `next_us` [µs]."""
        self.next_us = next_us
        self.idle_us = IDLE_LISTEN_US

    def is_short(self) -> bool:
        """Return True if bulk transfers must wait because the next tick is near."""
        return self.clock is not None and self.clock.time_us() > self.next_us - BULK_RESERVE_US


class ListeningTime:
    """Time budget per tick for the received data of one link."""

    def __init__(self, tick: TickTime) -> None:
        self._tick = tick
        self._tick_us = tick.next_us
        self._left_us = LISTEN_US
        self._looked_us = 0

    def renew(self) -> None:
        """Reset the budget for a new tick."""
        self._left_us = LISTEN_US

    def begin(self) -> bool:
        """Start reading, with a new budget in a new tick; return True if time is limited."""
        tick = self._tick
        # Without a clock only the number of messages is limited.
        if tick.clock is None:
            return False
        # `begin` runs several times per tick; the budget renews once per tick.
        if self._tick_us != tick.next_us:
            self._tick_us, self._left_us = tick.next_us, LISTEN_US
        self._looked_us = tick.clock.time_us()
        return True

    def left(self) -> bool:
        """Charge the time since the last call; return True if time remains."""
        tick = self._tick
        if tick.clock is None:
            return True
        now_us = tick.clock.time_us()
        spent_us, self._looked_us = now_us - self._looked_us, now_us
        # Idle time is charged first: it delays no tick.
        idle = now_us < tick.next_us
        if idle and tick.idle_us > 0:
            tick.idle_us -= spent_us
        else:
            self._left_us -= spent_us
        return self._left_us > 0 or (idle and tick.idle_us > 0)


EVERY_US = 10 * US_PER_S
"""Minimum interval between two warnings of one type [µs]."""


class Complaints:
    """Operator warnings about rejected and dropped data, at a limited rate."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], tuple[int, int]] = {}
        """Last warning by link and type: time [µs], counter value."""

    def restart(self) -> None:
        """Restart the intervals, because simulated time may restart. Keeps reported counts."""
        self._told = {key: (-EVERY_US, count) for key, (_, count) in self._told.items()}

    def due(self, name: str, refused: int, dropped: int, now_us: int) -> list[OperatorText]:
        """Return the warnings due on a link at `now_us` [µs] about rejected and dropped data."""
        texts: list[OperatorText] = []
        for kind, count, problem in (
            ("refused", refused, "frames refused: bad signature"),
            ("dropped", dropped, "datagrams dropped: flood or full"),
        ):
            # The first warning is due at once.
            told_us, told = self._told.get((name, kind), (-EVERY_US, 0))
            if count > told and now_us - told_us >= EVERY_US:
                self._told[name, kind] = now_us, count
                texts.append(OperatorText(Severity.WARNING, f"{name}: {count - told} {problem}"))
        return texts

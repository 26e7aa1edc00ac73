"""Limits on received MAVLink: frames per client, time per tick, and the warnings to operators.

A tick is late where MAVLink takes too long. In the time that is left before the next tick it makes
nothing late, so there is more room for it there.
"""

from __future__ import annotations

from airl_mav.core.clock import Clock
from airl_mav.core.constants import TICK_US, US_PER_S
from firmware_sim.autopilot.autopilot_state import Message, Severity

FRAMES_PER_S = 2_000
"""Frames that one client may send for long: eight times what a setpoint in every tick takes."""

BURST_FRAMES = 500
"""Frames that it may send at once: a ground station asks for that many parameters."""


class Allowance:
    """A generic cell rate algorithm (ITU-T I.371) in integer microseconds of simulated time.

    It counts, and reads no clock, so the same frames at the same simulated times are always
    treated alike.
    """

    def __init__(self, per_s: int = FRAMES_PER_S, burst: int = BURST_FRAMES) -> None:
        """Allow `per_s` frames a second for long, and `burst` at once."""
        self._each_us = US_PER_S // per_s
        self._ahead_us = self._each_us * burst
        self._until_us = 0
        """When everything that was taken is paid for."""

    def left(self, now_us: int) -> bool:
        """Return whether another frame is allowed at simulated `now_us` [µs]."""
        return self._until_us - now_us < self._ahead_us

    def take(self, frames: int, now_us: int) -> None:
        """Count frames that came at simulated `now_us` [µs]."""
        self._until_us = max(self._until_us, now_us) + self._each_us * frames

    def renew(self) -> None:
        """Forget what was taken: simulated time may start anew."""
        self._until_us = 0


LISTEN_US = TICK_US // 8
"""Longest time of a tick that goes into what arrives on one link [µs of the pacing clock]. What is
left waits for the next tick."""

IDLE_LISTEN_US = TICK_US // 4
"""Longest time that goes, beside that, into what arrives on all links while nothing else is to do
before the next tick [µs of the pacing clock]. A flood must leave the companion, on the same host,
some of the processor."""

BULK_RESERVE_US = TICK_US // 8
"""Bulk transfers stop so long before the next tick [µs of the pacing clock]: what arrives is read
then."""


class TickTime:
    """The time before the next tick, for all links together."""

    def __init__(self, clock: Clock | None) -> None:
        """Take the pacing clock; None: nobody waits for a tick, and all may take any time."""
        self.clock = clock
        self.next_us = 0
        """When the next tick begins, in simulated time [µs]."""
        self.idle_us = IDLE_LISTEN_US
        """What may still go into listening before that [µs]."""

    def renew(self, next_us: int) -> None:
        """Begin another tick's time, which ends with the tick at simulated `next_us` [µs]."""
        self.next_us = next_us
        self.idle_us = IDLE_LISTEN_US

    def is_short(self) -> bool:
        """Return whether the next tick is so near that bulk transfers have to wait."""
        return self.clock is not None and self.clock.time_us() > self.next_us - BULK_RESERVE_US


class ListeningTime:
    """The part of a tick's time that goes into what arrives on one link."""

    def __init__(self, tick: TickTime) -> None:
        self._tick = tick
        self._tick_us = tick.next_us
        self._left_us = LISTEN_US
        self._looked_us = 0

    def renew(self) -> None:
        """Begin another tick: what arrives may take its time again."""
        self._left_us = LISTEN_US

    def begin(self) -> bool:
        """Begin to listen, in another tick with its own time; return whether that is bounded."""
        tick = self._tick
        if tick.clock is None:
            return False
        if self._tick_us != tick.next_us:
            self._tick_us, self._left_us = tick.next_us, LISTEN_US
        self._looked_us = tick.clock.time_us()
        return True

    def left(self) -> bool:
        """Count the time since the last look; return whether there is time for more."""
        tick = self._tick
        if tick.clock is None:
            return True
        now_us = tick.clock.time_us()
        spent_us, self._looked_us = now_us - self._looked_us, now_us
        idle = now_us < tick.next_us
        if idle and tick.idle_us > 0:
            tick.idle_us -= spent_us
        else:
            self._left_us -= spent_us
        return self._left_us > 0 or (idle and tick.idle_us > 0)


EVERY_US = 10 * US_PER_S
"""Shortest time between two texts of one kind [µs]."""


class Complaints:
    """Turns counters into texts, now and then."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], tuple[int, int]] = {}
        """By link and kind: when [µs], and how many there were."""

    def restart(self) -> None:
        """Simulated time may start anew: what was counted is told from now on."""
        self._told = {key: (-EVERY_US, count) for key, (_, count) in self._told.items()}

    def due(self, name: str, refused: int, dropped: int, now_us: int) -> list[Message]:
        """Return the texts that are due on a link at `now_us` [µs]: of frames not taken."""
        texts: list[Message] = []
        for kind, count, problem in (
            ("refused", refused, "frames refused: bad signature"),
            ("dropped", dropped, "datagrams dropped: flood or full"),
        ):
            told_us, told = self._told.get((name, kind), (-EVERY_US, 0))
            if count > told and now_us - told_us >= EVERY_US:
                self._told[name, kind] = now_us, count
                texts.append(Message(Severity.WARNING, f"{name}: {count - told} {problem}"))
        return texts

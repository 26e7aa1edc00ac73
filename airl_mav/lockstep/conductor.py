"""The conductor: decides what happens next on the one simulated clock.

It stands where the firmware waits for a tick's time (`firmware_sim.pacing.Pacing`). Up to that
tick it lets everything happen that is due earlier, in order: the companion's turns, when it wakes,
and MAVSDK's repetitions of the newest setpoint. Neither the firmware nor the companion knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.lockstep.digest import FlightDigest
from airl_mav.lockstep.inbound import Inbound
from airl_mav.lockstep.turns import Partner, Turn
from firmware_sim.mavlink.endpoint import MemoryEndpoint

FEED_FRAMES = 256
"""So many frames of telemetry are passed on at a time, or all of them when a turn begins."""

SILENCE_US = 3 * US_PER_S
"""A flight controller that says nothing for longer is no longer heard, as MAVSDK has it [µs]."""


class Conductor:
    """Conducts one flight. Implements `firmware_sim.pacing.Pacing`."""

    epoch_ns = None
    slipped_us = 0

    def __init__(
        self,
        endpoint: MemoryEndpoint,
        partner: Partner,
        digest: FlightDigest | None = None,
        speed: float | None = None,
    ) -> None:
        """Put it between the two.

        Args:
            endpoint: The vehicle's end of the companion's link.
            partner: The companion.
            digest: Takes the fingerprint of what crosses the link; None: nobody wants it.
            speed: Greatest number of simulated seconds per wall second; None: as fast as it goes.
        """
        self.clock = SimClock()
        self.ended = False
        """Whether the companion has ended."""
        self._endpoint = endpoint
        self._partner = partner
        self._digest = digest or FlightDigest()
        self._speed = speed
        self._wall: WallClock | None = None
        self._inbound = Inbound()
        self._turn = Turn(None)
        self._waiting: list[bytes] = []
        """Telemetry that has not been passed on."""
        self._heard_us = 0

    def begin(self, at_us: int) -> None:
        """Give the companion its first turn at simulated `at_us` [µs]."""
        self._turn = Turn(at_us)

    @property
    def heard(self) -> bool:
        """Whether the companion hears the flight controller."""
        return self.clock.time_us() - self._heard_us <= SILENCE_US

    # --- firmware_sim.pacing.Pacing

    def restart(self, tick_us: int) -> None:
        """Set the clock to `tick_us`."""
        self.clock.sleep_until(tick_us)
        if self._speed is not None:
            self._wall = WallClock(self._speed)
            self._wall.epoch_ns -= int(tick_us * 1_000 / self._speed)

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        """Let everything happen that is due up to simulated `tick_us`, and return that time [µs].

        Args:
            tick_us: The next tick's time.
            sockets: Not used: the link is in memory.
            readable: Makes the vehicle carry out what has arrived, at a given time.
        """
        del sockets
        if self._wall is not None:
            self._wall.sleep_until(tick_us)
        self._collect_telemetry()
        interrupt = self._turn.interrupt
        if interrupt is not None and interrupt.is_set():
            self._turn = Turn(self.clock.time_us())
        while True:
            wake_us, repeat_us = self._turn.wake_us, self._inbound.next_repeat_us
            first_us = wake_us if repeat_us is None else repeat_us
            if wake_us is not None and repeat_us is not None:
                first_us = min(wake_us, repeat_us)
            if first_us is None or first_us > tick_us:
                break
            self.clock.sleep_until(first_us)
            if first_us == wake_us:
                self._give_turn(readable)
            else:
                self._deliver(self._inbound.repeat(first_us), readable)
        self.clock.sleep_until(tick_us)
        return tick_us

    # --- one turn

    def _give_turn(self, readable: Callable[[int], object]) -> None:
        now_us = self.clock.time_us()

        def handle(frame: bytes) -> None:
            passed = self._inbound.take(frame, now_us)
            if passed.answer is not None:
                self._partner.send(passed.answer)
            for wanted in passed.deliver:
                self._deliver(wanted, readable, of_the_flight=passed.of_the_flight)

        self._pass_telemetry()
        self._turn = self._partner.turn(now_us, handle)
        if self._turn.wake_us is None:
            self.ended = True
            self._inbound.end()
            return
        again = self._inbound.renewed(self._turn.setpoints_sent, now_us)
        if again is not None:
            self._deliver(again, readable)

    def _deliver(
        self, frame: bytes, readable: Callable[[int], object], *, of_the_flight: bool = True
    ) -> None:
        """Let the vehicle carry out one frame now, and pass its answers on."""
        now_us = self.clock.time_us()
        if of_the_flight:
            self._digest.add("commands", now_us, frame)
        self._endpoint.inbox.append(frame)
        readable(now_us)
        answers = self._endpoint.take()
        if answers:
            self._partner.send(b"".join(answers))

    # --- telemetry

    def _collect_telemetry(self) -> None:
        """Take what the vehicle has sent in its last tick."""
        frames = self._endpoint.take()
        if not frames:
            return
        self._heard_us = self.clock.time_us()
        self._digest.add("telemetry", self._heard_us, b"".join(frames))
        self._waiting += frames
        if len(self._waiting) >= FEED_FRAMES:
            self._pass_telemetry()

    def _pass_telemetry(self) -> None:
        if self._waiting:
            self._partner.send(b"".join(self._waiting))
            self._waiting.clear()

"""What operators are told of senders that are turned away: a wrong key would look like silence."""

from __future__ import annotations

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import Message, Severity
from firmware_sim.mavlink.link import LinkCounters

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

    def due(self, name: str, link: LinkCounters, now_us: int) -> list[Message]:
        """Return what is to be told on a link at simulated `now_us` [µs], of its own senders."""
        texts: list[Message] = []
        for kind, count, problem in (
            ("refused", link.refused, "frames refused: bad signature"),
            ("dropped", link.dropped, "datagrams dropped: flood or full"),
        ):
            told_us, told = self._told.get((name, kind), (-EVERY_US, 0))
            if count > told and now_us - told_us >= EVERY_US:
                self._told[name, kind] = now_us, count
                texts.append(Message(Severity.WARNING, f"{name}: {count - told} {problem}"))
        return texts

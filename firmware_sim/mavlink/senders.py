"""Who commands the vehicle: a system that has announced itself, or a stranger."""

from __future__ import annotations

from collections import Counter

from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import sender

COMMANDS = frozenset(
    ("COMMAND_LONG", "COMMAND_INT", "SET_MODE", "SET_POSITION_TARGET_LOCAL_NED", "PARAM_SET")
)
"""Messages that change what the vehicle does."""

ANNOUNCED = (dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_ONBOARD_CONTROLLER)
"""Types in the heartbeat of a ground station and of a companion computer."""


class Senders:
    """Notes commands of systems whose heartbeat calls them neither companion nor ground station."""

    def __init__(self) -> None:
        self._announced: set[tuple[int, int]] = set()
        """System and component ids; they hold for as long as the links are open."""
        self._strangers: Counter[tuple[int, int, str]] = Counter()

    def note(self, message: WireMessage) -> None:
        """Take a message that was for this vehicle and did something."""
        kind = message.get_type()
        if kind == "HEARTBEAT":
            if message.type in ANNOUNCED:
                self._announced.add(sender(message))
        elif kind in COMMANDS and sender(message) not in self._announced:
            self._strangers[(*sender(message), kind)] += 1

    def strangers(self) -> tuple[str, ...]:
        """Return a line for each stranger and kind of message since the last `forget`."""
        return tuple(
            f"system {system} component {component}, {kind} ({count} times)"
            for (system, component, kind), count in sorted(self._strangers.items())
        )

    def forget(self) -> None:
        """Begin anew: another episode."""
        self._strangers.clear()

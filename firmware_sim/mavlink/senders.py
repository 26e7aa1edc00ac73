"""Who commands the vehicle: a system that has announced itself, or a stranger."""

from __future__ import annotations

from collections import Counter

from firmware_sim.mavlink.codec import WireMessage, dialect

COMMANDS = frozenset(
    (
        "COMMAND_LONG",
        "COMMAND_INT",
        "SET_MODE",
        "SET_POSITION_TARGET_LOCAL_NED",
        "SET_POSITION_TARGET_GLOBAL_INT",
        "SET_ATTITUDE_TARGET",
        "MANUAL_CONTROL",
        "RC_CHANNELS_OVERRIDE",
        "MISSION_COUNT",
        "MISSION_CLEAR_ALL",
        "MISSION_SET_CURRENT",
        "PARAM_SET",
        "SETUP_SIGNING",
    )
)
"""Messages that change what the vehicle does."""

ANNOUNCED = (dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_ONBOARD_CONTROLLER)
"""Types in the heartbeat of a ground station and of a companion computer."""


class Senders:
    """Notes who commands, and whose heartbeat calls them a companion or a ground station."""

    def __init__(self) -> None:
        self._announced: set[tuple[int, int]] = set()
        """System and component ids. They hold for as long as the links are open."""
        self._commands: Counter[tuple[int, int, str]] = Counter()

    def note(self, message: WireMessage, kind: str, source: tuple[int, int]) -> None:
        """Take a message of a sender that was for this vehicle and did something."""
        if kind in COMMANDS:
            self._commands[(*source, kind)] += 1
        elif kind == "HEARTBEAT" and message.type in ANNOUNCED:
            self._announced.add(source)

    def strangers(self) -> tuple[str, ...]:
        """Return a line for each stranger and kind of message since the last `forget`.

        A stranger has not announced itself by now: MAVSDK commands before its first heartbeat.
        """
        return tuple(
            f"system {system} component {component}, {kind} ({count} times)"
            for (system, component, kind), count in sorted(self._commands.items())
            if (system, component) not in self._announced
        )

    def forget(self) -> None:
        """Begin anew: another episode."""
        self._commands.clear()

"""A vehicle as rows see it: MAVSDK's plugins, and single MAVLink messages."""

from __future__ import annotations

import json
import queue
from collections.abc import Callable
from contextlib import contextmanager
from typing import Any, TypeVar, cast

from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage

from tests.support.mavlink_clients import Companion

NO_ACK = "no ack"
ACK_S = 6.0
"""How long an acknowledgement is waited for, as MAVSDK's own retries would [s of wall time]."""

_RESULTS = (
    *("ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED"),
    *("IN_PROGRESS", "CANCELLED"),
)

Plugin = TypeVar("Plugin")


class Vehicle:
    """A connected vehicle."""

    def __init__(self, companion: Companion, system_id: int = 1) -> None:
        self._companion = companion
        self._plugins: dict[type, Any] = {}
        self.system_id = system_id

    def plugin(self, kind: Callable[..., Plugin]) -> Plugin:
        """Return one of MAVSDK's plugins; each is made once."""
        key = cast("type", kind)
        if key not in self._plugins:
            self._plugins[key] = self._companion.plugin(kind)
        return cast("Plugin", self._plugins[key])

    def send(self, name: str, **fields: Any) -> None:
        """Send a message; it goes to the vehicle where it has a target."""
        target = {"target_system": self.system_id, "target_component": 1}
        body = json.dumps(target | fields)
        self.plugin(MavlinkDirect).send_message(MavlinkMessage(name, 245, 190, 0, 0, body))

    def command(self, number: int, *params: float) -> str:
        """Send a COMMAND_LONG and return its result's name, or `NO_ACK`."""
        return self.command_and_message(number, *params)[0]

    def command_and_message(
        self, number: int, *params: float, message: str = "", wait_s: float = ACK_S
    ) -> tuple[str, dict[str, Any] | None]:
        """Send a COMMAND_LONG; return its result's name, and a message that comes with it."""
        filled = (*params, *(0.0,) * (7 - len(params)))
        fields = {f"param{i}": value for i, value in enumerate(filled, start=1)}
        with self.heard("COMMAND_ACK") as acks, self.heard(message or "COMMAND_ACK") as messages:
            # Once only: a loopback loses nothing, and a second answer would be taken for the next.
            self.send("COMMAND_LONG", command=number, confirmation=0, **fields)
            try:
                while (ack := acks.get(timeout=wait_s))["command"] != number:
                    pass
                result = _RESULTS[ack["result"]]
            except queue.Empty:
                return NO_ACK, None
            if not message or result != "ACCEPTED":
                return result, None
            try:
                return result, messages.get(timeout=wait_s)
            except queue.Empty:
                return result, None

    @contextmanager
    def heard(self, name: str) -> Any:
        """Yield a queue of the messages of a name, as dictionaries."""
        messages: queue.Queue[dict[str, Any]] = queue.Queue()
        direct = self.plugin(MavlinkDirect)
        handle = direct.subscribe_message(
            name, lambda message, _: messages.put(json.loads(message.fields_json))
        )
        try:
            yield messages
        finally:
            direct.unsubscribe_message(handle)

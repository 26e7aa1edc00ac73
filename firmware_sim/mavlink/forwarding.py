"""Forwarding of messages between clients, as PX4 forwards messages between its links.

Source: PX4 1.16, Mavlink::forward_message. A message goes to every other client through which its
target has been seen; a broadcast goes to every other client that has sent a message.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable

from firmware_sim.mavlink.clients import Client
from firmware_sim.mavlink.codec import COMPONENT_ID, WireMessage, dialect
from firmware_sim.mavlink.services.context import ANY, sender

REMEMBERED_FRAMES = 128
"""Number of recent frames per sender that are not forwarded again. Below 256, the number of
sequence numbers: a sender of heartbeats alone repeats its frames after that."""

REMEMBERED_SENDERS = 256

NEVER = frozenset((dialect.MAVLINK_MSG_ID_SETUP_SIGNING,))
"""Messages that are never forwarded. A signing key is for its recipient only."""


class Forwarder:
    """Message forwarder. Sends each frame once: programs that join two links cause no loop."""

    def __init__(self, everybody: Callable[[], Iterable[Client]]) -> None:
        """Store the callable that returns all clients of all links."""
        self._everybody = everybody
        self._seen: OrderedDict[tuple[int, int], deque[bytes]] = OrderedDict()

    def forward(self, message: WireMessage, origin: Client, system_id: int, now_us: int) -> bool:
        """Forward a message to the clients concerned; return True if any received it.

        Args:
            message: Received message.
            origin: Client that sent the message.
            system_id: System id of this vehicle.
            now_us: Simulated time [µs].
        """
        target = getattr(message, "target_system", ANY), getattr(message, "target_component", ANY)
        if target == (system_id, COMPONENT_ID) or message.get_msgId() in NEVER:
            return False
        if not origin.forwards.left(now_us):
            return False
        receivers = [
            client
            for client in self._everybody()
            if client is not origin and _concerns(target, client)
        ]
        if not receivers:
            return False
        frame = bytes(message.get_msgbuf())
        if not self._is_new(sender(message), frame):
            return False
        origin.forwards.take(1, now_us)
        for client in receivers:
            client.link.pass_on(frame)
        return True

    def _is_new(self, source: tuple[int, int], frame: bytes) -> bool:
        frames = self._seen.get(source)
        if frames is None:
            if len(self._seen) >= REMEMBERED_SENDERS:
                self._seen.popitem(last=False)
            frames = self._seen[source] = deque(maxlen=REMEMBERED_FRAMES)
        if frame in frames:
            return False
        frames.append(frame)
        self._seen.move_to_end(source)
        return True


def _concerns(target: tuple[int, int], client: Client) -> bool:
    system, component = target
    if system == ANY:
        return bool(client.components)
    if component == ANY:
        return any(heard[0] == system for heard in client.components)
    return target in client.components

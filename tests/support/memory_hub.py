"""Link in memory, shared by several clients with distinct addresses, as UDP addresses."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from firmware_sim.mavlink.endpoint import Endpoint, MemoryEndpoint, Peer
from tests.support.mavlink_clients import RawClient


class _Lane(MemoryEndpoint):
    """Two queues of one client; the hub stores its data in order of arrival."""

    def __init__(self, hub: MemoryHub, peer: Peer) -> None:
        super().__init__()
        self.inbox = _Inbox(hub, peer)


class _Inbox(deque[bytes]):
    def __init__(self, hub: MemoryHub, peer: Peer) -> None:
        super().__init__()
        self._hub, self._peer = hub, peer

    def append(self, data: bytes) -> None:
        self._hub.arrived.append((self._peer, data))


class MemoryHub:
    """Implements `SharedEndpoint`."""

    datagrams = True
    is_polled = True

    def __init__(self, most: int = 256) -> None:
        self.send_errors = 0
        self.arrived: deque[tuple[Peer, bytes]] = deque()
        self.most = most
        """Chunks read per call, as of a socket."""
        self._lanes: dict[Peer, _Lane] = {}

    def lane(self, peer: Peer) -> MemoryEndpoint:
        """Return a peer's own queues."""
        if peer not in self._lanes:
            self._lanes[peer] = _Lane(self, peer)
        return self._lanes[peer]

    def client(self, port: int | None, ids: tuple[int, int] = (245, 190)) -> RawClient:
        """Return a client at a separate port; None = at the preset remote."""
        return RawClient(self.lane(None if port is None else ("127.0.0.1", port)), ids)

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        for _ in range(min(self.most, len(self.arrived))):
            yield self.arrived.popleft()

    def towards(self, peer: Peer) -> Endpoint | None:
        return self.lane(peer)

    def receive(self) -> list[bytes]:
        return [data for _, data in self.arrivals()]

    def send(self, data: bytes) -> None:
        raise AssertionError("a link of several clients sends to each")

    def send_streams(self, frames: object) -> None:
        raise AssertionError("a link of several clients sends to each")

    def fileno(self) -> None:
        return None

    def close(self) -> None:
        pass

"""Endpoints of MAVLink links: UDP as PX4 uses it, or queues in memory."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Protocol, TypeAlias

from airl_mav.core.errors import UsageError

Address = tuple[str, int]
"""IPv4 host (name or number) and UDP port."""

Peer: TypeAlias = "Address | None"
"""Who is at the other end: the preset remote, or the only one in memory (None), or an address."""

MAX_DATAGRAM = 4096
"""Longest datagram read; MAVLink frames are at most 280 bytes, some senders join several."""

MAX_DATAGRAMS_PER_CALL = 256
"""Datagrams read per `receive`: a flood must not delay the flight controller."""

RECEIVE_BUFFER_BYTES = 1 << 20
"""What a socket may hold while the host lets the simulator wait: some 2,500 short datagrams, or as
many as Linux allows (net.core.rmem_max: 500 by default)."""

_MARKERS = (0xFD, 0xFE)


class PortTakenError(UsageError):
    """A port that another program has bound."""


class Sender(Protocol):
    """Sends to one other end of a MAVLink link. Nothing blocks and nothing raises while flying."""

    @property
    def send_errors(self) -> int:
        """Chunks that could not be sent."""
        ...

    def send(self, data: bytes) -> None:
        """Send one frame: an answer, now."""
        ...

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Send the telemetry of one tick, one frame after the other."""
        ...


class Endpoint(Sender, Protocol):
    """One end of a MAVLink link, which receives as well."""

    datagrams: bool
    """True when each chunk from `receive` holds whole frames."""

    def receive(self) -> list[bytes]:
        """Return all chunks that have arrived, oldest first."""
        ...

    def fileno(self) -> int | None:
        """Return the descriptor to wait on, or None when there is none."""
        ...

    def close(self) -> None:
        """Release the resources; harmless when called again."""
        ...


class SharedEndpoint(Endpoint, Protocol):
    """An endpoint that tells its peers apart."""

    @property
    def is_polled(self) -> bool:
        """Whether something may have arrived although its descriptor is not readable."""
        ...

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        """Yield what has arrived and from whom, oldest first; a bounded number of chunks.

        What is not taken out of the iterator waits for the next call.
        """
        ...

    def towards(self, peer: Peer) -> Sender | None:
        """Return what sends to one peer; None for a preset remote that is not set."""
        ...


class MemoryEndpoint:
    """Two queues in one process: for lockstep and tests."""

    datagrams = True
    is_polled = True

    def __init__(self) -> None:
        self.inbox: deque[bytes] = deque()
        """Chunks for the vehicle. The other side appends."""
        self.outbox: deque[bytes] = deque()
        """Frames from the vehicle. The other side takes from the left."""
        self.send_errors = 0

    def receive(self) -> list[bytes]:
        """Return all chunks put into `inbox`, oldest first."""
        chunks: list[bytes] = []
        inbox = self.inbox
        while inbox:  # one by one: another thread may be appending
            chunks.append(inbox.popleft())
        return chunks

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        """Yield the chunks put into `inbox`, oldest first."""
        inbox = self.inbox
        while inbox:
            yield None, inbox.popleft()

    def towards(self, peer: Peer) -> Sender | None:
        """Return this endpoint: there is one other end."""
        return self if peer is None else None

    def send(self, data: bytes) -> None:
        """Append one frame to `outbox`."""
        self.outbox.append(data)

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Append frames to `outbox`."""
        self.outbox.extend(frames)

    def take(self) -> list[bytes]:
        """Return and forget all frames sent so far, oldest first; `b"".join` makes them one chunk.

        A subclass that tells answers from telemetry overrides `send` and `send_streams`.
        """
        frames = list(self.outbox)
        self.outbox.clear()
        return frames

    def fileno(self) -> None:
        """Return None: there is nothing to wait on."""

    def close(self) -> None:
        """Do nothing."""


class UdpPeer:
    """One address that a bound UDP socket sends to. Implements `Sender`."""

    def __init__(self, bound: socket.socket, address: Address) -> None:
        self.send_errors = 0
        self._socket = bound
        self._address = address

    def send(self, data: bytes) -> None:
        """Send one frame."""
        try:
            self._socket.sendto(data, self._address)
        except OSError:
            self.send_errors += 1

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Send each frame as a datagram of its own, as PX4: some clients decode no other."""
        send, address = self._socket.sendto, self._address
        for frame in frames:
            try:
                send(frame, address)
            except OSError:
                self.send_errors += 1


class UdpEndpoint:
    """A bound UDP socket with a preset remote, like a PX4 SITL link.

    Frames are sent to the preset remote from the first tick, before anything was received.
    `arrivals` and `towards` distinguish peers. `receive` and `send` do not: the newest peer at
    another address gets all frames, too.
    """

    datagrams = True
    is_polled = False

    def __init__(
        self,
        local: Address,
        remote: Address | None,
        *,
        local_option: str,
        remote_option: str,
        insecure: bool = False,
    ) -> None:
        """Bind.

        Args:
            local: Address to bind; port 0 = any free one.
            remote: Where to send from the first tick; None = only to peers that sent something.
            local_option: The command line option that moves the local port, for messages.
            remote_option: The command line option that moves the remote, for messages.
            insecure: Allow addresses that other machines can reach: frames are signed, or the
                network is trusted.

        Raises:
            UsageError: An address is unusable, taken, or reachable from outside without
                `insecure`.
        """
        local = _usable(local, local_option, lowest_port=0, insecure=insecure)
        if remote is not None:
            remote = _usable(remote, remote_option, lowest_port=1, insecure=insecure)
        self._remote = remote
        self.peer: Address | None = None
        """The newest sender that is not the preset remote, None before any."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        try:
            self._socket.bind(local)
        except OSError as error:
            self._socket.close()
            problem = f"cannot be used ({error.strerror})"
            if error.errno == errno.EADDRINUSE:
                problem = "is taken (another simulator?)"
            where = f"UDP port {local[1]} on {local[0]}"
            kind = PortTakenError if error.errno == errno.EADDRINUSE else UsageError
            raise kind(f"{where} {problem}: choose another with {local_option}") from error
        self.local: Address = self._socket.getsockname()
        self._preset = None if remote is None else UdpPeer(self._socket, remote)
        self._learned: UdpPeer | None = None
        self._lost = 0
        """Datagrams that could not be sent to peers before the newest."""

    @property
    def send_errors(self) -> int:
        """Datagrams that could not be sent."""
        return self._lost + sum(end.send_errors for end in self._ends())

    def receive(self) -> list[bytes]:
        """Return the datagrams that have arrived, oldest first, and note their sender."""
        chunks: list[bytes] = []
        for peer, data in self.arrivals():
            if peer is not None and peer != self.peer and data and data[0] in _MARKERS:
                self._lost += 0 if self._learned is None else self._learned.send_errors
                self.peer, self._learned = peer, UdpPeer(self._socket, peer)
            chunks.append(data)
        return chunks

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        """Yield the datagrams that have arrived and who sent each, oldest first."""
        for _ in range(MAX_DATAGRAMS_PER_CALL):
            try:
                data, address = self._socket.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:
                continue  # an earlier send was refused (ICMP): nothing arrived
            yield (None if address == self._remote else address), data

    def towards(self, peer: Peer) -> Sender | None:
        """Return what sends to one address; None: to the preset remote."""
        address = self._remote if peer is None else peer
        return None if address is None else UdpPeer(self._socket, address)

    def send(self, data: bytes) -> None:
        """Send one frame to the preset remote and to the learned peer."""
        for end in self._ends():
            end.send(data)

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Send frames to both."""
        for end in self._ends():
            end.send_streams(frames)

    def _ends(self) -> Iterator[UdpPeer]:
        return (end for end in (self._preset, self._learned) if end is not None)

    def fileno(self) -> int | None:
        """Return the socket's descriptor, None once closed."""
        number = self._socket.fileno()
        return None if number < 0 else number

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _usable(address: Address, option: str, *, lowest_port: int, insecure: bool) -> Address:
    """Return the address with its host name resolved. Raises UsageError if it cannot be used."""
    host, port = address
    if not lowest_port <= port <= 65_535:
        raise UsageError(f"{option}: port {port}: must be in {lowest_port}..65535")
    try:
        number = socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise UsageError(f"{option}: host {host!r}: no such IPv4 host") from error
    if not ipaddress.IPv4Address(number).is_loopback and not insecure:
        raise UsageError(
            f"{option}: {host}:{port} can be reached from other machines and MAVLink is "
            "unauthenticated: give a --signing-key, or --insecure on a trusted network"
        )
    return number, port

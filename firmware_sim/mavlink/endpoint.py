"""Endpoints of MAVLink links: UDP sockets as in PX4, or queues in memory."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Protocol, TypeAlias

from airl_mav.core.errors import UsageError

Address = tuple[str, int]
"""IPv4 host (name or address) and UDP port."""

Peer: TypeAlias = "Address | None"
"""Address of a peer; None = the preset remote, or the only peer in memory."""

MAX_DATAGRAM = 4096
"""Maximum datagram size [bytes]. A MAVLink frame has at most 280; some senders join several."""

MAX_DATAGRAMS_PER_CALL = 256
"""Maximum number of datagrams per `receive`, so that a flood cannot delay the flight controller."""

RECEIVE_BUFFER_BYTES = 1 << 20
"""Receive buffer of a socket [bytes], for pauses of the simulator: about 2,500 short datagrams, or
the maximum that Linux allows (net.core.rmem_max: 500 by default)."""

_MARKERS = (0xFD, 0xFE)


class PortTakenError(UsageError):
    """Error for a port that another program has bound."""


class Sender(Protocol):
    """Sender to one peer of a MAVLink link. Never blocks or raises during a flight."""

    @property
    def send_errors(self) -> int:
        """Number of chunks that could not be sent."""

    def send(self, data: bytes) -> None:
        """Send one frame immediately, as a reply."""

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Send the telemetry of one tick, one frame after the other."""


class Endpoint(Sender, Protocol):
    """Endpoint of a MAVLink link that also receives."""

    datagrams: bool
    """True if each chunk from `receive` holds whole frames."""

    def receive(self) -> list[bytes]:
        """Return all chunks that have arrived, oldest first."""

    def fileno(self) -> int | None:
        """Return the descriptor to wait on, or None if the endpoint has no descriptor."""

    def close(self) -> None:
        """Release the resources. Repeated calls have no effect."""


class SharedEndpoint(Endpoint, Protocol):
    """Endpoint that distinguishes its peers."""

    @property
    def is_polled(self) -> bool:
        """True if data may have arrived although the descriptor is not readable."""

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        """Yield received chunks with their peers, oldest first, up to a maximum number.

        Chunks not taken from the iterator remain for the next call.
        """

    def towards(self, peer: Peer) -> Sender | None:
        """Return a sender to one peer; None if the preset remote is not set."""


class MemoryEndpoint:
    """Pair of in-process queues, for lockstep and tests."""

    datagrams = True
    is_polled = True

    def __init__(self) -> None:
        self.inbox: deque[bytes] = deque()
        """Chunks to the vehicle. The other side appends."""
        self.outbox: deque[bytes] = deque()
        """Frames from the vehicle. The other side removes from the left."""
        self.send_errors = 0

    def receive(self) -> list[bytes]:
        """Return all chunks in `inbox`, oldest first."""
        return [chunk for _, chunk in self.arrivals()]

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        """Yield the chunks in `inbox`, oldest first."""
        inbox = self.inbox
        while inbox:  # one by one: another thread may append
            yield None, inbox.popleft()

    def towards(self, peer: Peer) -> Sender | None:
        """Return this endpoint, which has exactly one peer."""
        return self if peer is None else None

    def send(self, data: bytes) -> None:
        """Append one frame to `outbox`."""
        self.outbox.append(data)

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Append frames to `outbox`."""
        self.outbox.extend(frames)

    def take(self) -> list[bytes]:
        """Return and remove all frames sent so far, oldest first; `b"".join` merges them.

        A subclass can override `send` and `send_streams` to separate replies from telemetry.
        """
        frames = list(self.outbox)
        self.outbox.clear()
        return frames

    def fileno(self) -> None:
        """Return None: the endpoint has no descriptor."""

    def close(self) -> None:
        """Do nothing."""


class UdpPeer:
    """Destination address of a bound UDP socket. Implements `Sender`."""

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
        """Send each frame as a separate datagram, as PX4 does: some clients require it."""
        # Local names avoid attribute lookups in the loop over all frames.
        send, address = self._socket.sendto, self._address
        for frame in frames:
            try:
                send(frame, address)
            # A full socket buffer or an ICMP error loses the frame, as UDP does.
            except OSError:
                self.send_errors += 1


class UdpEndpoint:
    """Bound UDP socket with a preset remote, like a PX4 SITL link.

    The preset remote receives frames from the first tick, before it has sent any. `arrivals` and
    `towards` distinguish peers. `receive` and `send` do not: the most recent peer at another
    address also receives all frames.
    """

    datagrams = True
    is_polled = False

    def __init__(
        self,
        local: Address,
        remote: Address | None,
        local_option: str,
        remote_option: str,
        *,
        insecure: bool = False,
    ) -> None:
        """Bind the socket.

        Args:
            local: Address to bind; port 0 = any free port.
            remote: Destination from the first tick; None = only peers that have sent data.
            local_option: Command line option for the local port, for error messages.
            remote_option: Command line option for the remote, for error messages.
            insecure: Allow addresses that other machines can reach. Requires signed frames or a
                trusted network.

        Raises:
            UsageError: An address is invalid, in use, or reachable from outside without `insecure`.
        """
        local = _usable(local, local_option, lowest_port=0, insecure=insecure)
        if remote is not None:
            remote = _usable(remote, remote_option, lowest_port=1, insecure=insecure)
        self._remote = remote
        self.peer: Address | None = None
        """Most recent sender other than the preset remote; None until the first."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # Non-blocking: reading runs in the tick and must return at once.
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        try:
            self._socket.bind(local)
        except OSError as error:
            self._socket.close()
            problem = f"cannot be used ({error.strerror})"
            # EADDRINUSE gets its own class, because callers can choose another port.
            if error.errno == errno.EADDRINUSE:
                problem = "is taken (another simulator?)"
            where = f"UDP port {local[1]} on {local[0]}"
            kind = PortTakenError if error.errno == errno.EADDRINUSE else UsageError
            raise kind(f"{where} {problem}: choose another with {local_option}") from error
        self.local: Address = self._socket.getsockname()
        self._preset = None if remote is None else UdpPeer(self._socket, remote)
        self._learned: UdpPeer | None = None
        self._lost = 0
        """Number of datagrams that could not be sent to earlier peers."""

    @property
    def send_errors(self) -> int:
        """Number of datagrams that could not be sent."""
        return self._lost + sum(end.send_errors for end in self._ends())

    def receive(self) -> list[bytes]:
        """Return the datagrams received, oldest first, and store their sender."""
        chunks: list[bytes] = []
        for peer, data in self.arrivals():
            # Only a chunk with a MAVLink marker changes the peer: a port scan must not.
            if peer is not None and peer != self.peer and data and data[0] in _MARKERS:
                self._lost += 0 if self._learned is None else self._learned.send_errors
                self.peer, self._learned = peer, UdpPeer(self._socket, peer)
            chunks.append(data)
        return chunks

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        """Yield received datagrams with their senders, oldest first."""
        # The limit keeps a flood from extending this call.
        for _ in range(MAX_DATAGRAMS_PER_CALL):
            try:
                data, address = self._socket.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:
                continue  # ICMP error from an earlier send; nothing arrived
            # The preset remote is peer None, so that its client exists from the start.
            yield (None if address == self._remote else address), data

    def towards(self, peer: Peer) -> Sender | None:
        """Return a sender to one address; None = to the preset remote."""
        address = self._remote if peer is None else peer
        return None if address is None else UdpPeer(self._socket, address)

    def send(self, data: bytes) -> None:
        """Send one frame to the preset remote and to the most recent peer."""
        for end in self._ends():
            end.send(data)

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Send frames to the preset remote and to the most recent peer."""
        for end in self._ends():
            end.send_streams(frames)

    def _ends(self) -> Iterator[UdpPeer]:
        return (end for end in (self._preset, self._learned) if end is not None)

    def fileno(self) -> int | None:
        """Return the socket's descriptor; None when closed."""
        number = self._socket.fileno()
        return None if number < 0 else number

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _usable(address: Address, option: str, *, lowest_port: int, insecure: bool) -> Address:
    """Return the address with its host name resolved. Raises UsageError if it is unusable."""
    host, port = address
    if not lowest_port <= port <= 65_535:
        raise UsageError(f"{option}: port {port}: must be in {lowest_port}..65535")
    try:
        number = socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise UsageError(f"{option}: host {host!r}: no such IPv4 host") from error
    # Without authentication, only this machine may reach the port by default.
    if not ipaddress.IPv4Address(number).is_loopback and not insecure:
        raise UsageError(
            f"{option}: {host}:{port} can be reached from other machines and MAVLink is "
            "unauthenticated: give a --signing-key, or --insecure on a trusted network"
        )
    return number, port

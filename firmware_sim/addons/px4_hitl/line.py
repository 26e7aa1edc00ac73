"""Router of MAVLink between a board on one serial line and its clients over UDP.

Simulator messages on the line are handled here. All other frames are forwarded unchanged.
"""

from __future__ import annotations

import errno
import os
import select
import selectors
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import serial
from serial.tools import list_ports

from airl_mav.core import constants, errors
from airl_mav.core.clock import Clock
from firmware_sim.mavlink import codec, link
from firmware_sim.mavlink.endpoint import Endpoint

SIMULATOR_IDS = frozenset(
    codec.message_id(name)
    for name in (
        "HIL_ACTUATOR_CONTROLS",
        "HIL_CONTROLS",
        "HIL_GPS",
        "HIL_OPTICAL_FLOW",
        "HIL_RC_INPUTS_RAW",
        "HIL_SENSOR",
        "HIL_STATE_QUATERNION",
    )
)
"""Messages forwarded in neither direction: only this simulator may send them to the board."""

BURST_BYTES = 8192
"""Maximum burst to the board before the budget applies [bytes]."""

HEARD_FRAMES = 4096
"""Frames buffered for a listener in this process: ten seconds of PX4 telemetry."""


class RoutedFrame(NamedTuple):
    """Received frame."""

    raw: bytes
    number: int
    message: codec.WireMessage

    @property
    def known(self) -> bool:
        """True if the dialect has the message, so that its checksum was checked."""
        return self.number in codec.dialect.mavlink_map


class FrameDecoder(codec.Decoder):
    """Decoder that keeps the bytes of each frame, also of messages unknown to the dialect."""

    def __init__(self, *, datagrams: bool) -> None:
        super().__init__(datagrams=datagrams)
        self._frames: list[RoutedFrame] = []

    def frames(self, data: bytes) -> list[RoutedFrame]:
        """Return the frames completed by a chunk of bytes."""
        self.feed(data)
        found, self._frames = self._frames, []
        return found

    def _decode(self, buffer: bytes, start: int, end: int) -> codec.WireMessage | None:
        message = super()._decode(buffer, start, end)
        if message is not None:
            self._frames.append(RoutedFrame(buffer[start:end], int(message.get_msgId()), message))
        return message


class TokenBucket:
    """Token bucket: a rate in bytes per second, and a burst."""

    def __init__(self, bytes_s: int, clock: Clock) -> None:
        """Start with a full burst; `bytes_s` is the long-term rate [bytes/s]."""
        self._bytes_s = bytes_s
        self._clock = clock
        self._left = float(BURST_BYTES)
        self._then_us = clock.time_us()

    def take(self, count: int) -> bool:
        """Return True and spend `count` bytes if they may be sent now."""
        now_us = self._clock.time_us()
        self._left += self._bytes_s * (now_us - self._then_us) / constants.US_PER_S
        self._left, self._then_us = min(self._left, BURST_BYTES), now_us
        if count > self._left:
            return False
        self._left -= count
        return True


class _Client:
    """Client over UDP."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.decoder = FrameDecoder(datagrams=endpoint.datagrams)
        self.rx = self.tx = self.refused = 0


class Router:
    """Router that forwards frames whenever `pump` is called. Nothing blocks or raises; see `lost`.

    Clients stay when the line changes (a USB device vanishes during a reboot). Listeners in this
    process use the router as an `Endpoint`, pumped between ticks.
    """

    datagrams = True

    def __init__(self, clients: Mapping[str, Endpoint], clock: Clock) -> None:
        """Set the clients' endpoints by link name. The router closes them."""
        self.lost: str | None = None
        """Reason for the loss of the line; None = line present, or never attached."""
        self.on_message: Callable[[codec.WireMessage], None] | None = None
        """Callback for every message of the board known to the dialect; None = no callback."""
        self.send_errors = 0
        self.received_bytes = 0
        """Bytes received on the line since it was attached."""
        self.speaks_mavlink = False
        """True once a frame with a valid checksum was received on the attached line. No data are
        sent before: a boot loader at the other end would interpret bytes as commands."""
        self._clients = {name: _Client(endpoint) for name, endpoint in clients.items()}
        self._clock = clock
        self._line: SerialPort | None = None
        self._line_fd = -1
        self._decoder = FrameDecoder(datagrams=False)
        self._budget = TokenBucket(0, clock)
        self._heard: deque[bytes] = deque(maxlen=HEARD_FRAMES)
        self._closed = False
        self._selector = selectors.DefaultSelector()
        for client in self._clients.values():
            number = client.endpoint.fileno()
            if number is not None:
                self._selector.register(number, selectors.EVENT_READ)

    # --- the line

    def attach(self, line: SerialPort, budget_bytes_s: int) -> None:
        """Replace the line to the board, with a client budget [bytes/s]. The caller closes it."""
        self.detach()
        self._line, self._line_fd = line, line.fileno()
        self._selector.register(self._line_fd, selectors.EVENT_READ)
        self._decoder = FrameDecoder(datagrams=False)
        self._budget = TokenBucket(budget_bytes_s, self._clock)
        self._heard.clear()
        self.lost, self.received_bytes, self.speaks_mavlink = None, 0, False

    def detach(self) -> None:
        """Release the line. Call before the line is closed."""
        if self._line is not None:
            self._selector.unregister(self._line_fd)
            self._line = None

    def send_ahead(self, frame: bytes) -> bool:
        """Send a simulator frame ahead of the clients' frames and outside their budget.

        Returns False if the line is full, lost (see `lost`), or not yet known to speak MAVLink.
        """
        if self._line is None or not self.speaks_mavlink:
            return False
        try:
            return self._line.write(frame)
        except SerialLostError as error:
            self._lose(error)
            return False

    # --- forwarding

    def pump(self, wait_s: float = 0.0) -> None:
        """Forward all received data; waits up to `wait_s` for data [wall s]."""
        if wait_s > 0.0:
            self._selector.select(wait_s)
        for frame in self._from_line():
            if frame.known:
                self.speaks_mavlink = True
            if frame.known and self.on_message is not None:
                self.on_message(frame.message)
            if frame.number in SIMULATOR_IDS:
                continue
            self._heard.append(frame.raw)
            for client in self._clients.values():
                client.endpoint.send(frame.raw)
                client.tx += 1
        for client in self._clients.values():
            for chunk in client.endpoint.receive():
                for frame in client.decoder.frames(chunk):
                    client.rx += 1
                    if frame.number in SIMULATOR_IDS or not self.pass_to_board(frame.raw):
                        client.refused += 1

    def pass_to_board(self, frame: bytes) -> bool:
        """Send a client's frame to the board; return False if budget or line do not allow it."""
        return self.speaks_mavlink and self._budget.take(len(frame)) and self.send_ahead(frame)

    def _from_line(self) -> list[RoutedFrame]:
        line = self._line
        if line is None:
            return []
        try:
            line.drain()
            data = line.read()
        except SerialLostError as error:
            self._lose(error)
            return []
        self.received_bytes += len(data)
        return self._decoder.frames(data) if data else []

    def _lose(self, error: SerialLostError) -> None:
        # A line that hung up stays readable, so a select on it would never wait.
        self.detach()
        self.lost = str(error)

    # --- the listener in this process (Endpoint)

    def receive(self) -> list[bytes]:
        """Forward received data; return the board's frames since the last call, oldest first."""
        if self._closed:
            return []
        self.pump()
        heard = list(self._heard)
        self._heard.clear()
        return heard

    def send(self, data: bytes) -> None:
        """Send one frame to the board within the clients' budget."""
        if not self.pass_to_board(data):
            self.send_errors += 1

    def send_streams(self, frames: Sequence[bytes]) -> None:
        """Send frames to the board."""
        for frame in frames:
            self.send(frame)

    def fileno(self) -> int | None:
        """Return a descriptor that is readable while the line or a client is; None once closed."""
        # the descriptor of epoll or kqueue
        return None if self._closed else self._selector.fileno()

    def counters(self) -> dict[str, link.LinkCounters]:
        """Return the traffic counters of each client."""
        return {
            name: link.LinkCounters(
                client.rx,
                client.tx,
                client.decoder.malformed,
                client.refused,
                client.endpoint.send_errors,
            )
            for name, client in self._clients.items()
        }

    def close(self) -> None:
        """Close the clients' endpoints. Idempotent."""
        self._closed = True
        self.detach()
        for client in self._clients.values():
            client.endpoint.close()
        self._selector.close()


DEFAULT_BAUD = 921_600

BAUDS = range(1_200, 12_000_001)

BUFFER_BYTES = 4096
"""Maximum bytes queued for the line: a fifth of a second of sensors; older data are useless."""

BITS_PER_BYTE = 10
"""Bits per byte on a UART, with start and stop bit."""

_CHUNK = 4096
_CHUNKS_PER_READ = 16
"""Maximum chunks per read, so that a flood does not block the simulation."""

_LAST_CHANCES, _LAST_CHANCE_S = 10, 0.01
"""Number and duration of the waits for the last bytes when closing [wall s]."""

_NO_UART = ("ttyACM", "pts/", "cu.usbmodem", "tty.usbmodem")
"""Names of devices without a UART: USB's serial class, and pseudo-terminals."""

_GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL

_BUSY = (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK)
_LATER = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR)


class SerialLostError(Exception):
    """The device was unplugged, or its driver failed."""


class SerialPort:
    """Open serial device."""

    def __init__(self, device: str, baud: int = DEFAULT_BAUD) -> None:
        """Open a device exclusively, 8N1, without flow control and old data, or raise UsageError.

        Prefer paths of /dev/serial/by-id. USB and pseudo-terminals ignore `baud` [bits/s].
        """
        check_baud(baud)
        self.device = device
        self.dropped = 0
        """Number of writes dropped because the line was full."""
        try:
            self._port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            raise errors.UsageError(_open_problem(device, baud, error)) from error
        self._waiting = bytearray()
        self._fd: int = self._port.fileno()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def read(self) -> bytes:
        """Return received data, b"" = no data. Raises SerialLostError if the device is gone."""
        received = bytearray()
        for _ in range(_CHUNKS_PER_READ):
            try:
                # Poll first: a terminal reads as b"" both without data and after a hang-up.
                events = self._poll.poll(0)
                if not events:
                    break
                chunk = os.read(self._fd, _CHUNK) if events[0][1] & select.POLLIN else b""
            except OSError as error:
                if error.errno in _LATER:
                    break
                if received:
                    break  # return the earlier data; the next read raises
                raise SerialLostError(self._lost(error)) from error
            if not chunk:
                if received:
                    break
                raise SerialLostError(self._lost(None))
            received += chunk
            if len(chunk) < _CHUNK and not events[0][1] & _GONE:
                break
        return bytes(received)

    def write(self, data: bytes) -> bool:
        """Queue data to be sent; False when the queue is full. Raises SerialLostError."""
        self.drain()
        if len(self._waiting) + len(data) > BUFFER_BYTES:
            self.dropped += 1
            return False
        self._waiting += data
        self.drain()
        return True

    def drain(self) -> None:
        """Send as much of the queue as the line accepts. Raises SerialLostError if it is lost."""
        while self._waiting:
            # Not pyserial's write: without a timeout it spins until the line is free.
            try:
                sent = os.write(self._fd, self._waiting)
            except OSError as error:
                if error.errno in _LATER:
                    return
                raise SerialLostError(self._lost(error)) from error
            if not sent:
                return
            del self._waiting[:sent]

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._fd

    def close(self) -> None:
        """Close the device; data that the line does not accept soon are lost. Idempotent."""
        with suppress(SerialLostError, OSError, TypeError):  # raised by a closed pyserial port
            for _ in range(_LAST_CHANCES):
                self.drain()
                if not self._waiting and not self._port.out_waiting:
                    break
                select.select([], [], [], _LAST_CHANCE_S)
            else:
                # Otherwise closing a blocked line would wait until it accepts the data.
                self._port.reset_output_buffer()
        with suppress(OSError):
            self._port.close()

    def _lost(self, error: OSError | None) -> str:
        why = "it hung up" if error is None else str(error.strerror)
        return f"{self.device} is gone ({why}): unplugged, or the board was reset"


def check_baud(baud: int) -> None:
    """Raise UsageError if the baud rate is out of range."""
    if baud not in BAUDS:
        raise errors.UsageError(f"--baud {baud}: must be in {BAUDS[0]}..{BAUDS[-1]}")


def carries_bytes_s(device: str, baud: int) -> int | None:
    """Return the line's capacity each way [bytes/s]; None if the baud rate has no effect."""
    # /dev/serial/by-id contains symbolic links.
    path = str(Path(device).resolve())
    if any(name in path for name in _NO_UART):
        return None
    return baud // BITS_PER_BYTE


def _open_problem(device: str, baud: int, error: Exception) -> str:
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        present = ", ".join(sorted(port.device for port in list_ports.comports()))
        return f"--serial {device}: no such device; present: {present or 'none'}"
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"--serial {device}: no permission: add yourself to the device's group (Linux: "
            "sudo usermod -aG dialout $USER, then log in again)"
        )
    if number in _BUSY:
        return (
            f"--serial {device}: another program has it open (QGroundControl, ModemManager, "
            "another simulator): close that one first"
        )
    if isinstance(error, ValueError):
        return f"--baud {baud}: {device} does not support it ({error})"
    return f"--serial {device}: no serial device ({error})"

"""Non-blocking serial port, or a USB device that acts as a serial port."""

from __future__ import annotations

import errno
import os
import select
from contextlib import suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from airl_mav.core.errors import UsageError

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
            raise UsageError(_open_problem(device, baud, error)) from error
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
        raise UsageError(f"--baud {baud}: must be in {BAUDS[0]}..{BAUDS[-1]}")


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

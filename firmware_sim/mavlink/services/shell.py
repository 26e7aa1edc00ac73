"""SERIAL_CONTROL: PX4's shell over MAVLink, with a handful of commands that only read.

Source: PX4 1.16, MavlinkReceiver::handle_message_serial_control, and what its shell prints.
"""

from __future__ import annotations

import struct

from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Context
from firmware_sim.mavlink.services.shell_commands import run

PROMPT = "pxh> "

DATA_BYTES = 70
"""Most text in one message."""

MESSAGES_PER_TICK = 10

_SERIAL_CONTROL = struct.Struct(f"<IHBBB{DATA_BYTES}s")
"""As it is on the wire: rate, timeout, device, flags, count, data."""
_SHELL = dialect.SERIAL_CONTROL_DEV_SHELL, dialect.SERIAL_CONTROL_FLAG_REPLY

_LONGEST_LINE = 256
"""What is typed beyond this before the line ends is dropped [bytes]."""

_LONGEST_OUTPUT = 1 << 17
"""Text that waits to be sent; a client that asks for more before it was sent gets no more."""


def handle_input(message: WireMessage, context: Context) -> bool:
    """Take what was typed, run each line that ended."""
    if (
        message.device != dialect.SERIAL_CONTROL_DEV_SHELL
        or message.flags & dialect.SERIAL_CONTROL_FLAG_REPLY
    ):
        return False
    shell = context.shell
    for byte in bytes(message.data[: message.count]):
        if byte not in b"\r\n":
            if len(shell.line) < _LONGEST_LINE:
                shell.line.append(byte)
            continue
        line = shell.line.decode("ascii", errors="replace")
        shell.line.clear()
        if len(shell.output) < _LONGEST_OUTPUT:
            printed = run(line.split(), context.port, context.now_us)
            shell.output += f"{line}\n{printed}{PROMPT}".encode("ascii", errors="replace")
    return True


def send_pending(context: Context) -> None:
    """Send the next part of what was printed; call once per tick."""
    output = context.shell.output
    for _ in range(MESSAGES_PER_TICK):
        if not output:
            return
        part = bytes(output[:DATA_BYTES])
        del output[:DATA_BYTES]
        no_timeout = no_rate = 0
        context.link.send_payload(
            "SERIAL_CONTROL", _SERIAL_CONTROL.pack(no_rate, no_timeout, *_SHELL, len(part), part)
        )

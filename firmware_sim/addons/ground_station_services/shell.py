"""SERIAL_CONTROL: PX4's shell over MAVLink, with a few read-only commands.

Source: PX4 1.16, MavlinkReceiver::handle_message_serial_control, and the output of its shell.
"""

from __future__ import annotations

import fnmatch
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot import autopilot, autopilot_state, flight_modes, snapshot
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services import Context, Handlers, ServiceState, for_anyone

PROMPT = "pxh> "

DATA_BYTES = 70
"""Maximum text in one message [bytes]."""

MESSAGES_PER_TICK = 10

_SERIAL_CONTROL = struct.Struct(f"<IHBBB{DATA_BYTES}s")
"""Wire format: rate, timeout, device, flags, count, data."""
_SHELL = dialect.SERIAL_CONTROL_DEV_SHELL, dialect.SERIAL_CONTROL_FLAG_REPLY

_LONGEST_LINE = 256
"""Maximum length of a line [bytes]. Further input before the end of the line is dropped."""

_LONGEST_OUTPUT = 1 << 17
"""Unsent output above which new commands are dropped [bytes]."""


@dataclass(slots=True)
class Shell(ServiceState):
    """Shell state of one client."""

    line: bytearray = field(default_factory=bytearray)
    output: bytearray = field(default_factory=bytearray)

    @property
    def is_running(self) -> bool:
        """True if output remains to be sent."""
        return bool(self.output)


def handle_input(message: WireMessage, context: Context) -> bool:
    """Read input and run each complete line."""
    if (
        message.device != dialect.SERIAL_CONTROL_DEV_SHELL
        or message.flags & dialect.SERIAL_CONTROL_FLAG_REPLY
    ):
        return False
    shell = context.state(Shell)
    # The client may send a line in several messages, or several lines in one.
    for byte in bytes(message.data[: message.count]):
        if byte not in b"\r\n":
            if len(shell.line) < _LONGEST_LINE:
                shell.line.append(byte)
            continue
        line = shell.line.decode("ascii", errors="replace")
        shell.line.clear()
        # A client that never reads must not grow the buffer without limit.
        if len(shell.output) < _LONGEST_OUTPUT:
            printed = run(line.split(), context.port, context.now_us)
            shell.output += f"{line}\n{printed}{PROMPT}".encode("ascii", errors="replace")
    return True


def send_pending(context: Context) -> None:
    """Send the next part of the output; call once per tick."""
    shell = context.states.get(Shell)
    if shell is None:
        return
    output = shell.output
    for _ in range(MESSAGES_PER_TICK):
        if not output:
            return
        part = bytes(output[:DATA_BYTES])
        del output[:DATA_BYTES]
        no_timeout = no_rate = 0
        context.link.send_payload(
            "SERIAL_CONTROL", _SERIAL_CONTROL.pack(no_rate, no_timeout, *_SHELL, len(part), part)
        )


# --- commands: each prints PX4's output, as far as available here

Shown = Callable[[Sequence[str], autopilot.BuiltinAutopilot, int], str]
"""Returns the output of a command, given its arguments, the autopilot, and the time [µs]."""


def run(words: Sequence[str], port: autopilot.BuiltinAutopilot, now_us: int) -> str:
    """Return the output of a command line, in whole lines."""
    if not words:
        return ""
    command = COMMANDS.get(words[0])
    if command is None:
        return f"Invalid command: {words[0]}\ntype 'help' for a list of commands\n"
    return command(words[1:], port, now_us)


def _version(_words: Sequence[str], port: autopilot.BuiltinAutopilot, _now_us: int) -> str:
    """Run ver."""
    release = port.parameters.release
    return f"HW arch: AIRL_SITL\nPX4 version: {release.version} (emulated by airl-mav)\n"


def _parameters(words: Sequence[str], port: autopilot.BuiltinAutopilot, _now_us: int) -> str:
    """Run param show [NAME, with * and ?]."""
    # Only `show` is supported: the shell is read-only.
    if not words or words[0] != "show" or len(words) > 2:
        return "usage: param show [NAME]\n"
    pattern = words[1] if len(words) == 2 else "*"
    lines = ["Symbols: x = used, + = saved, * = unsaved"]
    store = port.parameters
    for index in range(len(store)):
        found = store.by_index(index)
        if found is not None and fnmatch.fnmatchcase(found.name, pattern):
            value = found.value
            # PX4 prints floats with four decimals.
            text = f"{value}" if isinstance(value, int) else f"{value:.4f}"
            lines.append(f"x   {found.name} [{index},{index}] : {text}")
    return "\n".join([*lines, "", f" {len(store)}/{len(store)} parameters used.", ""])


def _commander(words: Sequence[str], port: autopilot.BuiltinAutopilot, _now_us: int) -> str:
    if list(words) != ["status"]:
        return "usage: commander status\n"
    status = port.state().status
    armed = "Armed" if status.arming is autopilot_state.Arming.ARMED else "Disarmed"
    lines = (
        armed,
        f"navigation mode: {_title(status.mode)}",
        f"user intended navigation mode: {_title(status.intended_mode)}",
        f"in failsafe: {'yes' if status.failsafe else 'no'}",
    )
    return "".join(f"INFO  [commander] {line}\n" for line in lines)


def _title(mode: flight_modes.Mode) -> str:
    return mode.name.replace("_", " ").title()


def _local_position(state: snapshot.AutopilotState) -> dict[str, float]:
    estimate = state.estimate
    names = ("x", "y", "z", "vx", "vy", "vz")
    return dict(zip(names, (*estimate.position.tolist(), *estimate.velocity.tolist()), strict=True))


def _attitude(state: snapshot.AutopilotState) -> dict[str, float]:
    return {f"q[{i}]": q for i, q in enumerate(state.estimate.quaternion.tolist())}


def _battery(state: snapshot.AutopilotState) -> dict[str, float]:
    battery = state.battery
    return {
        "voltage_v": battery.voltage_v,
        "current_a": battery.current_a,
        "discharged_mah": battery.consumed_mah,
        "remaining": battery.remaining,
    }


def _vehicle_status(state: snapshot.AutopilotState) -> dict[str, float]:
    status = state.status
    return {
        "armed_time": state.armed_us,
        "takeoff_time": state.takeoff_us,
        "arming_state": 2 if status.arming is autopilot_state.Arming.ARMED else 1,
        "failsafe": status.failsafe,
        "pre_flight_checks_pass": status.arming is not autopilot_state.Arming.BOOT,
    }


_TOPICS: Mapping[str, Callable[[snapshot.AutopilotState], Mapping[str, float]]] = {
    "battery_status": _battery,
    "vehicle_attitude": _attitude,
    "vehicle_local_position": _local_position,
    "vehicle_status": _vehicle_status,
}


def _listener(words: Sequence[str], port: autopilot.BuiltinAutopilot, now_us: int) -> str:
    """Run listener TOPIC: print its newest message once."""
    topic = words[0] if words else ""
    fields = _TOPICS.get(topic)
    if fields is None:
        topics = " ".join(sorted(_TOPICS))
        return f"Topic {topic} did not match any known topics\nthere are: {topics}\n"
    state = port.state()
    age_s = (now_us - state.time_us) / US_PER_S
    lines = [f"    timestamp: {state.time_us} ({age_s:.6f} seconds ago)"]
    lines += [f"    {name}: {_formatted(value)}" for name, value in fields(state).items()]
    return "\n".join(["", f"TOPIC: {topic}", f" {topic}", *lines, "", ""])


def _formatted(value: float) -> str:
    return f"{value:.4f}" if isinstance(value, float) else f"{value}"


COMMANDS: Mapping[str, Shown] = {
    "commander": _commander,
    "help": lambda *_: "".join(f"  {name}\n" for name in sorted(COMMANDS)),
    "listener": _listener,
    "param": _parameters,
    "uptime": lambda _words, _port, now_us: (
        f"Uptime: {now_us / US_PER_S:.3f} s of simulated time\n"
    ),
    "ver": _version,
}

HANDLERS: Handlers = {"SERIAL_CONTROL": (for_anyone, handle_input)}

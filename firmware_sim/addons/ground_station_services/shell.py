"""SERIAL_CONTROL: PX4's shell over MAVLink.

Commands act through the services of MAVLink commands and parameters, with their checks and records.
Source: PX4 1.17, MavlinkReceiver::handle_message_serial_control, and the output of its shell.
"""

from __future__ import annotations

import fnmatch
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from airl_mav.core.addons import entries, load
from airl_mav.core.constants import TICK_S, TICK_US, US_PER_S
from airl_mav.profiles.loading import read_table
from firmware_sim.autopilot.autopilot_state import Arming, Result, Severity
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.parameter_store import ParameterValue
from firmware_sim.mavlink import services, telemetry
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services import Context, commands, params
from firmware_sim.mavlink.streams.status import UID

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
class Shell(services.ServiceState):
    """Shell state of one client."""

    line: bytearray = field(default_factory=bytearray)
    output: bytearray = field(default_factory=bytearray)
    listening: tuple[Any, int] | None = None
    """Topic of `listener`, and the number of messages to come."""
    heard_us: int = 0
    """Time of its newest message [µs]."""

    @property
    def is_running(self) -> bool:
        """True if output remains to be sent."""
        return bool(self.output) or self.listening is not None


def handle_input(message: WireMessage, context: Context) -> bool:
    """Read input and run each complete line; return whether a command acts on the vehicle."""
    if (
        message.device != dialect.SERIAL_CONTROL_DEV_SHELL
        or message.flags & dialect.SERIAL_CONTROL_FLAG_REPLY
    ):
        return False
    shell, has_acted = context.state(Shell), False
    shell.listening = None
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
            printed, acts = run(line.split(), context)
            has_acted = has_acted or acts
            shell.output += f"{line}\n{printed}{PROMPT}".encode("ascii", errors="replace")
    return has_acted


def send_pending(context: Context) -> None:
    """Send the next part of the output; call once per tick."""
    shell = context.states.get(Shell)
    if shell is None:
        return
    output = shell.output
    logged = shell.listening
    if logged and context.now_us >= shell.heard_us + max(logged[0].interval_us, TICK_US):
        output += listen(context).encode("ascii")
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

_TABLES: dict[str, Any] = read_table(__file__)
COMMANDS: Mapping[str, dict[str, Any]] = _TABLES["commands"]
"""Commands by name: one to three words."""


def run(words: list[str], context: Context) -> tuple[str, bool]:
    """Return the output of a command line, in whole lines, and whether it acts on the vehicle."""
    if not words:
        return "", False
    names = [name for n in (3, 2, 1) if (name := " ".join(words[:n])) in COMMANDS]
    if names:
        command, rest = COMMANDS[names[0]], words[len(names[0].split()) :]
        function = _FUNCTIONS.get(names[0])
        printed = function(rest, context) if function else _by_table(names[0], rest, context)
        if printed is not None:
            return printed, "acts" in command
    usages = [line for line in _help([], context).splitlines() if line.split()[0] == words[0]]
    if usages:
        return "".join(f"usage: {line.strip()}\n" for line in usages), False
    if words[0] in _TABLES["elsewhere"]["names"].split():
        return f"{words[0]}: only in PX4, not in the built-in flight controller\n", False
    return f"Invalid command: {words[0]}\ntype 'help' for a list of commands\n", False


def _by_table(called: str, words: list[str], context: Context) -> str | None:
    """Run a command that the table describes; return None for wrong arguments."""
    command = COMMANDS[called]
    forced = words == ["-f"] and "force" in command
    if words and not forced and words != [command.get("usage")]:
        return None
    for sent in command.get("send", ()):
        name, *values = sent.split()
        force = [command["force"]] if forced else []
        if rejected := _act(called.split()[0], name, context, *map(float, values), *force):
            return rejected
    text: str = command.get("text", "")
    return text.format_map(facts(context)) if text else ""


def facts(context: Context) -> dict[str, Any]:
    """Return the values for the formats of `shell.toml`."""
    port, now_s = context.port, context.now_us / US_PER_S
    state, log = port.state(), port.logs.open_log()
    kib = 0.0 if log is None else log.size_bytes / 1024
    return {
        "state": state,
        "link": context.link,
        "now_s": now_s,
        "tick_s": TICK_S,
        "idle": 1.0 - state.load,
        "armed": "Armed" if state.status.arming is Arming.ARMED else "Disarmed",
        "failsafe": "yes" if state.status.failsafe else "no",
        "checks": "OK" if state.health.armable else "FAILED",
        "located": state.health.position and state.origin is not None,
        "logging": "not logging" if log is None else f"Running, log number {log.number}",
        "log_mib": kib / 1024,
        "log_kib_s": kib / max(now_s, TICK_S),
        "release": port.parameters.release,
        "uid": UID,
    }


def _printed(module: str, line: str, level: str = "ERROR") -> str:
    return f"{level:5} [{module}] {line}\n"


def _act(module: str, name: str, context: Context, *values: float) -> str:
    """Execute a MAVLink command, given by its name; print only a rejection."""
    given: Any = *values, *(math.nan,) * (7 - len(values))
    number = getattr(dialect, f"MAV_CMD_{name}")
    sent = services.VehicleCommand(number, given, (context.system_id, 1))
    result = commands.execute(sent, context)
    if result is Result.ACCEPTED:
        return ""
    return _printed(module, f"{name}: {'no reply' if result is None else result.name}")


def _mode(words: list[str], context: Context) -> str | None:
    if len(words) != 1:
        return None
    state = _TABLES["modes"].get(words[0])
    spec = next((mode.spec for mode in Mode if mode.spec.state == state), None)
    if spec is None:
        known = " ".join(_TABLES["modes"])
        return _printed("commander", f"argument {words[0]} unsupported: there are {known}")
    return _act("commander", "DO_SET_MODE", context, 1, spec.main, spec.sub)


def _number(value: float) -> str:
    # PX4 prints floats with four decimals.
    return f"{value}" if isinstance(value, int) else f"{value:.4f}"


def _found(context: Context, patterns: list[str]) -> list[ParameterValue]:
    """Return the parameters whose names match any pattern, in any case."""
    store = context.port.parameters
    found = filter(None, map(store.by_index, range(len(store))))
    return [p for p in found if any(fnmatch.fnmatchcase(p.name, e.upper()) for e in patterns)]


def _show(words: list[str], context: Context) -> str | None:
    patterns = [word for word in words if word != "-c"]
    if len(patterns) > 1:
        return None
    store = context.port.parameters
    changed, count = store.changed(), len(store)
    lines = [
        f"x {'+' if p.name in changed else ' '} {p.name} [{p.index},{p.index}] : {_number(p.value)}"
        for p in _found(context, patterns or ["*"])
        if "-c" not in words or p.name in changed
    ]
    head = "Symbols: x = used, + = saved, * = unsaved"
    return "\n".join([head, *lines, "", f" {count}/{count} parameters used.", ""])


def _set(words: list[str], context: Context, *, compare: bool = False) -> str | None:
    if len(words) != 2:
        return None
    present = context.port.parameters.by_name(words[0])
    if present is None:
        return _printed("param", f"Parameter {words[0]} not found.")
    try:
        value = float(words[1])
    except ValueError:
        return _printed("param", f"{words[0]}: {words[1]}: accepted: a number")
    if compare:
        same = math.isclose(present.value, value, abs_tol=1e-7)
        return "" if same else f"  {present.name}: curr: {_number(present.value)}\n"
    stored = params.store_parameter(present.name, value, context)
    if stored is None or stored.value == present.value:
        return ""
    return f"+ {present.name}: curr: {_number(present.value)} -> new: {_number(stored.value)}\n"


def _reset(words: list[str], context: Context) -> str | None:
    if not words:
        return None
    names = [p.name for p in _found(context, words)]
    context.port.parameters.reset(names)
    return "" if names else _printed("param", f"param {words[0]} not found")


def _topics() -> list[Any]:
    """Return the module of the topics; none without the add-on `flight_log`."""
    return [load(place) for place in entries("firmware_sim", "TOPICS").values()]


def _listener(words: list[str], context: Context) -> str | None:
    count = _option(words, "-n", 1)
    if count is None or len(words) not in (1, 3):
        return None
    known = {logged.topic.name: logged for topics in _topics() for logged in topics.TOPICS}
    if words[0] not in known:
        names = " ".join(sorted(known))
        return f"Topic {words[0]} did not match any known topics\nthere are: {names}\n"
    context.state(Shell).listening = known[words[0]], count
    return listen(context)


def _option(words: list[str], flag: str, default: int) -> int | None:
    """Return the number after a flag before the end; None = not a number."""
    if flag not in words[-2:-1]:
        return default
    return int(words[-1]) if words[-1].isdecimal() else None


def listen(context: Context) -> str:
    """Return the next message of the listened topic; count it."""
    shell = context.state(Shell)
    if shell.listening is None:
        return ""
    logged, count = shell.listening
    shell.listening = (logged, count - 1) if count > 1 else None
    shell.heard_us = context.now_us
    state, name = context.port.state(), logged.topic.name
    flown, known = telemetry.flown_of(state), logged.rows in ("flown", "state")
    (topics,) = _topics()
    rows = logged.messages(topics.Moment(flown, flown[:0], state)) if known else None
    if rows is None or not len(rows):
        return f"\nTOPIC: {name}\nnever published\n"
    return f"\nTOPIC: {name}\n {name}\n{_fields(rows[0], context.now_us)}\n"


def _fields(row: Any, now_us: int) -> str:
    """Return the fields of a message, one a line, as PX4 prints them."""
    lines = []
    for name in row.dtype.names:
        value, note = row[name], ""
        if name.startswith("_"):
            continue
        if name == "timestamp":
            note = f" ({(now_us - int(value)) / US_PER_S:.6f} seconds ago)"
        elif name == "timestamp_sample":
            note = f" ({int(row['timestamp']) - int(value)} us before timestamp)"
        shown = [_field(each) for each in value.reshape(-1).tolist()]
        text = f"[{', '.join(shown)}]" if value.shape else shown[0]
        lines.append(f"    {name}: {text}{note}\n")
    return "".join(lines)


def _field(value: float) -> str:
    return f"{value:.5f}" if isinstance(value, float) else f"{value}"


def _uorb(_words: list[str], _context: Context) -> str:
    rows = [
        (each.topic.name, round(US_PER_S / each.interval_us), each.topic.blank.dtype.itemsize - 5)
        for topics in _topics()
        for each in topics.TOPICS
        if each.interval_us
    ]
    per_s, rate = sum(hz for _, hz, _ in rows), sum(hz * size for _, hz, size in rows) / 1e3
    head = f"update: 1s, topics: {len(rows)}, total publications: {per_s}, {rate:.1f} kB/s"
    lines = [f"{name:36}  0    1 {hz:4}  1 {size:4} " for name, hz, size in rows]
    return "\n".join([head, f"{'TOPIC NAME':34} INST #SUB RATE #Q SIZE", *lines, ""])


def _streams(_words: list[str], context: Context) -> str:
    scheduler = context.link.scheduler
    periods = ((name, scheduler.interval_us(name)) for name in context.link.builders)
    rates = ((f"{name:30}", US_PER_S / us) for name, us in periods if us > 0)
    head = f"\t{'Name':20}{'Rate Config (current) [Hz]':16} Message Size (if active) [B]"
    return "\n".join([head, *(f"\t{name}{hz:6.2f} ({hz:.3f})" for name, hz in rates), ""])


def _failure(words: list[str], context: Context) -> str | None:
    instance = _option(words, "-i", 0)
    if instance is None or len(words) not in (2, 4):
        return None
    enabled = context.port.parameters.by_name("SYS_FAILURE_EN")
    if enabled is None or not enabled.value:
        return _printed("failure", "Failure injection disabled by SYS_FAILURE_EN param.")
    numbers = []
    for word, title, kind in (
        (words[0], "Component", "units"),
        (words[1], "Failure type", "types"),
    ):
        name = _TABLES[kind].get(word)
        if name is None:
            known = " ".join(_TABLES[kind])
            return _printed("failure", f"{title} '{word}' not found: there are {known}")
        numbers.append(getattr(dialect, f"FAILURE_{kind[:-1].upper()}_{name}"))
    unit, kind = (f"{word} ({number})" for word, number in zip(words, numbers, strict=False))
    text = f"inject failure unit: {unit}, type: {kind}, instance: {instance}"
    return _printed("failure", text, "WARN") + _act(
        "failure", "INJECT_FAILURE", context, *numbers, instance
    )


def _dmesg(_words: list[str], context: Context) -> str:
    levels = {Severity.WARNING: "WARN", Severity.NOTICE: "INFO", Severity.INFO: "INFO"}
    said = context.port.said
    return "".join(_printed("commander", t.text, levels.get(t.severity, "ERROR")) for t in said)


def _help(_words: list[str], _context: Context) -> str:
    usages = (f"  {name} {c.get('usage', '')}" for name, c in COMMANDS.items())
    return "".join(f"{usage.rstrip()}\n" for usage in usages)


_FUNCTIONS: Mapping[str, Callable[[list[str], Context], str | None]] = {
    "commander mode": _mode,
    "dmesg": _dmesg,
    "failure": _failure,
    "help": _help,
    "listener": _listener,
    "mavlink status streams": _streams,
    "param compare": lambda words, context: _set(words, context, compare=True),
    "param reset": _reset,
    "param set": _set,
    "param show": _show,
    "uorb status": _uorb,
    "uorb top": _uorb,
}
"""Functions of commands, given arguments and client; they return None for wrong arguments."""

HANDLERS: services.Handlers = {"SERIAL_CONTROL": (services.for_anyone, handle_input)}

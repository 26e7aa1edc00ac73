"""MAVLink fuzz test in flight: random bytes, damaged frames, and valid ones with absurd contents.

    python scripts/fuzz_mavlink.py --frames 10000000
    python scripts/fuzz_mavlink.py --steering --frames 200000

Flies the built-in flight controller in short flights, with logs, while both links receive the
maximum rate of a client. Draws every message that a service reads, with values from the limits of
their types, and with existing commands, parameters, files, shell words and addressees. With
`--steering` it draws only steering messages, a frame every few ticks, so that the vehicle executes
each before the next. It ends at the first exception or motor command outside 0..1 or NaN, and
prints the flight, which `--first` repeats.
"""

from __future__ import annotations

import resource
import struct
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tyro

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.profiles.px4_release import px4_release
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.firmware import BuiltinFlightStack, Firmware
from firmware_sim.mavlink.codec import Encoder, WireLayout, dialect, message_id
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.services import table
from firmware_sim.pacing import Unpaced
from firmware_sim.simulation import EpisodeSetup

FRAMES_PER_TICK = 8
"""Frames on each link: the maximum of one client."""

STEERING = (
    *("COMMAND_LONG", "COMMAND_INT", "COMMAND_LONG", "COMMAND_INT", "LANDING_TARGET"),
    *("FOLLOW_TARGET", "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"),
    *("SET_ATTITUDE_TARGET", "SET_GPS_GLOBAL_ORIGIN", "MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"),
    *("MISSION_ITEM_INT", "MISSION_COUNT", "MISSION_SET_CURRENT", "SET_MODE"),
)
"""Steering messages; repeated names are drawn more often."""

STEERING_COMMANDS = (
    *(16, 17, 20, 21, 22, 23, 34, 48, 176, 178, 179, 186, 192, 193, 195, 197, 201, 252, 300, 400),
)
MODES = ((4, 2), (4, 3), (4, 4), (4, 5), (4, 6), (4, 8), (4, 9), (6, 0), (3, 0), (2, 0), (3, 2))
"""Main and sub modes of PX4."""
STEERING_TICKS = 5

BOOT_TICKS = 1_750
CLIMB_TICKS = 500

FLOATS = (0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, 1e-30, 47.4, 8.5)

PARAMETERS = tuple(spec.name.encode() for spec in px4_release().specs)

KNOWN: Mapping[str, tuple[int, ...]] = {
    "target_system": (1, 1, 1, 1, 1, 1, 1, 1, 1, 0),
    "target_component": (1, 1, 1, 1, 1, 1, 1, 1, 1, 0),
    "command": tuple(table("ACTIONS")),
    "param_type": (6, 9),
    "device": (10,),
    "flags": (0, 2, 6),
    "count": (0, 1, 2, 5, 70, 90, 255),
    "frame": (0, 2, 3, 5, 6, 10, 11),
    "coordinate_frame": (1, 5, 6, 7, 8, 9, 11, 12),
    "type_mask": (0, 0x9C7, 0x5C7, 0x9F8, 0xDC7, 0xFFF, 0x7, 0x38, 0x1C0),
}
"""Valid field values, beside small numbers."""

FTP_HEADER = struct.Struct("<HBBBBBxI")
PATHS = (
    b"", b"/", b".", b"..", b"/etc", b"etc/extras/parameters.json.xz", b"../../etc/passwd", b"a",
    b"a/b", b"a/../..", b"/a" * 100, b"\xff\xfe", b"x" * 239,
)  # fmt: skip
WORDS = (
    b"param", b"show", b"*", b"MPC_*", b"?" * 20, b"*a" * 20, b"listener", b"vehicle_status",
    b"commander", b"status", b"ver", b"all", b"help", b"uptime", b"reboot", b"\n", b"\r", b"\xff",
)  # fmt: skip

_BLOCK = 8_192
_T = TypeVar("_T")


class Dice:
    """Draws of a seeded generator, in blocks: single draws cost ten times as much."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._left: list[float] = []

    def random(self) -> float:
        """Return a number in [0, 1)."""
        if not self._left:
            self._left = self.rng.random(_BLOCK).tolist()
        return self._left.pop()

    def below(self, end: int) -> int:
        """Return an integer from 0 to `end` - 1."""
        return int(self.random() * end)

    def one_of(self, choices: Sequence[_T]) -> _T:
        """Return a random choice."""
        return choices[self.below(len(choices))]

    def bytes(self, longest: int, shortest: int = 0) -> bytes:
        """Return random bytes."""
        return self.rng.bytes(shortest + self.below(longest - shortest + 1))


class Fuzzer:
    """Generator of frames from a hostile or faulty client."""

    def __init__(self, rng: np.random.Generator, *, steering: bool = False) -> None:
        self._dice = dice = Dice(rng)
        # A signing key would reject all later frames.
        names = (
            STEERING
            if steering
            else [name for name in table("HANDLERS") if name != "SETUP_SIGNING"]
        )
        known = {**KNOWN, "command": STEERING_COMMANDS} if steering else KNOWN
        self._kinds = [_Kind(dialect.mavlink_map[message_id(name)], dice, known) for name in names]
        self._encoders = [Encoder(245, 190), Encoder(1, 191), Encoder(0, 0), Encoder(255, 255)]

    def frame(self) -> bytes:
        """Return random bytes, a damaged frame, or a valid one."""
        dice = self._dice
        chance = dice.random()
        if chance < 0.05:
            return dice.bytes(400, 1)
        frame = self._valid()
        if chance < 0.15:
            damaged = bytearray(frame)
            for _ in range(1 + dice.below(5)):
                damaged[dice.below(len(damaged))] = dice.below(256)
            return bytes(damaged[: 1 + dice.below(len(damaged))])
        return frame

    def steering(self) -> bytes:
        """Return a valid frame, often a mode request."""
        if self._dice.random() < 0.3:
            main, sub = self._dice.one_of(MODES)
            return self._encoders[0].pack(
                dialect.MAVLink_command_long_message(1, 1, 176, 0, 1, main, sub, 0, 0, 0, 0)
            )
        return self._valid()

    def _valid(self) -> bytes:
        dice = self._dice
        kind = dice.one_of(self._kinds)
        encoder = self._encoders[0] if dice.random() < 0.9 else dice.one_of(self._encoders)
        return encoder.frame(kind.layout, kind.layout.payload(kind.values()))


class _Kind:
    """Message type: its layout, and the generators of its fields."""

    def __init__(self, kind: Any, dice: Dice, known: Mapping[str, tuple[int, ...]]) -> None:
        self.layout = WireLayout(kind)
        lengths = dict(zip(kind.ordered_fieldnames, kind.lengths, strict=True))
        self._fields = [
            _drawn(kind.msgname, name, of, lengths[name], dice, known)
            for name, of in zip(kind.fieldnames, kind.fieldtypes, strict=True)
        ]

    def values(self) -> list[Any]:
        """Return a value for each slot of the message."""
        return [value for draw in self._fields for value in draw()]


def _drawn(
    message: str,
    name: str,
    of: str,
    length: int,
    dice: Dice,
    known: Mapping[str, tuple[int, ...]],
) -> Callable[[], Iterable[Any]]:
    """Return the generator of a field's values."""
    special = {
        ("FILE_TRANSFER_PROTOCOL", "payload"): _ftp_request,
        ("SERIAL_CONTROL", "data"): _typed,
    }.get((message, name))
    if special is not None:
        return lambda: special(dice) if dice.random() < 0.8 else dice.bytes(length, length)
    if of == "char":
        names = PARAMETERS if name == "param_id" else (b"",)
        return lambda: (dice.one_of(names) if dice.random() < 0.8 else dice.bytes(20),)
    if of in ("float", "double"):
        return lambda: [_real(dice) for _ in range(length)]
    if of == "uint8_t" and length > 1:
        return lambda: dice.bytes(length, length)
    whole = _whole(known.get(name, tuple(range(12))), of)
    return lambda: [whole(dice) for _ in range(length)]


def _real(dice: Dice) -> float:
    chance = dice.random()
    if chance < 0.4:
        return dice.one_of(FLOATS)
    if chance < 0.7:
        return float(dice.below(12))
    return float(np.float32((dice.random() - 0.5) * 10.0 ** (dice.below(13) - 6)))


def _whole(listed: tuple[int, ...], of: str) -> Callable[[Dice], int]:
    """Return a generator of integers: a known one, a limit of the type, or any."""
    bits = int("".join(c for c in of if c.isdigit()))
    low, high = (0, 2**bits - 1) if of[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    ends = (low, high, low + 1, high - 1)
    known = [n for n in listed if low <= n <= high]

    def draw(dice: Dice) -> int:
        chance = dice.random()
        if chance < 0.8:
            return dice.one_of(known)
        return dice.one_of(ends) if chance < 0.9 else low + dice.below(2**bits)

    return draw


def _ftp_request(dice: Dice) -> bytes:
    """Return a request of MAVLink FTP: real operations, on existing and other files."""
    path = dice.one_of(PATHS)
    data = dice.one_of((path, path + b"\0" + dice.one_of(PATHS), dice.bytes(239)))
    size = min(len(data), 255) if dice.random() < 0.7 else dice.below(256)
    offset = dice.one_of((0, 0, 1, 239, 2**31, 2**32 - 1))
    sequence, session = dice.below(2**16), dice.one_of((0, 0, 0, 1))
    header = FTP_HEADER.pack(sequence, session, dice.below(18), size, 0, 0, offset)
    return (header + data)[:251].ljust(251, b"\0")


def _typed(dice: Dice) -> bytes:
    """Return random shell input."""
    words = [dice.one_of(WORDS) for _ in range(1 + dice.below(12))]
    return b" ".join(words)[:70].ljust(70, b"\n")


def fly(seed: int, frames: int, *, steering: bool = False) -> int:
    """Fly once with a number of hostile frames; return the number of frames with effect.

    The vehicle saves its logs, which clients may list and download.

    Raises:
        AssertionError: A motor command is outside 0..1, or the position is not finite.
        Exception: Any other failure.
    """
    fuzzer = Fuzzer(np.random.default_rng(seed), steering=steering)
    setup = EpisodeSetup(load_vehicle("quad"), None, seed)
    ends = MemoryEndpoint(), MemoryEndpoint()
    server = MavlinkServer([onboard_link(ends[0]), gcs_link(ends[1])], boot_unix_us=0)
    stack = BuiltinFlightStack(server)
    with tempfile.TemporaryDirectory() as folder:
        firmware = Firmware(stack, None, Unpaced(), recording=False)
        try:
            firmware.load(setup, Path(folder, "flight-001.tlog"), 0)
            simulation = firmware.simulation
            assert simulation is not None
            autopilot = simulation.autopilot
            assert isinstance(autopilot, BuiltinAutopilot)

            def ticks(number: int) -> None:
                for _ in range(number):
                    firmware.step()
                    for end in ends:
                        end.outbox.clear()

            ticks(BOOT_TICKS)
            autopilot.arm(force=True)
            autopilot.takeoff(3.0)
            ticks(CLIMB_TICKS)
            quiet = sum(link.rx - link.ignored for link in server.counters().values())
            for number in range(frames if steering else -(-frames // (2 * FRAMES_PER_TICK))):
                if steering:
                    if number % 100 == 0:  # It may have landed or crashed
                        autopilot.arm(force=True)
                        autopilot.takeoff(3.0)
                    ends[0].inbox.append(fuzzer.steering())
                else:
                    for end in ends:
                        end.inbox.extend(fuzzer.frame() for _ in range(FRAMES_PER_TICK))
                ticks(STEERING_TICKS if steering else 1)
                motors = autopilot.state().motors
                assert all(0.0 <= motor <= 1.0 for motor in motors), motors
            truth = simulation.plant.truth()
            assert np.isfinite(truth.position).all(), truth
            return sum(link.rx - link.ignored for link in server.counters().values()) - quiet
        finally:
            firmware.close()


@dataclass(frozen=True)
class Fuzz:
    """Feed hostile MAVLink to the flight controller in flight."""

    frames: int = 100_000
    """Total number of frames."""
    per_flight: int = 20_000
    """Frames per flight, which limits the life of set parameters."""
    first: int = 0
    """First flight; its number is its seed."""
    steering: bool = False
    """Send only steering messages, slowly; about 500 frames per flight suffice."""


def main(asked: Fuzz) -> None:
    clock, done, flight = WallClock(), 0, asked.first
    while done < asked.frames:
        try:
            effective = fly(flight, asked.per_flight, steering=asked.steering)
        except BaseException:
            print(f"flight {flight} broke: --first {flight} --per-flight {asked.per_flight}")
            raise
        done += asked.per_flight
        memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        wall_s = clock.time_us() / US_PER_S
        print(
            f"flight {flight}: {effective} of {asked.per_flight} took effect; "
            f"{done} frames in {wall_s:.0f} s, {memory_mb:.0f} MB at most",
            flush=True,
        )
        flight += 1


if __name__ == "__main__":
    main(tyro.cli(Fuzz))

"""Frames of an attacker without the key: forged, replayed and unsigned, of every message kind."""

from __future__ import annotations

import random
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import cycle, islice
from typing import Any

from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.signing import frames_of
from tests.support.processes import HOLD, OFFBOARD, POSITION

SOURCES = ((1, 1), (1, 195), (7, 1), (77, 190), (255, 190))
"""Vehicle, companion, an invented vehicle, two ground stations."""


class ForgedFrames:
    """Endless stream of an attacker's frames."""

    def __init__(self, seed: int = 11) -> None:
        self.sent: Counter[str] = Counter()
        """Number of frames by way of forging."""
        self.kinds: set[int] = set()
        """Message ids so far."""
        self._heard: list[bytes] = []
        self._frames = self._forge(random.Random(seed))

    def hear(self, datagram: bytes) -> None:
        """Keep real frames, to replay and to break them."""
        self._heard += frames_of(datagram)

    def take(self, number: int) -> list[bytes]:
        """Return the next frames."""
        frames = list(islice(self._frames, number))
        self.sent.update(how for how, _ in frames)
        return [frame for _, frame in frames]

    def _forge(self, rng: random.Random) -> Iterator[tuple[str, bytes]]:
        messages = cycle(random_messages(rng))
        while True:
            # The lie that ended flights, then any message.
            mode, armed = rng.choice((HOLD, POSITION, OFFBOARD)), rng.choice((1, 129))
            lie = dialect.MAVLink_heartbeat_message(2, 12, armed, mode, 4, 3)
            for message in (lie, next(messages)):
                mav = dialect.MAVLink(None, *rng.choice(SOURCES))
                self.kinds.add(message.get_msgId())
                yield "unsigned", message.pack(mav)
                if message.get_msgId() < 256:
                    with suppress(struct.error):  # longer than a frame of MAVLink 1
                        yield "unsigned", message.pack(mav, force_mavlink1=True)
                mav.signing.secret_key = rng.randbytes(32)
                mav.signing.sign_outgoing = True
                # A time stamp of the year 2037, on any link.
                mav.signing.link_id, mav.signing.timestamp = rng.randrange(4), 1 << 46
                yield "forged", message.pack(mav)
            if self._heard:
                frame = rng.choice(self._heard)
                yield "replayed", frame
                broken = bytearray(frame)
                broken[rng.randrange(1, len(frame))] ^= 1 << rng.randrange(8)
                yield "forged", bytes(broken)


def random_messages(rng: random.Random) -> list[Any]:
    """Return a message of every kind, in random order."""
    made = []
    for kind in dialect.mavlink_map.values():
        lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
        values: list[Any] = []
        for name, of in zip(kind.fieldnames, kind.fieldtypes, strict=True):
            length = lengths[name]
            if of == "char":
                values.append(b"D1 end"[: length or 1])
                continue
            drawn = [rng.randrange(128) if "int" in of else rng.gauss(0, 9) for _ in range(256)]
            values.append(drawn[:length] if length else drawn[0])
        made.append(kind(*values))
    rng.shuffle(made)
    return made

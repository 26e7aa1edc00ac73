"""Hostile MAVLink in flight: random bytes, damaged frames, and valid ones with absurd contents.

    python scripts/fuzz_mavlink.py --frames 10000000

Flies the built-in flight controller, one short flight after the other, while both links are fed as
much as a client may send. Every message that a service reads is drawn, with values from the ends of
their types, and with commands, parameters and addressees that exist. It ends at the first exception
or motor command that is no number in 0..1, and names the flight, which `--first` flies again.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.profiles.parameters import SPECS
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.mavlink.codec import Encoder, Layout, dialect, message_id
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.link import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.services import HANDLERS
from firmware_sim.mavlink.services.commands import ACTIONS
from firmware_sim.simulation import EpisodeSetup, Simulation

FRAMES_PER_TICK = 8
"""On each link: what one client may send."""

BOOT_TICKS = 1_750
CLIMB_TICKS = 500

FLOATS = (0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, 1e-30, 47.4, 8.5)


class Fuzzer:
    """Draws what a hostile or broken client may send."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        # A key that is set refuses all that comes after it.
        names = [name for name in HANDLERS if name != "SETUP_SIGNING"]
        self._kinds = [dialect.mavlink_map[message_id(name)] for name in names]
        self._layouts = [Layout(kind) for kind in self._kinds]
        self._encoders = [Encoder(245, 190), Encoder(1, 191), Encoder(0, 0), Encoder(255, 255)]
        self._commands = list(ACTIONS)
        self._names = [spec.name.encode() for spec in SPECS]

    def frame(self) -> bytes:
        """Return random bytes, a damaged frame, or a valid one."""
        rng = self._rng
        chance = rng.random()
        if chance < 0.05:
            return bytes(rng.bytes(int(rng.integers(1, 400))))
        frame = self._valid()
        if chance < 0.15:
            damaged = bytearray(frame)
            for _ in range(int(rng.integers(1, 6))):
                damaged[rng.integers(len(damaged))] = rng.integers(256)
            return bytes(damaged[: rng.integers(1, len(damaged) + 1)])
        return frame

    def _valid(self) -> bytes:
        rng = self._rng
        n = int(rng.integers(len(self._kinds)))
        kind, shape = self._kinds[n], self._layouts[n]
        encoder = self._encoders[0 if rng.random() < 0.9 else rng.integers(len(self._encoders))]
        return encoder.frame(shape, shape.payload(list(self._values(kind))))

    def _values(self, kind: Any) -> Iterator[Any]:
        lengths = dict(zip(kind.ordered_fieldnames, kind.lengths, strict=True))
        for name, of in zip(kind.fieldnames, kind.fieldtypes, strict=True):
            for _ in range(lengths[name]):
                yield self._value(name, of)

    def _value(self, name: str, of: str) -> Any:
        rng = self._rng
        sensible = rng.random() < 0.8
        if of == "char":
            if name == "param_id" and sensible:
                return self._names[rng.integers(len(self._names))]
            return bytes(rng.bytes(int(rng.integers(0, 20))))
        if of in ("float", "double"):
            return self._real()
        if sensible:
            if name in ("target_system", "target_component"):
                return int(rng.random() < 0.9)
            if name == "command":
                return int(self._commands[rng.integers(len(self._commands))])
            if name in ("param_type",):
                return (6, 9)[rng.integers(2)]
            return int(rng.integers(0, 12))
        bits = int("".join(c for c in of if c.isdigit()))
        low, high = (0, 2**bits - 1) if of[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        ends = (low, high, low + 1, high - 1)
        if rng.random() < 0.5:
            return ends[rng.integers(4)]
        return low + int.from_bytes(rng.bytes(bits // 8), "little")

    def _real(self) -> float:
        rng = self._rng
        chance = rng.random()
        if chance < 0.4:
            return float(FLOATS[rng.integers(len(FLOATS))])
        if chance < 0.7:
            return float(rng.integers(0, 12))
        return float(np.float32(rng.normal() * 10.0 ** rng.integers(-6, 7)))


def fly(seed: int, frames: int) -> int:
    """Fly once with so many hostile frames; return how many of them took effect.

    Raises AssertionError for a motor command that is no number in 0..1, and whatever else breaks.
    """
    rng = np.random.default_rng(seed)
    fuzzer = Fuzzer(rng)
    sim = Simulation(
        EpisodeSetup(load_vehicle("quad"), None, seed),
        start_us=0,
        clock=SimClock(),
        recording=False,
    )
    autopilot = sim.autopilot
    assert isinstance(autopilot, BuiltinAutopilot)
    ends = MemoryEndpoint(), MemoryEndpoint()
    server = MavlinkServer([onboard_link(ends[0]), gcs_link(ends[1])], autopilot, boot_unix_us=0)
    effective = 0

    def tick() -> None:
        nonlocal effective
        effective += server.receive(sim.time_us)
        sim.tick()
        server.send(sim.time_us)
        for end in ends:
            end.outbox.clear()

    try:
        for _ in range(BOOT_TICKS):
            tick()
        autopilot.arm(force=True)
        autopilot.takeoff(3.0)
        for _ in range(CLIMB_TICKS):
            tick()
        effective = 0
        for _ in range(-(-frames // (2 * FRAMES_PER_TICK))):
            for end in ends:
                end.inbox.extend(fuzzer.frame() for _ in range(FRAMES_PER_TICK))
            tick()
            motors = np.array(autopilot.state().motors)
            assert np.isfinite(motors).all(), motors
            assert motors.min() >= 0.0, motors
            assert motors.max() <= 1.0, motors
    finally:
        sim.close()
    return effective


@dataclass(frozen=True)
class Fuzz:
    """Feed hostile MAVLink to the flight controller in flight."""

    frames: int = 100_000
    """Frames in all."""
    per_flight: int = 20_000
    """Frames of one flight: parameters that were set last as long."""
    first: int = 0
    """First flight; its number is its seed."""


def main(asked: Fuzz) -> None:
    clock, done, flight = WallClock(), 0, asked.first
    while done < asked.frames:
        try:
            effective = fly(flight, asked.per_flight)
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

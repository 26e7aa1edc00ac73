"""Turns: simulated time is frozen while the companion works, until it reports its wake-up time."""

from __future__ import annotations

import hashlib
import struct
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.policy.actions import AnyAction, Policy
from airl_mav.policy.observation import Observation
from companion.watchdog import Poll

COMPANION_STARTS_US = US_PER_S // 10
"""Delay from the boot of the flight controller to the start of the companion [µs]."""


class LockstepError(Exception):
    """Violation of the lockstep protocol by the companion, described in the message."""


@dataclass(frozen=True)
class Turn:
    """End of the companion's turn."""

    wake_us: int | None
    """Requested time of the next turn [µs of simulated time]; None = the companion has ended."""
    interrupt: threading.Event | None = None
    """Event that wakes the companion earlier; None = no event."""
    setpoints_sent: int = 0
    """Number of setpoints that the companion has passed to MAVSDK so far."""
    poll: Poll | None = None
    """Condition that postpones `wake_us`; None = no condition."""


Handle: TypeAlias = "Callable[[bytes], threading.Event | None]"
"""Handler of a frame from the companion, which answers with `Partner.send`. If the answer takes
simulated time, the handler returns an event that is set on its arrival. The companion is blocked
inside MAVSDK, and must be interrupted until then."""


class Partner(Protocol):
    """Interface between the conductor and a companion, in a thread or behind a socket."""

    def send(self, frames: Sequence[bytes]) -> None:
        """Forward telemetry (MAVLink frames); delivered before the companion's next turn begins."""

    def turn(self, now_us: int, handle: Handle) -> Turn:
        """Let the companion run until it sleeps; simulated time is constant at `now_us` [µs].

        `handle` is called with every MAVLink frame that the companion sends. Raises LockstepError
        if the companion does not return the turn.
        """


LANES = ("trajectory", "setpoints", "observations", "telemetry", "commands")
"""Parts of a flight with separate digests. The first different part locates a divergence.

trajectory: true state of every tick. setpoints: executed setpoints with their times. observations:
inputs of the policy. telemetry: bytes of all streams to the companion. commands: frames received by
the flight controller, with their times."""

SEEN = "observations"
"""Part computed by a companion in another process; the simulator computes all others."""

_TIME = struct.Struct("<q")


class FlightDigest:
    """Incremental digest of a flight."""

    def __init__(self) -> None:
        self._lanes = {name: hashlib.sha256() for name in LANES}

    def add(self, lane: str, time_us: int, data: bytes) -> None:
        """Add data to a part of `LANES`, with its simulated time [µs]."""
        self._lanes[lane].update(_TIME.pack(time_us) + data)

    def extend(self, lane: str, data: bytes) -> None:
        """Add rows that contain their times to a part of `LANES`."""
        self._lanes[lane].update(data)

    def add_setpoints(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add all setpoints of the flight by column; call once, at the end."""
        for name, values in columns.items():
            self.add("setpoints", len(values), name.encode() + values.tobytes())

    def lanes(self) -> Mapping[str, str]:
        """Return the SHA-256 of each part, hexadecimal."""
        return {name: lane.hexdigest() for name, lane in self._lanes.items()}

    def hexdigest(self) -> str:
        """Return the SHA-256 of all parts together, hexadecimal."""
        return hashlib.sha256("".join(self.lanes().values()).encode()).hexdigest()


class Unwitnessed(FlightDigest):
    """Digest that discards its input, for real firmware: its flights are not reproducible."""

    def add(self, lane: str, time_us: int, data: bytes) -> None:
        """Discard the data."""

    def extend(self, lane: str, data: bytes) -> None:
        """Discard the data."""


class WitnessedPolicy:
    """Policy wrapper that adds all observations to a digest. Implements `actions.Policy`."""

    def __init__(self, policy: Policy, digest: FlightDigest) -> None:
        self._policy = policy
        self._digest = digest

    def act(self, observation: Observation) -> AnyAction:
        """Return the wrapped policy's action."""
        seen = observation
        numbers = np.array([*seen.goal, *seen.velocity, seen.roll, seen.pitch, seen.yaw])
        data = seen.image.tobytes() + numbers.tobytes()
        for name, view in seen.further.items():
            data += name.encode() + view.image.tobytes()
        self._digest.add("observations", 0, data)
        return self._policy.act(observation)

"""The fingerprint of a flight: equal for equal flights, bit by bit."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.policy.actions import AnyAction, Policy
from airl_mav.policy.observation import Observation

LANES = ("trajectory", "setpoints", "observations", "telemetry", "commands")
"""Parts of a flight with a digest each. The first part that differs shows where a difference began.

trajectory: true state of every tick. setpoints: those flown, with their times. observations: inputs
of the policy. telemetry: bytes of all streams to the companion. commands: frames that the flight
controller received, with their times.
"""

SEEN = "observations"
"""The lane that the companion knows, when it is another process; the other one knows the rest."""

_TIME = struct.Struct("<q")


class FlightDigest:
    """Takes in a flight as it happens."""

    def __init__(self) -> None:
        self._lanes = {name: hashlib.sha256() for name in LANES}

    def add(self, lane: str, time_us: int, data: bytes) -> None:
        """Add what happened in one of the `LANES` at a simulated time [µs]."""
        self._lanes[lane].update(_TIME.pack(time_us) + data)

    def extend(self, lane: str, data: bytes) -> None:
        """Add rows that have their times in them to one of the `LANES`."""
        self._lanes[lane].update(data)

    def add_setpoints(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add all setpoints of the flight, by column; call once, at its end."""
        for name, values in columns.items():
            self.add("setpoints", len(values), name.encode() + values.tobytes())

    def lanes(self) -> Mapping[str, str]:
        """Return the SHA-256 of each lane, hexadecimal."""
        return {name: lane.hexdigest() for name, lane in self._lanes.items()}

    def hexdigest(self) -> str:
        """Return the SHA-256 of all lanes together, hexadecimal."""
        return hashlib.sha256("".join(self.lanes().values()).encode()).hexdigest()


class Unwitnessed(FlightDigest):
    """Of a flight that nobody takes the fingerprint of: real firmware's is never the same."""

    def add(self, lane: str, time_us: int, data: bytes) -> None:
        """Pass it over."""

    def extend(self, lane: str, data: bytes) -> None:
        """Pass it over."""


class WitnessedPolicy:
    """A policy whose observations are fingerprinted. Implements `actions.Policy`."""

    def __init__(self, policy: Policy, digest: FlightDigest) -> None:
        self._policy = policy
        self._digest = digest

    def act(self, observation: Observation) -> AnyAction:
        """Return the policy's action."""
        seen = observation
        numbers = np.array([*seen.goal, *seen.velocity, seen.roll, seen.pitch, seen.yaw])
        data = seen.image.tobytes() + numbers.tobytes()
        for name, view in seen.further.items():
            data += name.encode() + view.image.tobytes()
        self._digest.add("observations", 0, data)
        return self._policy.act(observation)

"""The simulator interface of external firmware: sensors out, motor commands in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from firmware_sim.interfaces import ActuatorControls, SensorSample, Truth


def no_process() -> None:
    """Check nothing: firmware that the user started has no process of ours."""


class Bridge(Protocol):
    """One flight's simulator interface of one firmware, without its MAVLink."""

    rate_hz: int
    """Sensor samples that the firmware needs per second of simulated time."""
    armed: bool
    """Whether the simulator interface last reported it armed; False before the first report."""
    time_us: int
    """The firmware's own time of the newest exchange [µs]; 0 before the first."""

    def wait_connected(self, timeout_s: float, alive: Callable[[], None]) -> None:
        """Wait until the firmware has connected, at most `timeout_s` [wall s].

        `alive` is polled here and by every later `step` that waits, and raises when the process has
        died.

        Raises:
            FirmwareMissingError: It did not connect in time.
            FirmwareLostError: From `alive`.
        """
        ...

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Send a tick's sensors; return the motor commands until the next tick.

        Raises:
            FirmwareLostError: The firmware died, hangs, or sends invalid data.
            FirmwareMissingError: It is connected, but cannot be flown.
        """
        ...

    def use_truth(self, truth: Callable[[], Truth]) -> None:
        """Accept a source of the true state."""
        ...

    def close(self) -> None:
        """Release what it holds; harmless when called again."""
        ...

"""The simulator link to real firmware: sensors out, motor commands in, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from firmware_sim.interfaces import ActuatorControls, SensorSample, Truth


def no_process() -> None:
    """Do nothing: for firmware whose process is not ours, nobody can tell whether it lives."""


class Bridge(Protocol):
    """One simulator interface, for one flight of one firmware.

    The firmware's MAVLink (mode, texts, parameters) is none of its business.
    """

    rate_hz: int
    """How many sensor samples a second of simulated time the firmware wants."""
    armed: bool
    """The simulator link's newest word of it; False before the first."""
    time_us: int
    """The firmware's own time of the newest exchange [µs]; 0 before the first."""

    def wait_connected(self, timeout_s: float, alive: Callable[[], None]) -> None:
        """Wait until the firmware is there.

        Args:
            timeout_s: Longest wait [wall s].
            alive: Called now and then, also by every later `step` that has to wait; raises when
                the firmware's process has died.

        Raises:
            FirmwareMissingError: Nobody came.
            FirmwareLostError: From `alive`.
        """
        ...

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Hand over a tick's sensors; return the motor commands until the next.

        Raises:
            FirmwareLostError: The firmware died, hangs, or talks nonsense.
            FirmwareMissingError: It is there, but cannot be flown with.
        """
        ...

    def use_truth(self, truth: Callable[[], Truth]) -> None:
        """Take what tells the true state."""
        ...

    def close(self) -> None:
        """Release what it holds; harmless when called again."""
        ...

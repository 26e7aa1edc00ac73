"""A flight controller as a simulation flies it: the built-in one, or external firmware."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from airl_mav.core.errors import UsageError
from firmware_sim.interfaces import ActuatorControls, SensorSample, Truth

if TYPE_CHECKING:  # Checking the options of external firmware must not load an estimator.
    from firmware_sim.autopilot.autopilot import BuiltinAutopilot
    from firmware_sim.autopilot.autopilot_state import Message
    from firmware_sim.autopilot.commander import Flight


class FirmwareLostError(Exception):
    """The flight proves nothing: external firmware died, hangs, or sends invalid data.

    So it is where a process has died that takes the camera's images.
    """


class FirmwareMissingError(UsageError):
    """External firmware cannot be started, or never connected."""


class FlightController(Protocol):
    """Takes a tick's sensors, returns motor commands, and tells a rehearsal what it must know.

    The built-in autopilot, or a bridge to real firmware; a new one for each episode.
    """

    on_message: Callable[[Message], None] | None
    """Called with every text for the operator, if set."""

    @property
    def rate_hz(self) -> int:
        """Sensor samples that it needs per second of simulated time."""

    @property
    def flight(self) -> Flight:
        """Phase and mode."""

    @property
    def internals(self) -> BuiltinAutopilot | None:
        """What the recorder reads; None for external firmware, which does not show it."""

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Advance to the sample's time and return the motor commands to hold until the next.

        Raises FirmwareLostError where it is external firmware.
        """

    def use_truth(self, truth: Callable[[], Truth]) -> None:
        """Accept a source of the true state.

        Simulator interfaces of external firmware send it along with the sensors.
        """

    def close(self) -> None:
        """Release what it holds; harmless when called again."""

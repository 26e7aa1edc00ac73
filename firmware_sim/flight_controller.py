"""Interface of flight controllers: the built-in autopilot or external firmware."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from airl_mav.core.errors import UsageError
from firmware_sim.interfaces import ActuatorControls, SensorSample, TrueState

if TYPE_CHECKING:  # Option checks of external firmware must not load the estimator.
    from firmware_sim.autopilot.autopilot import BuiltinAutopilot
    from firmware_sim.autopilot.autopilot_state import OperatorText
    from firmware_sim.autopilot.commander import CommanderState


class FirmwareLostError(Exception):
    """External firmware died, hangs or sends invalid data, so the flight is invalid.

    Also raised when the process that renders the camera's images has died.
    """


class FirmwareMissingError(UsageError):
    """External firmware cannot be started, or never connected."""


class FlightController(Protocol):
    """Flight controller: maps a tick's sensor sample to motor commands and reports its state.

    Either the built-in autopilot or a bridge to real firmware; a new object for each episode.
    """

    on_message: Callable[[OperatorText], None] | None
    """Callback for every operator text; None = no callback."""

    @property
    def rate_hz(self) -> int:
        """Required sensor samples per second of simulated time [Hz]."""

    @property
    def flight(self) -> CommanderState:
        """Flight phase and mode."""

    @property
    def internals(self) -> BuiltinAutopilot | None:
        """Built-in autopilot, for the recorder; None for external firmware."""

    def step(self, sample: SensorSample) -> ActuatorControls:
        """Advance to the sample's time and return the motor commands until the next sample.

        External firmware may raise FirmwareLostError.
        """

    def use_truth(self, truth: Callable[[], TrueState]) -> None:
        """Set the source of the true state.

        Simulator interfaces of external firmware send the true state with the sensors.
        """

    def close(self) -> None:
        """Release all resources. Idempotent."""

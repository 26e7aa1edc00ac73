"""A flight controller as a simulation flies it: the built-in one, or external firmware."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from airl_mav.core.errors import UsageError
from firmware_sim.interfaces import Autopilot, Truth

if TYPE_CHECKING:  # Checking the options of external firmware must not load an estimator.
    from firmware_sim.autopilot.autopilot_state import Message, Setpoint
    from firmware_sim.autopilot.commander import Flight
    from firmware_sim.autopilot.estimator import Estimator


class FirmwareLostError(Exception):
    """External firmware died, hangs, or sends invalid data: the flight proves nothing."""


class FirmwareMissingError(UsageError):
    """External firmware cannot be started, or never connected."""


class Internals(Protocol):
    """What the recorder reads of a flight controller that shows its internals."""

    on_setpoint: Callable[[Setpoint, int], None] | None
    """Called with every accepted setpoint and its time of receipt [µs], if set."""

    @property
    def ticks_to_motors(self) -> int:
        """After how many more ticks the motors reflect what is demanded in the next one."""
        ...

    @property
    def estimator(self) -> Estimator:
        """Its estimator."""
        ...


class FlightController(Autopilot, Protocol):
    """An autopilot, and what a rehearsal must know of it; a new one for each episode.

    `step` of external firmware may raise `FirmwareLostError`.
    """

    on_message: Callable[[Message], None] | None
    """Called with every text for the operator, if set."""

    @property
    def rate_hz(self) -> int:
        """Sensor samples that it needs per second of simulated time."""
        ...

    @property
    def flight(self) -> Flight:
        """Phase and mode."""
        ...

    @property
    def internals(self) -> Internals | None:
        """Its internals; None for external firmware, which does not show them."""
        ...

    def use_truth(self, truth: Callable[[], Truth]) -> None:
        """Accept a source of the true state.

        Simulator interfaces of external firmware send it along with the sensors.
        """
        ...

    def close(self) -> None:
        """Release what it holds; harmless when called again."""
        ...

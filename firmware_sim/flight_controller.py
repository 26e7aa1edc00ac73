"""A flight controller under test: the built-in one, or a bridge to real firmware."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from airl_mav.core.errors import UsageError
from firmware_sim.interfaces import Autopilot, Truth

if TYPE_CHECKING:  # Who only looks for a program need not load an estimator.
    from firmware_sim.autopilot.autopilot_state import Message, Setpoint
    from firmware_sim.autopilot.commander import Flight
    from firmware_sim.autopilot.estimator import Estimator


class FirmwareLostError(Exception):
    """Real firmware died, hangs, or talks nonsense: the flight is no test of anything."""


class FirmwareMissingError(UsageError):
    """Real firmware cannot be started, or never connected."""


class Internals(Protocol):
    """What can be seen of a flight controller whose inside is open."""

    on_setpoint: Callable[[Setpoint, int], None] | None
    """Called with every accepted setpoint and its time of receipt [µs], if set."""

    @property
    def ticks_to_motors(self) -> int:
        """After how many more ticks the motors reflect what is demanded in the next one."""
        ...

    @property
    def estimator(self) -> Estimator:
        """What it believes."""
        ...


class FlightController(Autopilot, Protocol):
    """An autopilot, and what a rehearsal must know of it. One for each episode.

    `step` of a bridge may raise `FirmwareLostError`.
    """

    on_message: Callable[[Message], None] | None
    """Called with every text for the operator, if set."""

    @property
    def rate_hz(self) -> int:
        """How many sensor samples a second of simulated time it wants."""
        ...

    @property
    def flight(self) -> Flight:
        """Phase and mode."""
        ...

    @property
    def internals(self) -> Internals | None:
        """Its inside; None where nobody can look into it: real firmware."""
        ...

    def use_truth(self, truth: Callable[[], Truth]) -> None:
        """Take what tells the true state: real firmware's simulators send it beside the sensors."""
        ...

    def close(self) -> None:
        """Release what it holds; harmless when called again."""
        ...

"""Live view of flights: an add-on, named by its table `VIEW`, and what flights tell it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from pydantic import BaseModel, ConfigDict

from airl_mav.core.addons import entries, load
from airl_mav.core.errors import UsageError

if TYPE_CHECKING:
    from airl_mav.arena.geometry import Arena
    from airl_mav.camera.frame import Frame
    from airl_mav.latency.injection import LatencySampler
    from airl_mav.prediction import Compensator
    from companion.pilot import SentDecision
    from firmware_sim.simulation import Simulation


class ViewError(Exception):
    """Error for a view that failed to start; the message contains the cause."""


@dataclass(frozen=True)
class ViewRequest:
    """Request to show flights in a live view."""

    port: int | None = None
    """TCP port of the page; None = any free port."""


class ViewEnds(BaseModel):
    """ZeroMQ addresses of a view on this machine."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    told: str
    asked: str
    """Address on which the view publishes its viewers' `Steering`."""


class SimulationTap(Protocol):
    """Sender of the simulation's messages. Call from one thread."""

    def begin(self, seed: int, arena: Arena, started_us: int) -> None:
        """Send the start of an episode in an arena."""

    def tick(self, simulation: Simulation, collision: str | None) -> None:
        """Send the newest ticks; `collision` names the obstacle hit so far."""

    def frame(self, frame: Frame) -> None:
        """Send a new frame of the camera, if due."""

    def close(self) -> None:
        """Disconnect."""


class CompanionTap(Protocol):
    """Sender of a companion's decisions; applies viewers' settings. Call from one thread."""

    decided: Callable[[SentDecision], None]
    """Sends a decision."""

    @property
    def touched(self) -> bool:
        """True if viewers changed the latency or the compensation of this flight."""

    def begin(self) -> None:
        """Reset the viewers' settings for a new flight."""

    def latency(self, sampler: LatencySampler | None) -> LatencySampler:
        """Return a sampler that lets viewers override the scenario's latency."""

    def compensator(self) -> Compensator | None:
        """Return a compensator that viewers may switch; None if the vehicle is unsupported."""

    def close(self) -> None:
        """Disconnect."""


class FlightTap(SimulationTap, Protocol):
    """Connection of a lockstep flight to a viewer, who also sets its pace."""

    companion: CompanionTap
    decided: Callable[[SentDecision], None]
    """Sends a decision, and ends a single step."""


def check_view() -> None:
    """Raise UsageError if the add-on is missing."""
    if not entries("airl_mav", "VIEW"):
        raise UsageError("--view: needs the add-on view (airl_mav/addons/view)")


def view_part(name: str) -> Any:
    """Return a part of the live view by its name in `VIEW`."""
    return load(entries("airl_mav", "VIEW")[name])

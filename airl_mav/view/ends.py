"""Requests for a live view and their answers; light to import for flights without a view."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict


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


class ViewSettings(BaseModel):
    """Configuration of a view process."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    run: str
    port: int | None
    """TCP port of the page; None = any free port."""
    paced: bool
    """True if viewers may set the pace."""
    speed: float | None
    steerable: bool
    """True if viewers may set the latency."""
    compensable: bool
    """True if the vehicle's response is known, which latency compensation requires."""
    compensated: bool


class ViewAnswer(BaseModel):
    """Port and addresses of a started view."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    port: int = 0
    ends: ViewEnds | None = None
    """ZeroMQ addresses; None = the requested port is in use."""

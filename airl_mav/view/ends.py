"""That a view is asked for, and where it is reached. Light: who is not watched imports no more."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict


@dataclass(frozen=True)
class ViewRequest:
    """That flights are to be watched while they fly."""

    port: int | None = None
    """TCP port of the page; None: any free one."""


class ViewEnds(BaseModel):
    """Addresses of a view, on this machine."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    told: str
    asked: str
    """Where it says what its watchers ask for."""


class Request(BaseModel):
    """What a view is to show."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    run: str
    port: int | None
    """TCP port of the page; None: any free one."""
    paced: bool
    """Whether the watchers may set the pace."""
    speed: float | None
    steerable: bool
    """Whether the watchers may set the latency."""
    compensable: bool
    """Whether it can be compensated: the vehicle's response is known."""
    compensated: bool


class Answer(BaseModel):
    """Where a view is reached, or why not."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    port: int = 0
    ends: ViewEnds | None = None
    """None: the port is taken."""

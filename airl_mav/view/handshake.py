"""What a view's process is asked for, and what it answers: one line of JSON each."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from airl_mav.view.ends import ViewEnds


class Request(BaseModel):
    """What a view is to show."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    run: str
    """What the run is called."""
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
    """Whether it is."""


class Answer(BaseModel):
    """Where a view is reached, or why not."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    port: int = 0
    """TCP port of the page."""
    ends: ViewEnds | None = None
    """None: the port is taken."""

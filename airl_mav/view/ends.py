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
    """Where snapshots go."""
    asked: str
    """Where it says what its watchers ask for."""

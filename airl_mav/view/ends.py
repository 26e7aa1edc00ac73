"""Where a view is reached. Light: who is not watched imports nothing else of this room."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class ViewEnds(BaseModel):
    """Addresses of a view, on this machine."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    told: str
    """Where snapshots go."""
    asked: str
    """Where it says what its watchers ask for."""

"""Live view of flights: an add-on, named by its table `VIEW`, and what flights tell it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict

from airl_mav.core.addons import entries, load
from airl_mav.core.errors import UsageError


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


def check_view() -> None:
    """Raise UsageError if the add-on is missing."""
    if not entries("airl_mav", "VIEW"):
        raise UsageError("--view: needs the add-on view (airl_mav/addons/view)")


def view_part(name: str) -> Any:
    """Return a part of the live view by its name in `VIEW`."""
    return load(entries("airl_mav", "VIEW")[name])

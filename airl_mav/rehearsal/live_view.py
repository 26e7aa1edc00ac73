"""Access to the add-on `view`: request, addresses and parts, from its table `VIEW`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict

from airl_mav.core.addons import entries, load


class ViewError(Exception):
    """Error for a view that failed to start; the message contains the cause."""


@dataclass(frozen=True)
class ViewRequest:
    """Request to show flights in a live view."""

    port: int | None = None
    """TCP port of the page; None = any free port."""


class ViewAddresses(BaseModel):
    """ZeroMQ addresses of a view on this machine."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    messages: str
    """Address to which flights send their messages."""
    steering: str
    """Address on which the view publishes its viewers' `Steering`."""


def view_part(name: str) -> Any:
    """Return a part of the live view by its name in `VIEW`."""
    return load(entries("airl_mav", "VIEW")[name])

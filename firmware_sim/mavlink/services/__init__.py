"""MAVLink microservices.

A service is a module with any of these tables and functions:

    HANDLERS: {message: (check of the addressee, handler)}
    ACTIONS: {MAV_CMD: action}
    REQUESTS: {id of a message that is no stream: action of REQUEST_MESSAGE}
    send_pending(context): sends the next part of a client's transfers, once per tick

A new service is a module and a line in `SERVICES`, or in the table SERVICES of an add-on.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

from airl_mav.core.addons import entries, load
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity

if TYPE_CHECKING:
    from firmware_sim.mavlink.codec import WireMessage
    from firmware_sim.mavlink.services.context import Context

SERVICES = {
    "params": "firmware_sim.mavlink.services.params",
    "commands": "firmware_sim.mavlink.services.commands",
    "connection": "firmware_sim.mavlink.services.connection",
    "setpoints": "firmware_sim.mavlink.services.setpoints",
}
"""Services of the core, as those of add-ons: loaded by the first server."""


@cache
def services() -> tuple[Any, ...]:
    """Return the modules of all services, in the order of their messages within a tick."""
    return tuple(map(load, [*SERVICES.values(), *entries("firmware_sim", "SERVICES").values()]))


@cache
def table(name: str) -> dict[Any, Any]:
    """Return a table of all services: HANDLERS, ACTIONS or REQUESTS."""
    found: dict[Any, Any] = {}
    for service in services():
        found |= getattr(service, name, {})
    return found


@cache
def _senders() -> tuple[Callable[[Context], None], ...]:
    return tuple(each.send_pending for each in services() if hasattr(each, "send_pending"))


def handle(message: WireMessage, kind: str, context: Context) -> bool:
    """Handle a message of a type; return True if it was for this vehicle and had an effect."""
    is_addressed, handler = table("HANDLERS").get(kind, (None, None))
    if handler is None and kind in _MISSION_STARTS and message.target_system == context.system_id:
        context.announce_once(OperatorText(Severity.ERROR, "No missions without add-on missions"))
    return bool(
        is_addressed and handler and is_addressed(message, context) and handler(message, context)
    )


_MISSION_STARTS = ("MISSION_REQUEST_LIST", "MISSION_COUNT")
"""First messages of a download and an upload."""


def send_pending(context: Context) -> None:
    """Send the next part of all transfers of a client."""
    for send in _senders():
        send(context)

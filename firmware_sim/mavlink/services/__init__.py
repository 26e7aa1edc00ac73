"""MAVLink microservices: tables of their handlers, and the state that the handlers share.

A service is a module with any of these tables and functions:

    HANDLERS: {message: (check of the addressee, handler)}
    ACTIONS: {MAV_CMD: action}
    REQUESTS: {id of a message that is no stream: action of REQUEST_MESSAGE}
    send_pending(context): sends the next part of a client's transfers, once per tick

A new service is a module and a line in `SERVICES`, or in the table SERVICES of an add-on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from typing import Any, TypeVar

from airl_mav.core.addons import entries, load
from airl_mav.core.signing import Signing
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import OperatorText, Result, Severity
from firmware_sim.mavlink.codec import COMPONENT_ID, SYSTEM_ID, WireMessage
from firmware_sim.mavlink.link import Link
from firmware_sim.mavlink.streams.sensors import Radio
from firmware_sim.mavlink.texts_and_events import EventBuffer

State = TypeVar("State", bound="ServiceState")

Handler = Callable[[WireMessage, "Context"], bool]
"""Handles one message for this vehicle; returns False if it had no effect."""

Addressee = Callable[[WireMessage, "Context"], bool]
"""Returns True if a message is addressed to this vehicle."""

Handlers = dict[str, tuple[Addressee, Handler]]
"""Check of the addressee and handler, by message name."""

ANY = 0
"""System or component id of a broadcast."""


class ServiceState:
    """State of a service: of one client, or of the vehicle and common to all its clients."""

    @property
    def is_running(self) -> bool:
        """True if `send_pending` has something to send, now or later."""
        return False

    @property
    def forbids_arming(self) -> bool:
        """True if PX4 rejects arming while it runs, such as during a calibration."""
        return False

    def restart(self) -> None:
        """Reset a state of the vehicle, because the autopilot changes."""

    def close(self) -> None:
        """Release the resources when the client leaves or the server closes."""


@dataclass(slots=True)
class Context:
    """State of one client for its handlers. The server updates `now_us` for every message.

    All clients of a vehicle share events, signing, radio and `vehicle_states`.
    """

    link: Link
    """Replies and streams of this client."""
    port: BuiltinAutopilot
    now_us: int
    """Simulated time [µs]."""
    announce: Callable[[OperatorText], None]
    """Sends a text, with its event if available, to all clients of all links. Events are part of
    the telemetry. In lockstep, replies must not change the telemetry, so only the text is sent."""
    broadcast: Callable[[str, bytes], None]
    """Sends a message, given by name and payload, to all clients of all links."""
    events: EventBuffer
    signing: Signing
    """Signing key of all links, if set."""
    system_id: int = SYSTEM_ID
    next_parameter: int | None = None
    """Next index of a running parameter list; -1 = the hash; None = no list is running."""
    states: dict[type, Any] = field(default_factory=dict)
    """States of services for this client, by class."""
    vehicle_states: dict[type, Any] = field(default_factory=dict)
    """States of services that all clients share, by class."""
    radio: Radio = field(default_factory=Radio)
    """Newest RC channels."""
    refusals: set[str] = field(default_factory=set)
    """Rejections of setpoints reported since the last accepted setpoint."""

    @property
    def is_busy(self) -> bool:
        """True if any transfer or repetition is in progress."""
        return self.next_parameter is not None or any(
            state.is_running for state in chain(self.states.values(), self.vehicle_states.values())
        )

    def state(self, kind: type[State]) -> State:
        """Return the state of a service for this client; new at the first call."""
        if kind not in self.states:
            self.states[kind] = kind()
        found: State = self.states[kind]
        return found

    def vehicle_state(self, kind: type[State]) -> State:
        """Return the state of a service that all clients share; new at the first call."""
        if kind not in self.vehicle_states:
            self.vehicle_states[kind] = kind()
        found: State = self.vehicle_states[kind]
        return found

    def announce_once(self, refusal: OperatorText) -> None:
        """Announce a rejection unless it was announced before."""
        if refusal.text not in self.refusals:
            self.refusals.add(refusal.text)
            self.announce(refusal)

    def close(self) -> None:
        """Release the client's resources when the client leaves or the autopilot changes."""
        for state in self.states.values():
            state.close()


def for_anyone(_message: WireMessage, _context: Context) -> bool:
    """Return True for every message."""
    return True


def for_vehicle(message: WireMessage, context: Context) -> bool:
    """Return True if a message is addressed to this vehicle's autopilot or all its components."""
    system: int = message.target_system
    return system == context.system_id and message.target_component in (COMPONENT_ID, ANY)


def for_vehicle_or_all(message: WireMessage, context: Context) -> bool:
    """Return True for messages to this vehicle, as `for_vehicle`, and for broadcasts."""
    system: int = message.target_system
    component: int = message.target_component
    return system in (context.system_id, ANY) and component in (COMPONENT_ID, ANY)


def sender(message: WireMessage) -> tuple[int, int]:
    """Return the system and component id of a message's sender."""
    return message.get_srcSystem(), message.get_srcComponent()


@dataclass(frozen=True, slots=True)
class VehicleCommand:
    """A COMMAND_LONG or COMMAND_INT."""

    number: int
    params: tuple[float, float, float, float, float, float, float]
    """Parameters 1 to 7 of COMMAND_LONG; NaN = not set."""
    sender: tuple[int, int] = (0, 0)
    frame: int | None = None
    """MAV_FRAME of a COMMAND_INT; None for a COMMAND_LONG."""

    def integer(self, number: int) -> int | None:
        """Return parameter 1 to 7, rounded; None if not finite."""
        value = self.params[number - 1]
        return round(value) if math.isfinite(value) else None


Action = Callable[[VehicleCommand, Context], "Result | None"]
"""Executes a command and returns its result; None = no acknowledgement, as in PX4."""

SERVICES = {
    "params": "firmware_sim.mavlink.services.params",
    "commands": "firmware_sim.mavlink.services.commands",
    "connection": "firmware_sim.mavlink.services.connection",
    "setpoints": "firmware_sim.mavlink.services.setpoints",
}
"""Services of the core. The first server loads them, with the services of add-ons."""


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

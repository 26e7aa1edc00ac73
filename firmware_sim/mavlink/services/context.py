"""What a service may use while it handles a message."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.autopilot.port import AutopilotPort
from firmware_sim.mavlink.codec import COMPONENT_ID, SYSTEM_ID, WireMessage
from firmware_sim.mavlink.link import Link

ANY = 0
"""System or component id of a broadcast."""


@dataclass(slots=True)
class Context:
    """One link's surroundings; the server renews `now_us` for every message."""

    link: Link
    port: AutopilotPort
    now_us: int
    """Simulated time [µs]."""
    announce: Callable[[Message], None]
    """Sends a text to the operators on all links."""
    broadcast: Callable[[WireMessage], None]
    """Sends a message on all links."""


Handler = Callable[[WireMessage, Context], bool]
"""Handles one message; False = not for this vehicle, or nothing to do."""


def for_vehicle(message: WireMessage) -> bool:
    """Tell whether a message names this vehicle, and its autopilot or all components."""
    system: int = message.target_system
    component: int = message.target_component
    return system == SYSTEM_ID and component in (COMPONENT_ID, ANY)


def for_vehicle_or_all(message: WireMessage) -> bool:
    """As `for_vehicle`, and broadcasts to all systems too."""
    system: int = message.target_system
    component: int = message.target_component
    return system in (SYSTEM_ID, ANY) and component in (COMPONENT_ID, ANY)


def sender(message: WireMessage) -> tuple[int, int]:
    """Return the system and component id of a message's sender."""
    return message.get_srcSystem(), message.get_srcComponent()

"""One link's part in the mission protocol: who transfers what, and how far it has come."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto

from firmware_sim.autopilot.navigation.plan import PlanItem

RETRY_US = 250_000
"""After this time without an item it is asked for again [µs] (PX4)."""

TIMEOUT_US = 5_000_000
"""After this time without a message a transfer is given up [µs] (PX4)."""

NOBODY = (-1, -1)


class Activity(Enum):
    """What a link's mission protocol is doing."""

    IDLE = auto()
    SENDING = auto()
    """A client downloads."""
    RECEIVING = auto()
    """A client uploads."""


@dataclass(slots=True)
class MissionTransfer:
    """The state of one link's transfers."""

    activity: Activity = Activity.IDLE
    kind: int = 0
    """MAV_MISSION_TYPE of the newest transfer."""
    index: int = 0
    """The next item."""
    count: int = 0
    current: int = -1
    """The item that the upload marks as current; -1 = none."""
    checksum: int = 0
    items: list[PlanItem] = field(default_factory=list)
    """What has been uploaded so far."""
    partner: tuple[int, int] = NOBODY
    """System and component id of the client."""
    integer: bool = False
    """Whether items travel as MISSION_ITEM_INT; PX4 begins with MISSION_REQUEST and learns."""
    sent_us: int = 0
    """When the client was last asked."""
    heard_us: int = 0
    """When the client was last heard."""

    # What this link has told its clients of the mission.
    told_current: int = 0
    told_reached: int = -1
    repeats: int = 0
    """How often the newest MISSION_ITEM_REACHED has been repeated."""
    repeated_us: int = 0
    told_jumped: tuple[int, int] = (-1, 0)

"""Mission protocol: upload, download, clear and select, for missions, geofence and rally points.

Replies, rejections and texts follow PX4 1.16 (MavlinkMissionManager). Each link has one transfer at
a time; an upload blocks uploads on all links. Messages that PX4 ignores (an item out of sequence,
MISSION_WRITE_PARTIAL_LIST) have no reply here either. https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, auto

from airl_mav.core.frames import Geodetic
from firmware_sim.addons.missions import items
from firmware_sim.autopilot.autopilot_state import OperatorText, Result, Severity
from firmware_sim.autopilot.events.definition import Definition, Level, define
from firmware_sim.autopilot.navigation.plan import MissionType, PlanItem, Stored
from firmware_sim.mavlink import services
from firmware_sim.mavlink.codec import COMPONENT_ID, WireMessage, dialect

RETRY_US = 250_000
"""Time without an item after which the request is repeated [µs] (PX4)."""


TIMEOUT_US = 5_000_000
"""Time without a message after which a transfer is aborted [µs] (PX4)."""


NOBODY = (-1, -1)


def _transfer(name: str, message: str, level: Level = Level.ERROR) -> Definition:
    return define(f"mavlink_mission_{name}", message, level=level)


DOWNLOAD_IGNORED = _transfer(
    "req_ignored", "Mission download request ignored, already active", Level.WARNING
)
REQUEST_OF_ANOTHER = _transfer(
    "partner_id_mismatch2", "Rejecting mission request command, component or system ID mismatch"
)
REQUEST_WHILE_BUSY = _transfer("mis_req_ignored_busy", "Ignoring mission request, currently busy")
REQUEST_UNEXPECTED = _transfer("wp_unexpected", "Unexpected waypoint index, aborting transfer")
REQUEST_BEYOND_END = _transfer(
    "wp_unexpected2", "Unexpected waypoint index, aborting mission transfer"
)
ACK_OF_ANOTHER = _transfer(
    "partner_id_mismatch", "Rejecting waypoint command, component or system ID mismatch"
)
COUNT_WHILE_SENDING = _transfer("ignore_mis_count", "Mission upload busy, ignoring MISSION_COUNT")
COUNT_WHILE_RECEIVING = _transfer("getlist_busy", "Mission upload busy, already receiving waypoint")
ITEM_OF_ANOTHER = _transfer(
    "item_partner_id_mismatch", "Rejecting mission item, component or system ID mismatch"
)
ITEM_WHILE_SENDING = _transfer("mis_item_busy", "Ignoring mission item, busy")
ITEM_WITHOUT_TRANSFER = _transfer("no_transfer", "Ignoring mission item, no transfer in progress")
ITEM_INVALID = _transfer("mis_item_invalid", "Ignoring mission item, invalid item")
CLEAR_WHILE_BUSY = _transfer("ignore_clear", "Ignoring mission clear command, busy")
CURRENT_WHILE_BUSY = _transfer(
    "state_busy", "Mission manager currently busy, ignoring new waypoint index"
)
CURRENT_NOT_LISTED = _transfer("seq_out_of_bounds", "New mission waypoint sequence out of bounds")
TIMED_OUT = _transfer("op_timeout", "Operation timeout, aborting transfer")


class Activity(Enum):
    """State of a link's mission protocol."""

    IDLE = auto()
    SENDING = auto()
    """Download to a client."""
    RECEIVING = auto()
    """Upload from a client."""


REPEATS = 10
"""Number of repetitions of MISSION_ITEM_REACHED, at intervals of REPEAT_US."""


REPEAT_US = 1_000_000


@dataclass(slots=True)
class MissionTransfer(services.ServiceState):
    """State of one link's mission transfers."""

    activity: Activity = Activity.IDLE
    kind: int = 0
    """MAV_MISSION_TYPE of the newest transfer."""
    index: int = 0
    count: int = 0
    current: int = -1
    """Item that the upload marks as current; -1 = none."""
    checksum: int = 0
    items: list[PlanItem] = field(default_factory=list)
    partner: tuple[int, int] = NOBODY
    """System and component id of the client."""
    integer: bool = False
    """True if items are sent as MISSION_ITEM_INT; PX4 starts with MISSION_REQUEST and adapts."""
    sent_us: int = 0
    """Time of the newest request to the client [µs]."""
    received_us: int = 0
    """Time of the client's newest message [µs]."""

    # Mission progress that this link has reported to its clients.
    sent_current: int = 0
    sent_reached: int = -1
    repeats: int = 0
    """Number of repetitions of the newest MISSION_ITEM_REACHED."""
    repeated_us: int = 0
    sent_jumped: tuple[int, int] = (-1, 0)

    @property
    def is_running(self) -> bool:
        """True if timed messages are due: requests to the client, or repetitions."""
        repeats = self.sent_reached >= 0 and self.repeats < REPEATS
        return self.activity is not Activity.IDLE or repeats


_IDLE, _SENDING, _RECEIVING = Activity.IDLE, Activity.SENDING, Activity.RECEIVING
_PLANNERS = (COMPONENT_ID, services.ANY, dialect.MAV_COMP_ID_MISSIONPLANNER)

ALL: int = dialect.MAV_MISSION_TYPE_ALL
_ACCEPTED: int = dialect.MAV_MISSION_ACCEPTED
_ERROR: int = dialect.MAV_MISSION_ERROR


def is_addressed(message: WireMessage, context: services.Context) -> bool:
    """Return True if a message is addressed to this vehicle's mission manager."""
    return bool(
        message.target_system == context.system_id and message.target_component in _PLANNERS
    )


# --- downloads


def handle_list(message: WireMessage, context: services.Context) -> bool:
    """Handle MISSION_REQUEST_LIST: start a download by sending the number of items."""
    transfer = context.state(MissionTransfer)
    partner = services.sender(message)
    _end_complete_download(transfer)
    # A repeated request from the same client restarts the download: the count was lost.
    again = (
        transfer.activity is _SENDING
        and transfer.kind == message.mission_type
        and transfer.partner == partner
    )
    if transfer.activity is not _IDLE and not again:
        context.announce(OperatorText.of(Severity.INFO, DOWNLOAD_IGNORED))
        return True
    # `heard_us` starts the transfer's timeout.
    transfer.activity, transfer.kind = _SENDING, message.mission_type
    transfer.index, transfer.partner = 0, partner
    transfer.count = len(_stored(context, transfer.kind).items)
    transfer.sent_us = transfer.received_us = context.now_us
    identity = _stored(context, transfer.kind).identity
    context.link.send(
        dialect.MAVLink_mission_count_message(*partner, transfer.count, transfer.kind, identity)
    )
    return True


def handle_request(message: WireMessage, context: services.Context) -> bool:
    """Handle MISSION_REQUEST(_INT): send an item of the running download."""
    transfer = context.state(MissionTransfer)
    transfer.integer = message.get_type() == "MISSION_REQUEST_INT"
    if services.sender(message) != transfer.partner:
        _report(context, "WPM: REJ. CMD: partner id mismatch", REQUEST_OF_ANOTHER)
        return True
    if transfer.activity is _RECEIVING:
        _report(context, "WPM: REJ. CMD: Busy", REQUEST_WHILE_BUSY)
        return True
    if transfer.activity is _IDLE or transfer.kind != message.mission_type:
        return False
    transfer.received_us = context.now_us
    index = message.seq
    # Accept the next item, or the previous one again (its reply was lost).
    if index == transfer.index < transfer.count:
        transfer.index += 1
    elif index != transfer.index - 1:
        return _break_off(context, REQUEST_UNEXPECTED)
    # The list may have changed during the download.
    if index >= len(_stored(context, transfer.kind).items):
        return _break_off(context, REQUEST_BEYOND_END)
    _send_item(context, index)
    return True


def handle_ack(message: WireMessage, context: services.Context) -> bool:
    """Handle MISSION_ACK: end a download, or react to the client's reply to a request."""
    transfer = context.state(MissionTransfer)
    if services.sender(message) != transfer.partner:
        _report(context, "REJ. WP CMD: partner id mismatch", ACK_OF_ANOTHER)
        return True
    if transfer.activity is _SENDING and transfer.kind == message.mission_type:
        transfer.activity = _IDLE
        return True
    if transfer.activity is not _RECEIVING:
        return False
    if message.type == dialect.MAV_MISSION_UNSUPPORTED:
        # The client supports only the other item message.
        transfer.integer = not transfer.integer
        _request(context)
    elif message.type == dialect.MAV_MISSION_OPERATION_CANCELLED:
        _end_upload(context)
    return True


# --- uploads


def handle_count(message: WireMessage, context: services.Context) -> bool:
    """Handle MISSION_COUNT: start an upload. A count of 0 clears the list."""
    transfer, partner = context.state(MissionTransfer), services.sender(message)
    _end_complete_download(transfer)
    if transfer.activity is _SENDING:
        _report(context, "WPM: IGN MISSION_COUNT: Busy", COUNT_WHILE_SENDING)
        _acknowledge(context, partner, _ERROR)
        return True
    # Renewed for any sender; the partner is checked below.
    transfer.received_us = context.now_us
    if transfer.activity is _RECEIVING:
        if partner != transfer.partner:
            _acknowledge(context, partner, _ERROR)
        # An upload that has received items is not restarted.
        elif transfer.index:
            _report(context, "WPM: REJ. CMD: Busy", COUNT_WHILE_RECEIVING)
            _acknowledge(context, partner, _ERROR)
        else:
            _request(context)  # the request was probably lost
        return True
    return _begin_upload(message, context)


def _begin_upload(message: WireMessage, context: services.Context) -> bool:
    transfer, partner, plans = (
        context.state(MissionTransfer),
        services.sender(message),
        context.port.plans,
    )
    # `plans.receiving` is common to all links: one upload at a time.
    if plans.receiving:
        _acknowledge(context, partner, _ERROR)
        return True
    if partner != transfer.partner:
        # Another client may support only floats (dronekit): request floats first.
        transfer.integer = False
    transfer.partner, transfer.kind, transfer.checksum = partner, message.mission_type, 0
    # An unknown list type has room for 0 items.
    is_known = transfer.kind in items.MOST_ITEMS
    if message.count > (items.MOST_ITEMS[MissionType(transfer.kind)] if is_known else 0):
        _acknowledge(context, partner, dialect.MAV_MISSION_NO_SPACE)
    elif message.count == 0:
        if is_known:
            plans.clear(MissionType(transfer.kind))
        _acknowledge(context, partner, _ACCEPTED)
    else:
        plans.receiving = True
        transfer.activity = _RECEIVING
        transfer.index, transfer.count, transfer.current = 0, message.count, -1
        transfer.items = []
        _request(context)
    return True


def handle_item(message: WireMessage, context: services.Context) -> bool:
    """Handle MISSION_ITEM(_INT): store an item and request the next."""
    transfer, partner = context.state(MissionTransfer), services.sender(message)
    transfer.integer = items.is_int(message)
    if partner != transfer.partner:
        _report(context, "REJ. MIS ITEM: partner id mismatch", ITEM_OF_ANOTHER)
        return True
    if message.mission_type != transfer.kind:
        _acknowledge(context, partner, _ERROR)
        return True
    if transfer.activity is _SENDING:
        # PX4 answers with an error, unlike to an item out of sequence.
        _report(context, "IGN MISSION_ITEM: Busy", ITEM_WHILE_SENDING)
        _acknowledge(context, partner, _ERROR)
        return True
    if transfer.activity is _IDLE:
        if transfer.index == message.seq + 1:
            # The last item again: the acknowledgement was lost.
            _acknowledge(context, partner, _ACCEPTED, transfer.checksum)
        else:
            _report(context, "IGN MISSION_ITEM: No transfer", ITEM_WITHOUT_TRANSFER)
            _acknowledge(context, partner, _ERROR)
        return True
    transfer.received_us = context.now_us
    # PX4 ignores an item out of sequence; the request is repeated after a timeout.
    if message.seq != transfer.index:
        return False
    return _take_item(message, context)


def _take_item(message: WireMessage, context: services.Context) -> bool:
    transfer = context.state(MissionTransfer)
    item, kind = items.parse(message), MissionType(transfer.kind)
    if isinstance(item, int):
        _report(context, "IGN MISSION_ITEM: Invalid item", ITEM_INVALID)
        _acknowledge(context, transfer.partner, item)
        _end_upload(context)
        return True
    # The checksum also covers an item that is rejected below.
    transfer.checksum = items.checksum(message, transfer.checksum)
    if not items.belongs(item, kind):
        _acknowledge(context, transfer.partner, _ERROR)
        _end_upload(context)
        return True
    transfer.items.append(item)
    if message.current:
        transfer.current = message.seq
    transfer.index += 1
    if transfer.index < transfer.count:
        _request(context)
        return True
    plans = context.port.plans
    # The checksum identifies the list, so equal checksums mean equal lists.
    if transfer.checksum != plans.stored(kind).identity:
        # An identical list has no effect: the current item stays.
        plans.store(kind, tuple(transfer.items), transfer.checksum, transfer.current)
    # Releases the lock of all links before the acknowledgement.
    _end_upload(context)
    _acknowledge(context, transfer.partner, _ACCEPTED, transfer.checksum)
    return True


# --- the rest


def handle_clear(message: WireMessage, context: services.Context) -> bool:
    """Handle MISSION_CLEAR_ALL: clear one list, or all lists."""
    transfer, kind = context.state(MissionTransfer), message.mission_type
    _end_complete_download(transfer)
    if transfer.activity is not _IDLE:
        _report(context, "WPM: IGN CLEAR CMD: Busy", CLEAR_WHILE_BUSY)
        return True
    # MISSION_ACK contains the type of the last transfer.
    transfer.kind = kind
    for cleared in MissionType:
        if kind in (cleared, ALL):
            context.port.plans.clear(cleared)
    _acknowledge(context, services.sender(message), _ACCEPTED)
    return True


def handle_set_current(message: WireMessage, context: services.Context) -> bool:
    """Handle MISSION_SET_CURRENT: select the item to resume with. The mode does not change."""
    plans = context.port.plans
    _end_complete_download(context.state(MissionTransfer))
    if context.state(MissionTransfer).activity is not _IDLE:
        _report(context, "WPM: IGN WP CURR CMD: Busy", CURRENT_WHILE_BUSY)
    elif message.seq >= len(plans.mission):
        _report(context, "WPM: WP CURR CMD: Not in list", CURRENT_NOT_LISTED)
    else:
        plans.set_current(message.seq)
        # -1 forces a MISSION_CURRENT in the next tick.
        context.state(MissionTransfer).sent_current = -1
    return True


def send_pending(context: services.Context) -> None:
    """Repeat requests, check timeouts, and report mission progress. Call once per tick."""
    transfer, plans = context.state(MissionTransfer), context.port.plans
    if transfer.activity is not _IDLE:
        _check_timeouts(context)
    if plans.current != transfer.sent_current:
        transfer.sent_current = plans.current
        context.link.send_stream("MISSION_CURRENT", context.port.state())
    # -1 because `_tell_reached` counts the first message as a repetition.
    if plans.reached != transfer.sent_reached:
        transfer.sent_reached, transfer.repeats = plans.reached, -1
        transfer.repeated_us = context.now_us - REPEAT_US
    if transfer.sent_reached >= 0 and transfer.repeats < REPEATS:
        _send_reached(context)
    # After a DO_JUMP, the link's last partner receives the item again.
    jumped = (plans.jumped, plans.jumps_done.get(plans.jumped, 0))
    if jumped != transfer.sent_jumped:
        transfer.sent_jumped = jumped
        if jumped[0] >= 0 and transfer.activity is _IDLE and transfer.partner[0] >= 0:
            transfer.kind = int(MissionType.MISSION)
            _send_item(context, jumped[0])


def _check_timeouts(context: services.Context) -> None:
    transfer, now_us = context.state(MissionTransfer), context.now_us
    # PX4's timeout applies to uploads and downloads.
    if now_us - transfer.received_us > TIMEOUT_US:
        change = context.port.parameters.release.events.get(TIMED_OUT.name, {})
        _report(context, change.get("text", "Operation timeout"), TIMED_OUT.of_release(change))
        _end_upload(context)
    elif transfer.activity is _RECEIVING and now_us - transfer.sent_us > RETRY_US:
        _request(context)


def _send_reached(context: services.Context) -> None:
    transfer = context.state(MissionTransfer)
    if context.now_us - transfer.repeated_us >= REPEAT_US:
        transfer.repeated_us = context.now_us
        transfer.repeats += 1
        context.link.send(dialect.MAVLink_mission_item_reached_message(transfer.sent_reached))


def _end_complete_download(transfer: MissionTransfer) -> None:
    """End a complete download: some clients (dronekit) never acknowledge it.

    PX4 does this when a new download starts, and otherwise waits for its timeout.
    """
    if transfer.activity is _SENDING and transfer.index == transfer.count:
        transfer.activity = _IDLE


def _stored(context: services.Context, kind: int) -> Stored:
    return context.port.plans.stored(MissionType(kind)) if kind in items.MOST_ITEMS else Stored()


def _request(context: services.Context) -> None:
    transfer = context.state(MissionTransfer)
    transfer.sent_us = context.now_us
    build = (
        dialect.MAVLink_mission_request_int_message
        if transfer.integer
        else dialect.MAVLink_mission_request_message
    )
    context.link.send(build(*transfer.partner, transfer.index, transfer.kind))


def _send_item(context: services.Context, index: int) -> None:
    transfer, plans = context.state(MissionTransfer), context.port.plans
    kind = MissionType(transfer.kind)
    transfer.sent_us = context.now_us
    context.link.send(
        items.format_item(
            plans.stored(kind).items[index],
            kind,
            index,
            transfer.partner,
            current=index == plans.current,
            integer=transfer.integer,
        )
    )


def _acknowledge(
    context: services.Context, target: tuple[int, int], result: int, identity: int = 0
) -> None:
    context.link.send(
        dialect.MAVLink_mission_ack_message(
            *target, result, context.state(MissionTransfer).kind, identity
        )
    )


def _report(context: services.Context, text: str, event: Definition) -> None:
    context.announce(OperatorText.of(Severity.CRITICAL, event, text=text))


def _break_off(context: services.Context, why: Definition) -> bool:
    context.state(MissionTransfer).activity = _IDLE
    _acknowledge(context, context.state(MissionTransfer).partner, _ERROR)
    _report(context, "WPM: REJ. CMD: Req. WP was unexpected", why)
    return True


def _end_upload(context: services.Context) -> None:
    transfer = context.state(MissionTransfer)
    # Only the link that receives may release the lock of all links.
    if transfer.activity is _RECEIVING:
        context.port.plans.receiving = False
    transfer.activity = _IDLE
    transfer.items = []


# --- commands

_ROI_LOCATION = 3
"""Value of MAV_ROI_LOCATION."""


def _start(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle parameter 1: first item; -1 = continue the mission."""
    index = command.params[0]
    if not math.isfinite(index):
        return Result.DENIED
    return context.port.start_mission(int(index))


def _start_landing(_command: services.VehicleCommand, context: services.Context) -> Result:
    """Go to the mission's landing: DO_LAND_START, or the first landing; CANCELLED without one."""
    commands = [item.command for item in context.port.plans.mission]
    # DO_LAND_START has precedence; without one the first LAND item marks the landing.
    for marker in (dialect.MAV_CMD_DO_LAND_START, dialect.MAV_CMD_NAV_LAND):
        if marker in commands:
            return context.port.start_mission(commands.index(marker))
    return Result.CANCELLED


def _look(command: services.VehicleCommand, context: services.Context) -> Result:
    """Handle DO_SET_ROI_LOCATION, DO_SET_ROI (parameter 1: MAV_ROI) and DO_SET_ROI_NONE."""
    place = Geodetic(*command.params[4:7])
    # DO_SET_ROI carries the region type in parameter 1.
    located = command.number == dialect.MAV_CMD_DO_SET_ROI_LOCATION or (
        command.number != dialect.MAV_CMD_DO_SET_ROI_NONE and command.params[0] == _ROI_LOCATION
    )
    valid = math.isfinite(place.latitude_deg) and math.isfinite(place.longitude_deg)
    context.port.look_at(place if located and valid else None)
    return Result.ACCEPTED


HANDLERS = {
    name: (is_addressed, handler)
    for name, handler in {
        "MISSION_REQUEST_LIST": handle_list,
        "MISSION_REQUEST": handle_request,
        "MISSION_REQUEST_INT": handle_request,
        "MISSION_ACK": handle_ack,
        "MISSION_COUNT": handle_count,
        "MISSION_ITEM": handle_item,
        "MISSION_ITEM_INT": handle_item,
        "MISSION_CLEAR_ALL": handle_clear,
        "MISSION_SET_CURRENT": handle_set_current,
    }.items()
}
"""Handlers by message name."""

ACTIONS: dict[int, services.Action] = {
    dialect.MAV_CMD_MISSION_START: _start,
    dialect.MAV_CMD_DO_LAND_START: _start_landing,
    dialect.MAV_CMD_DO_SET_ROI_LOCATION: _look,
    dialect.MAV_CMD_DO_SET_ROI_NONE: _look,
    dialect.MAV_CMD_DO_SET_ROI: _look,
    dialect.MAV_CMD_NAV_ROI: _look,
    # Effective only as a mission item.
    dialect.MAV_CMD_DO_SET_ROI_WPNEXT_OFFSET: _look,
}

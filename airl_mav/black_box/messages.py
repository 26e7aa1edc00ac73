"""Topics, messages and encoding of a black box.

Messages are JSON. Their JSON Schemas are generated from the classes of this module. Any MCAP reader
works (Foxglove, `mcap cat`, pandas). Images and texts use Foxglove's schemas
(https://docs.foxglove.dev/docs/visualization/message-schemas/introduction). Times `*_us` count from
the companion's start [µs]. World frames are NED from the start of the flight, body frames FRD.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from airl_mav.core import clock, constants

SUFFIX = ".mcap"

Microseconds: TypeAlias = Annotated[int, Field(ge=-1, lt=2**62)]
Whole: TypeAlias = Annotated[int, Field(ge=0, lt=2**62)]
Base64: TypeAlias = Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]

Number: TypeAlias = float | None
"""Float; None = NaN or infinite, which JSON does not support."""

Vector3: TypeAlias = tuple[Number, Number, Number]
Vector4: TypeAlias = tuple[Number, Number, Number, Number]


class Message:
    """Message of a black box."""


@dataclass(frozen=True)
class Decision(Message):
    """Decision, written as soon as its command is sent."""

    capture_us: Microseconds
    """Exposure time of the input frame; -1 = stamped by a clock other than the companion's."""
    decoded_us: Microseconds
    infer_start_us: Microseconds
    action_ready_us: Microseconds
    sent_us: Microseconds
    held_until_us: Microseconds
    """Planned end of the action's hold; `held_before_us` of the next decision is the actual end."""
    held_before_us: Microseconds
    """End of the previous decision's hold; -1 for the first decision."""
    position: Vector3
    """Position of the vehicle as input of the decision [m]."""
    velocity: Vector3
    """Velocity of the vehicle NED [m/s]."""
    quaternion: Vector4
    """Attitude w, x, y, z, body to world."""
    goal_away_m: Number
    """Distance to the goal [m]; horizontal for a goal without a height."""
    setpoint: Vector4
    """Setpoint. Velocity commands: forward, right, down [m/s], yaw rate [rad/s], heading frame."""


@dataclass(frozen=True)
class Telemetry(Message):
    """State of the vehicle as reported by the flight controller."""

    time_us: Microseconds
    position: Vector3
    """Position NED [m]."""
    velocity: Vector3
    """Velocity NED [m/s]."""
    quaternion: Vector4
    """Attitude w, x, y, z, body to world."""


@dataclass(frozen=True)
class Truth(Telemetry):
    """True state of the vehicle in the simulator; only in files exported from a run."""

    power_w: Number
    """Electrical power without the companion computer [W]."""


@dataclass(frozen=True)
class Command(Message):
    """Current velocity command, rotated by the vehicle's heading."""

    time_us: Microseconds
    velocity: Vector3
    """Commanded velocity NED [m/s]."""
    yaw_rate: Number
    """Commanded yaw rate [rad/s]."""


@dataclass(frozen=True)
class Latency(Message):
    """Duration of each stage of a decision [ms]; None = its start or end is unknown."""

    sent_us: Microseconds
    """Send time that identifies the decision."""
    t1_ms: Number
    wait_ms: Number
    t2_ms: Number
    send_ms: Number
    link_ms: Number
    control_ms: Number
    end_to_end_ms: Number
    t3_ms: Number
    period_ms: Number


@dataclass(frozen=True)
class Status(Message):
    """Flight mode, arming state and battery."""

    time_us: Microseconds
    armed: bool
    offboard: bool
    mode: str
    voltage_v: float | None
    """Battery voltage [V]. None here and below = not reported by the flight controller."""
    current_a: float | None
    battery_remaining: float | None
    """Remaining charge, 1 to 0."""


@dataclass(frozen=True)
class Resources(Message):
    """Load, memory and temperature of the companion computer."""

    time_us: Microseconds
    process_cores: float
    """CPU load of the companion in cores since the previous message."""
    machine_percent: float
    """Total CPU load in percent of all cores since the previous message."""
    memory_bytes: Whole
    """Resident set size of the companion."""
    temperature_c: float | None
    """Temperature of the warmest sensor [°C]; None without sensors."""


@dataclass(frozen=True)
class Phase(Message):
    """Start of a phase of the mission."""

    time_us: Microseconds
    phase: str


@dataclass(frozen=True)
class End(Message):
    """End of the mission."""

    time_us: Microseconds
    reason: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Timestamp:
    """Calendar time as in Foxglove's schemas."""

    sec: int
    nsec: int


@dataclass(frozen=True)
class RawImage(Message):
    """foxglove.RawImage: input image of a decision before compensation."""

    timestamp: Timestamp
    frame_id: str
    width: Whole
    height: Whole
    encoding: str
    """Key of `ENCODINGS`; `mono16` is depth in millimetres, 0 = no return."""
    step: Whole
    """Row length in bytes."""
    data: Base64
    """Pixel rows, little endian."""


@dataclass(frozen=True)
class Log(Message):
    """foxglove.Log: a text message."""

    timestamp: Timestamp
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


TOPICS: dict[type[Message], str] = {
    Decision: "/decision",
    Telemetry: "/telemetry",
    Truth: "/truth",
    Command: "/command",
    Latency: "/latency",
    Status: "/status",
    Resources: "/resources",
    Phase: "/phase",
    End: "/end",
    RawImage: "/depth",
    Log: "/log",
}

FOXGLOVE: dict[type[Message], str] = {RawImage: "foxglove.RawImage", Log: "foxglove.Log"}
"""Foxglove's schemas; the others are named after their class."""

INFO, WARNING = 2, 3


ENCODINGS: dict[str, tuple[str, int]] = {
    "mono16": ("<u2", 0),
    "rgb8": ("u1", 3),
    "mono8": ("u1", 1),
}
"""Data type and channels of depth, colour and grey images; 0 = no channel axis."""


def image_message(image: NDArray[Any], unix_us: int, camera: str = "camera") -> RawImage:
    """Return the message of a depth (h, w) [mm] or colour (h, w, c) image at a calendar time."""
    height, width, *channels = image.shape
    encoding = "mono16" if not channels else "rgb8" if channels == [3] else "mono8"
    rows = np.ascontiguousarray(image, ENCODINGS[encoding][0])
    data = base64.b64encode(rows.tobytes()).decode("ascii")
    return RawImage(time_of(unix_us), camera, width, height, encoding, rows.nbytes // height, data)


def image_of(image: RawImage) -> NDArray[Any]:
    """Return the image of a message; raise ValueError for a wrong size or unsupported encoding."""
    if image.encoding not in ENCODINGS:
        raise ValueError(f"encoding {image.encoding!r}; accepted: {', '.join(ENCODINGS)}")
    number, channels = ENCODINGS[image.encoding]
    rows = np.frombuffer(base64.b64decode(image.data), number)
    shape = (image.height, image.width, channels) if channels else (image.height, image.width)
    return rows.reshape(shape).astype(np.uint8 if channels else np.uint16)


def text(message: str, name: str, unix_us: int, level: int = INFO) -> Log:
    """Return the message of a text from source `name` at a calendar time [µs]."""
    return Log(time_of(unix_us), level, message, name)


def time_of(unix_us: int) -> Timestamp:
    """Convert a calendar time [µs since 1970] to Foxglove's schema."""
    seconds, rest_us = divmod(unix_us, constants.US_PER_S)
    return Timestamp(seconds, rest_us * clock.NS_PER_US)


UNKNOWN = "null: not known"


def foxglove_schema(kind: type[Any]) -> dict[str, Any]:
    """Return the JSON schema of a message class; nullable fields are marked by a description.

    Foxglove's parser (packages/mcap-support/src/parseJsonSchema.ts in foxglove/studio) requires one
    plain `type` per property, one `items` per array and base64 bytes.
    """
    schema = TypeAdapter(kind).json_schema()
    return _plain(schema, schema.get("$defs", {}))


def _plain(schema: Mapping[str, Any], named: Mapping[str, Any]) -> dict[str, Any]:
    """Return a schema without references, alternatives and tuples."""
    if "$ref" in schema:
        return _plain(named[schema["$ref"].removeprefix("#/$defs/")], named)
    if "anyOf" in schema:
        known = [each for each in schema["anyOf"] if each.get("type") != "null"]
        return {**_plain(known[0], named), "description": UNKNOWN}
    plain = {key: value for key, value in schema.items() if key not in ("$defs", "prefixItems")}
    if "properties" in schema:
        plain["properties"] = {
            name: _plain(each, named) for name, each in schema["properties"].items()
        }
    if schema.get("type") == "array":
        items = schema.get("items") or schema["prefixItems"][0]
        plain["items"] = _plain(items, named)
    return plain


JSON = "json"


class Channel(NamedTuple):
    """Topic, schema and encoding of a channel in MCAP's terms."""

    topic: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    encoding: str


def _channel(kind: type[Message]) -> Channel:
    schema = json.dumps(foxglove_schema(kind)).encode()
    name = FOXGLOVE.get(kind, f"airl.{kind.__name__}")
    return Channel(TOPICS[kind], name, "jsonschema", schema, JSON)


CHANNELS = {kind: _channel(kind) for kind in TOPICS}
"""Channels of the message classes above."""

_ADAPTERS: dict[type[Message], TypeAdapter[Any]] = {kind: TypeAdapter(kind) for kind in TOPICS}


def encoded(message: Message) -> tuple[Channel, bytes]:
    """Return the channel and the bytes of a message."""
    kind = type(message)
    return CHANNELS[kind], _ADAPTERS[kind].dump_json(message)

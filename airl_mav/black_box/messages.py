"""Topics and messages of a black box, and their bytes.

Messages are JSON with a JSON Schema, made of the classes here, for any reader of MCAP (Foxglove,
`mcap cat`, pandas). Images and texts have Foxglove's schemas
(https://docs.foxglove.dev/docs/visualization/message-schemas/introduction). Times `*_us` count from
the companion's start [µs]. World frames are NED from the start of the flight, bodies FRD.
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

from airl_mav.core.clock import NS_PER_US
from airl_mav.core.constants import US_PER_S

SUFFIX = ".mcap"

Microseconds: TypeAlias = Annotated[int, Field(ge=-1, lt=2**62)]
Whole: TypeAlias = Annotated[int, Field(ge=0, lt=2**62)]
Base64: TypeAlias = Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]

Number: TypeAlias = float | None
"""None: not a number, or infinite, which JSON cannot say."""

Vector3: TypeAlias = tuple[Number, Number, Number]
Vector4: TypeAlias = tuple[Number, Number, Number, Number]


@dataclass(frozen=True)
class Decision:
    """A decision, as soon as its command is sent."""

    capture_us: Microseconds
    """Exposure of the frame that it saw; -1: stamped by another clock than the companion's."""
    decoded_us: Microseconds
    infer_start_us: Microseconds
    action_ready_us: Microseconds
    sent_us: Microseconds
    held_until_us: Microseconds
    """Until when the action is to be held; `held_before_us` of the next says when it ended."""
    held_before_us: Microseconds
    """When the hold of the decision before had ended; -1: this is the first."""
    position: Vector3
    """Of the vehicle, as the decision saw it [m]."""
    velocity: Vector3
    """[m/s]."""
    quaternion: Vector4
    """w, x, y, z, body to world."""
    goal_away_m: Number
    """Distance to the goal: seen from above, if it has no height [m]."""
    setpoint: Vector4
    """Forward, right, down [m/s] and yaw rate [rad/s], in the heading frame."""


@dataclass(frozen=True)
class Telemetry:
    """What the flight controller says of the vehicle."""

    time_us: Microseconds
    position: Vector3
    """[m]."""
    velocity: Vector3
    """[m/s]."""
    quaternion: Vector4
    """w, x, y, z, body to world."""


@dataclass(frozen=True)
class Truth(Telemetry):
    """What the simulator knows of the vehicle; in files that are exported from a run."""

    power_w: Number
    """Electrical power, without the companion computer's."""


@dataclass(frozen=True)
class Command:
    """The velocity that is commanded now, as the vehicle's heading turns it."""

    time_us: Microseconds
    velocity: Vector3
    """NED [m/s]."""
    yaw_rate: Number
    """[rad/s]."""


@dataclass(frozen=True)
class Latency:
    """How long each stage of a decision took [ms]; None: one of its two ends is not known."""

    sent_us: Microseconds
    """Which decision."""
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
class Status:
    """Who flies, and the battery."""

    time_us: Microseconds
    armed: bool
    offboard: bool
    mode: str
    voltage_v: float | None
    """None of this and the following: the flight controller does not tell."""
    current_a: float | None
    battery_remaining: float | None
    """1 to 0."""


@dataclass(frozen=True)
class Resources:
    """What the companion takes of its computer, and how warm that is."""

    time_us: Microseconds
    process_cores: float
    """Cores that the companion kept busy since the message before."""
    machine_percent: float
    """Share of all cores that everything kept busy since then."""
    memory_bytes: Whole
    """Resident set of the companion."""
    temperature_c: float | None
    """Of the warmest sensor; None: the machine has none."""


@dataclass(frozen=True)
class Phase:
    """A phase of the mission begins."""

    time_us: Microseconds
    phase: str


@dataclass(frozen=True)
class End:
    """The mission has ended."""

    time_us: Microseconds
    reason: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Time:
    """Calendar time, as Foxglove's schemas have it."""

    sec: int
    nsec: int


@dataclass(frozen=True)
class RawImage:
    """foxglove.RawImage: a depth image that a decision saw, before any compensation."""

    timestamp: Time
    frame_id: str
    width: Whole
    height: Whole
    encoding: str
    """`mono16`: depth in millimetres, 0 = no return."""
    step: Whole
    """Bytes of a row."""
    data: Base64
    """The rows, little endian."""


@dataclass(frozen=True)
class Log:
    """foxglove.Log: a text."""

    timestamp: Time
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


Message: TypeAlias = (
    Decision
    | Telemetry
    | Truth
    | Command
    | Latency
    | Status
    | Resources
    | Phase
    | End
    | RawImage
    | Log
)

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

SCHEMAS: dict[type[Message], str] = {
    **{kind: f"airl.{kind.__name__}" for kind in TOPICS},
    RawImage: "foxglove.RawImage",
    Log: "foxglove.Log",
}

INFO, WARNING = 2, 3


ENCODINGS: dict[str, tuple[str, int]] = {
    "mono16": ("<u2", 0),
    "rgb8": ("u1", 3),
    "mono8": ("u1", 1),
}
"""Of depth, colour and grey: type of the numbers, and channels; 0: no axis of them."""


def image_message(image: NDArray[Any], unix_us: int, camera: str = "camera") -> RawImage:
    """Return the message of a depth (h, w) [mm] or colour (h, w, c) image at calendar time."""
    height, width, *channels = image.shape
    encoding = "mono16" if not channels else "rgb8" if channels == [3] else "mono8"
    rows = np.ascontiguousarray(image, ENCODINGS[encoding][0])
    data = base64.b64encode(rows.tobytes()).decode("ascii")
    return RawImage(time_of(unix_us), camera, width, height, encoding, rows.nbytes // height, data)


def image_of(image: RawImage) -> NDArray[Any]:
    """Return the image of a message; raise ValueError for a wrong size or unknown encoding."""
    if image.encoding not in ENCODINGS:
        raise ValueError(f"encoding {image.encoding!r}; accepted: {', '.join(ENCODINGS)}")
    number, channels = ENCODINGS[image.encoding]
    rows = np.frombuffer(base64.b64decode(image.data), number)
    shape = (image.height, image.width, channels) if channels else (image.height, image.width)
    return rows.reshape(shape).astype(np.uint8 if channels else np.uint16)


def text(message: str, name: str, unix_us: int, level: int = INFO) -> Log:
    """Return the message of a text that somebody said at a calendar time [µs]."""
    return Log(time_of(unix_us), level, message, name)


def time_of(unix_us: int) -> Time:
    """Return a calendar time [µs since 1970] as Foxglove's schemas have it."""
    seconds, rest_us = divmod(unix_us, US_PER_S)
    return Time(seconds, rest_us * NS_PER_US)


UNKNOWN = "null: not known"


def foxglove_schema(kind: type[Any]) -> dict[str, Any]:
    """Return the JSON schema of a message class; a description says which fields are nullable.

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
    """What a reader needs to understand the messages of a topic; the terms are MCAP's."""

    topic: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    encoding: str


def _channel(kind: type[Message]) -> Channel:
    schema = json.dumps(foxglove_schema(kind)).encode()
    return Channel(TOPICS[kind], SCHEMAS[kind], "jsonschema", schema, JSON)


CHANNELS = {kind: _channel(kind) for kind in TOPICS}
"""Of our own messages, by their kind."""

_ADAPTERS: dict[type[Message], TypeAdapter[Any]] = {kind: TypeAdapter(kind) for kind in TOPICS}


def encoded(message: Message) -> tuple[Channel, bytes]:
    """Return the channel and the bytes of a message of ours."""
    kind = type(message)
    return CHANNELS[kind], _ADAPTERS[kind].dump_json(message)

"""Messages as bytes, and the channel that says what they are: of files and of live streams."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from pydantic import TypeAdapter

from airl_mav.black_box.messages import SCHEMAS, TOPICS, Message
from airl_mav.black_box.schemas import foxglove_schema

JSON = "json"
"""Encoding of our own messages."""


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

"""Messages as bytes with their channels, for files and live streams.

Foxglove's parser (packages/mcap-support/src/parseJsonSchema.ts in foxglove/studio) requires one
plain `type` per property, one `items` per array and base64 bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from pydantic import TypeAdapter

from airl_mav.black_box.messages import SCHEMAS, TOPICS, Message

UNKNOWN = "null: not known"


def foxglove_schema(kind: type[Any]) -> dict[str, Any]:
    """Return the JSON schema of a message class; a description says which fields are nullable."""
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

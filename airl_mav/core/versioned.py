"""JSON files that carry the version of their schema: written whole, read with one clear line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file

T = TypeVar("T")


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a file for people and programs, whole or not at all. Raises ValueError for a NaN."""
    text = json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    replace_file(path, text.encode())


def read_json(path: Path, schema: int, what: str) -> dict[str, Any]:
    """Return what a file holds.

    Args:
        path: The file.
        schema: Version that is understood.
        what: What the file's folder would hold, for messages.

    Raises:
        UsageError: It is missing, no JSON, or of another version.
    """
    try:
        data = json.loads(path.read_bytes())
    except OSError as error:
        raise UsageError(f"{path.parent}: no {what} here: {path.name}: {error.strerror}") from None
    except ValueError as error:
        raise UsageError(f"{path}: not JSON: {error}") from None
    found = data.get("schema") if isinstance(data, dict) else None
    if found != schema:
        raise UsageError(f"{path}: schema = {found!r}: accepted: {schema}")
    held: dict[str, Any] = data
    return held


def read_versioned(path: Path, adapter: TypeAdapter[T], schema: int, what: str) -> T:
    """Return what a file holds, as its type. Raises UsageError, also for a wrong field."""
    try:
        return adapter.validate_python(read_json(path, schema, what))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise UsageError(f"{path}: {field}: {first['msg']}") from None

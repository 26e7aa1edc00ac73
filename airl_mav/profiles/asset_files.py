"""Files named in an arena's profile, with their digests: meshes and texture images."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from pydantic import (
    Field,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
)

from airl_mav.core.errors import UsageError
from airl_mav.core.fields import ProfileModel

MOST_TRIANGLES = 200_000
"""Maximum triangles of a mesh."""

GREATEST_M = 50.0
"""Maximum distance of a corner from its asset's position, along each axis [m]."""

MOST_BYTES = 1 << 27
"""Maximum size of a file."""

CONTENT = {"content": True}
"""Context of a serialisation of content without file paths."""


class CheckedFile(ProfileModel):
    """A file beside a profile, verified by its digest."""

    file: str = Field(min_length=1, description="a path from the profile's folder")
    sha256: str = Field(description="SHA-256 of that file, hexadecimal")

    @field_validator("sha256")
    @classmethod
    def _is_a_digest(cls, value: str) -> str:
        if len(value) != 64 or set(value) - set("0123456789abcdef"):
            raise ValueError(f"{value!r}; accepted: 64 hexadecimal digits")
        return value

    @model_serializer(mode="wrap")
    def _without_place(
        self, dump: SerializerFunctionWrapHandler, info: SerializationInfo
    ) -> dict[str, Any]:
        """Omit the path if only content counts: the digest identifies the file."""
        data: dict[str, Any] = dump(self)
        if info.context == CONTENT:
            del data["file"]
        return data


class MeshFile(CheckedFile):
    """Triangles that cameras render in place of the parts; collisions use the parts."""

    file: str = Field(
        min_length=1,
        description="the triangles, as `airl asset` writes them (.npz); a path from the profile's"
        " folder",
    )


def read_checked(named: CheckedFile) -> bytes:
    """Return the bytes of a file. Raises UsageError if missing or the digest differs."""
    path = Path(named.file)
    try:
        if path.exists() and not path.is_file():
            raise UsageError(f"{named.file}: no file")
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise UsageError(f"{named.file}: {error.strerror}") from None
    if len(data) > MOST_BYTES:
        raise UsageError(f"{named.file}: accepted: a file of at most {MOST_BYTES:,} bytes")
    found = hashlib.sha256(data).hexdigest()
    if found != named.sha256:
        raise UsageError(
            f"{named.file}: changed since its arena was made: SHA-256 {found[:16]}...; accepted: "
            f"{named.sha256[:16]}..."
        )
    return data


MOST_IMAGES = 16
"""Maximum images of an arena."""


class ImageFile(CheckedFile):
    """An image that repeats on a surface."""

    file: str = Field(
        min_length=1,
        description="a PNG or JPEG, as wide as it is high; a path from the profile's folder",
    )

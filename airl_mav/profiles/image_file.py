"""The file of an image that is the texture of a material."""

from __future__ import annotations

from pydantic import Field

from airl_mav.profiles.mesh_file import CheckedFile

MOST_IMAGES = 16
"""Of one arena."""


class ImageFile(CheckedFile):
    """A picture that repeats on a surface."""

    file: str = Field(
        min_length=1,
        description="a PNG or JPEG, as wide as it is high; a path from the profile's folder",
    )

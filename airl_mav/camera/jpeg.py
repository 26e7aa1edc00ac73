"""JPEG images of colour cameras, by Pillow (libjpeg)."""

from __future__ import annotations

import io
from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError

_MODES: Final = {1: "L", 3: "RGB"}


def jpeg_of(image: NDArray[np.uint8], quality: int) -> bytes:
    """Return an image (h, w, channels), grey or sRGB, as a JPEG file with 4:2:0 chroma."""
    from PIL import Image

    written = io.BytesIO()
    pixels = image[..., 0] if image.shape[2] == 1 else image
    Image.fromarray(pixels).save(written, "JPEG", quality=quality, subsampling="4:2:0")
    return written.getvalue()


def image_of(data: bytes, height: int, width: int, channels: int) -> NDArray[np.uint8]:
    """Return the image (h, w, channels) of a JPEG file of this size.

    Raises:
        ValueError: It is damaged, or has another size or other channels.
        UsageError: Pillow is not installed.
    """
    try:
        from PIL import Image
    except ImportError:
        raise UsageError(
            "the camera sends JPEG, and Pillow is not installed: pip install 'airl-mav[jpeg]'"
        ) from None
    try:
        found = Image.open(io.BytesIO(data), formats=("JPEG",))
        mode = _MODES[channels]
        if found.size != (width, height) or found.mode != mode:
            wide, high = found.size
            raise ValueError(
                f"JPEG of {wide}x{high} {found.mode}, expected {width}x{height} {mode}"
            )
        pixels = np.asarray(found)
    except ValueError:
        raise
    except Exception as error:  # Pillow raises many kinds for damaged files
        raise ValueError(f"no JPEG: {error}") from None
    return np.ascontiguousarray(pixels.reshape(height, width, channels))

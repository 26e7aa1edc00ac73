"""Camera frame and its wire format: one ZeroMQ message, header then pixels."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import UsageError
from airl_mav.profiles import projections

_MODES: Final = {1: "L", 3: "RGB"}


def jpeg_of(image: NDArray[np.uint8], quality: int) -> bytes:
    """Return an image (h, w, channels), grey or sRGB, as a JPEG file with 4:2:0 chroma."""
    from PIL import Image

    written = io.BytesIO()
    # Pillow requires (h, w) for grey.
    pixels = image[..., 0] if image.shape[2] == 1 else image
    Image.fromarray(pixels).save(written, "JPEG", quality=quality, subsampling="4:2:0")
    return written.getvalue()


def image_of(data: bytes, height: int, width: int, channels: int) -> NDArray[np.uint8]:
    """Return the image (h, w, channels) of a JPEG file of this size.

    Raises:
        ValueError: The file is damaged, or has another size or other channels.
        UsageError: Pillow is not installed.
    """
    try:
        from PIL import Image
    except ImportError:
        raise UsageError(
            "the camera sends JPEG, and Pillow is not installed: pip install 'airl-mav[jpeg]'"
        ) from None
    try:
        # Received data reaches no other decoder of Pillow.
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


_LETTERS: Final[dict[projections.CameraKind, str]] = {"depth": "D", "rgb": "R", "grey": "G"}


def _magics(
    first: str, kinds: Iterable[projections.CameraKind], letter: str
) -> dict[Camera, bytes]:
    """Return magic numbers: format, kind, letter of the projection by an attribute, version 1."""
    return {
        (kind, name): f"{first}{_LETTERS[kind]}{getattr(model, letter)}1".encode()
        for kind in kinds
        for name, model in projections.PROJECTIONS.items()
        if getattr(model, letter)
    }


Camera = tuple[projections.CameraKind, projections.Projection]

MAGICS: Final = _magics("A", _LETTERS, "magic")
"""Magic numbers of a frame: air-learning depth, RGB or grey; projection; version 1."""

JPEG_MAGICS: Final = _magics("J", ("rgb", "grey"), "magic")
"""Magic numbers of frames with a JPEG file after the header instead of pixels."""

_DISTORTED: Final = {
    plain[camera]: magic
    for plain, first, kinds in ((MAGICS, "A", tuple(_LETTERS)), (JPEG_MAGICS, "J", ("rgb", "grey")))
    for camera, magic in _magics(first, kinds, "distorted_magic").items()
}
"""Magic numbers of frames with four distortion coefficients between header and pixels."""

_CAMERA_OF = {magic: camera for camera, magic in MAGICS.items()}
_JPEG_CAMERA_OF = {magic: camera for camera, magic in JPEG_MAGICS.items()}

_PIXELS: dict[projections.CameraKind, tuple[str, int]] = {
    "depth": ("<u2", 2),
    "rgb": ("u1", 3),
    "grey": ("u1", 1),
}
"""Number type on the wire, and bytes per pixel."""

_UNDISTORTED_AS = {magic: plain for plain, magic in _DISTORTED.items()}

# magic, sequence, capture time [µs], width, height, focal, cx, cy; little endian
_HEADER = struct.Struct("<4sQqHHddd")

# k1, k2, k3, k4; little endian
_COEFFICIENTS = struct.Struct("<4d")

RIG_MAGIC = b"AMF1"
"""Magic number of a frame of several cameras: air-learning, many frames; version 1."""

# magic, images; then for each image: bytes of its name, bytes of its message; little endian
_RIG_HEADER, _PART_HEADER = struct.Struct("<4sH"), struct.Struct("<BI")

MOST_IMAGES = 64
"""Maximum number of images in a frame."""

MOST_NAME = 255
"""Maximum length of a camera's name in bytes."""

MOST_PIXELS = 4096 * 4096
_MOST_ADDED = _HEADER.size + _COEFFICIENTS.size + _PART_HEADER.size + MOST_NAME
MOST_BYTES = _RIG_HEADER.size + MOST_IMAGES * _MOST_ADDED + 3 * MOST_PIXELS
"""Maximum size of a frame, 50 MB; bounds a receiver's buffer."""

MM_PER_M = 1000.0
# Maximum of uint16.
MAX_MM = 65_535

LEAST_PX, MOST_PX = 1e-3, 1e6
"""Limits of the focal length, and of the offset of the optical axis from the image corner [px]."""


class FrameError(ValueError):
    """Error: the bytes are not a frame of this version."""


@dataclass(frozen=True)
class FurtherImage:
    """Image of an additional camera, taken at the same time; fields as in `Frame`."""

    image: NDArray[Any]
    intrinsics: Intrinsics
    jpeg: bytes | None = None


@dataclass(frozen=True)
class Frame:
    """Image of a camera, with the simultaneous images of the vehicle's additional cameras."""

    sequence: int
    """Frame counter; increments by one per captured frame."""
    capture_time_us: int
    """Simulated time of the exposure [µs]."""
    image: NDArray[Any]
    """Pixels. Depth: uint16 (height, width), RealSense Z16 convention [mm]; 0 = no return. Measured
    along the optical axis of a pinhole, in the camera's horizontal plane of a cylinder, along the
    ray of a fisheye. Colour: uint8 (height, width, 3) sRGB, or (height, width, 1) grey."""
    intrinsics: Intrinsics
    """Intrinsics of the camera; `kind` defines the pixel format."""
    jpeg: bytes | None = None
    """JPEG file that `image` was decoded from; None = never compressed."""
    further: Mapping[str, FurtherImage] = field(default_factory=dict)
    """Additional images by camera name; empty with the main camera only."""

    @property
    def lenses(self) -> dict[str, Intrinsics]:
        """Intrinsics of the additional cameras by name."""
        return {name: each.intrinsics for name, each in self.further.items()}

    @property
    def depth_mm(self) -> NDArray[np.uint16]:
        """Depth (height, width) [mm]; 0 = no return. Raises UsageError for a colour camera."""
        return depth_only(self.image, self.intrinsics)

    def depth_m(self) -> NDArray[np.float32]:
        """Return depth (height, width) [m]; 0 = no return."""
        return self.depth_mm.astype(np.float32) / np.float32(MM_PER_M)

    def to_bytes(self) -> bytes:
        """Return the wire form; a single image uses the format without additional cameras."""
        if not self.further:
            return self._message()
        # The main image comes first with an empty name, as `_of_several` requires.
        parts = [("", self._message())]
        for name, each in self.further.items():
            # Each part is a complete frame with its own header.
            alone = Frame(
                self.sequence, self.capture_time_us, each.image, each.intrinsics, each.jpeg
            )
            parts.append((name, alone._message()))
        wire = [_RIG_HEADER.pack(RIG_MAGIC, len(parts))]
        for name, message in parts:
            called = name.encode("ascii")
            wire += [_PART_HEADER.pack(len(called), len(message)), called, message]
        return b"".join(wire)

    def _message(self) -> bytes:
        """Return the wire form of the main image only."""
        k = self.intrinsics
        magic = (MAGICS if self.jpeg is None else JPEG_MAGICS)[k.kind, k.projection]
        distorts = k.distortion != projections.UNDISTORTED
        header = _HEADER.pack(
            _DISTORTED[magic] if distorts else magic,
            *(self.sequence, self.capture_time_us),
            *(k.width, k.height, k.focal, k.cx, k.cy),
        )
        if distorts:
            header += _COEFFICIENTS.pack(*k.distortion)
        if self.jpeg is not None:
            return header + self.jpeg
        return header + self.image.astype(_PIXELS[k.kind][0], copy=False).tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> Frame:
        """Read the wire form.

        Raises:
            FrameError: Not a frame, values out of bounds, a damaged or misfit JPEG, or images with
                different timestamps or equal names.
            UsageError: A JPEG without Pillow.
        """
        if data[: len(RIG_MAGIC)] == RIG_MAGIC:
            return _of_several(cls, data)
        if len(data) < _HEADER.size:
            raise FrameError(f"{len(data)} bytes are too short for a frame header")
        magic, sequence, time_us, width, height, focal, cx, cy = _HEADER.unpack_from(data)
        plain = _UNDISTORTED_AS.get(magic, magic)
        camera = _CAMERA_OF.get(plain) or _JPEG_CAMERA_OF.get(plain)
        if camera is None:
            magics = (*_CAMERA_OF, *_JPEG_CAMERA_OF, *_UNDISTORTED_AS, RIG_MAGIC)
            known = " or ".join(repr(each) for each in magics)
            raise FrameError(f"magic {magic!r}, expected {known}")
        kind, projection = camera
        number, size = _PIXELS[kind]
        compressed, distortion, begins = (
            plain in _JPEG_CAMERA_OF,
            projections.UNDISTORTED,
            _HEADER.size,
        )
        if plain != magic:
            distortion, begins = _coefficients(data), _HEADER.size + _COEFFICIENTS.size
        if not compressed and len(data) != begins + size * width * height:
            raise FrameError(f"{len(data)} bytes do not hold {width}x{height} pixels of {kind}")
        if not 0 < width * height <= MOST_PIXELS:
            raise FrameError(f"{width}x{height} pixels: accepted: 1..{MOST_PIXELS}")
        # Written so that NaN fails.
        if not (LEAST_PX <= focal <= MOST_PX and abs(cx) <= MOST_PX and abs(cy) <= MOST_PX):
            raise FrameError(f"focal {focal}, centre {cx}, {cy}: no {projection} camera")
        if (problem := projections.PROJECTIONS[projection].problem(width, focal)) is not None:
            raise FrameError(problem)
        lens = Intrinsics(width, height, focal, cx, cy, projection, kind, distortion)
        if compressed:
            jpeg = data[begins:]
            try:
                decoded = image_of(jpeg, height, width, size)
            except ValueError as error:
                raise FrameError(str(error)) from None
            return cls(sequence, time_us, decoded, lens, jpeg)
        # A read-only view of the message, without a copy.
        pixels = np.frombuffer(data, number, offset=begins)
        return cls(
            sequence, time_us, pixels.reshape(projections.shape_of(kind, height, width)), lens
        )


def _coefficients(data: bytes) -> projections.Distortion:
    """Return the coefficients after a header. Raises FrameError."""
    if len(data) < _HEADER.size + _COEFFICIENTS.size:
        raise FrameError(f"{len(data)} bytes are too short for the coefficients of a lens")
    k1, k2, k3, k4 = _COEFFICIENTS.unpack_from(data, _HEADER.size)
    # Written so that NaN fails.
    if not all(abs(each) <= projections.MOST_COEFFICIENT for each in (k1, k2, k3, k4)):
        raise FrameError(f"coefficients {k1}, {k2}, {k3}, {k4}: no fisheye")
    return k1, k2, k3, k4


def _of_several(kind: type[Frame], data: bytes) -> Frame:
    """Return the frame of a message with several images. Raises as `Frame.from_bytes`."""
    if len(data) < _RIG_HEADER.size:
        raise FrameError(f"{len(data)} bytes are too short for a frame of several cameras")
    _, count = _RIG_HEADER.unpack_from(data)
    if not 1 <= count <= MOST_IMAGES:
        raise FrameError(f"{count} images: accepted: 1..{MOST_IMAGES}")
    at, taken, pixels = _RIG_HEADER.size, dict[str, Frame](), 0
    for _ in range(count):
        if len(data) < at + _PART_HEADER.size:
            raise FrameError(f"{len(data)} bytes are too short for {count} images")
        named, size = _PART_HEADER.unpack_from(data, at)
        begins = at + _PART_HEADER.size + named
        at = begins + size
        if len(data) < at:
            raise FrameError(f"{len(data)} bytes are too short for {count} images")
        message = data[begins : begins + size]
        # Nesting would allow unbounded recursion.
        if message[: len(RIG_MAGIC)] == RIG_MAGIC:
            raise FrameError("a frame of several cameras within one")
        # latin-1 decodes every byte, so a damaged name raises no UnicodeDecodeError.
        name = data[begins - named : begins].decode("latin-1")
        if name in taken or (not taken) != (name == ""):
            raise FrameError(f"camera {name!r}: accepted: first one without a name, then others")
        taken[name] = frame = kind.from_bytes(message)
        # The sum is limited too, so that many images cannot exceed MOST_BYTES.
        pixels += frame.intrinsics.width * frame.intrinsics.height
        if pixels > MOST_PIXELS:
            raise FrameError(f"{pixels} pixels of several cameras: accepted: 1..{MOST_PIXELS}")
    if at != len(data):
        raise FrameError(f"{len(data) - at} bytes behind the last of {count} images")
    main = taken.pop("")
    for name, each in taken.items():
        if (each.sequence, each.capture_time_us) != (main.sequence, main.capture_time_us):
            raise FrameError(f"camera {name!r}: an image of another moment than the main one's")
    further = {
        name: FurtherImage(each.image, each.intrinsics, each.jpeg) for name, each in taken.items()
    }
    return kind(
        *(main.sequence, main.capture_time_us, main.image, main.intrinsics, main.jpeg), further
    )


def depth_only(image: NDArray[Any], intrinsics: Intrinsics) -> NDArray[np.uint16]:
    """Return an image of a depth camera unchanged. Raises UsageError for colour images."""
    if intrinsics.kind != "depth":
        raise UsageError(f"{intrinsics.kind} camera: it gives no depth; accepted: depth")
    return image


def rgb_of(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image of a colour camera, (h, w, 3) or grey (h, w, 1), as RGB (h, w, 3)."""
    return np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image


def nearness(depth_mm: NDArray[Any], range_m: float) -> NDArray[np.float64]:
    """Return 1 - sqrt(depth / range), clipped: 1 at the camera, 0 at a range [m]; depth in mm."""
    near: NDArray[np.float64] = 1.0 - np.sqrt(np.clip(depth_mm / (MM_PER_M * range_m), 0.0, 1.0))
    return near


def depth_to_z16(depth_m: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Convert metres (0 = no return) to Z16 millimetres, rounded, clipped to 65,535 mm."""
    z16: NDArray[np.uint16] = np.clip(np.rint(depth_m * MM_PER_M), 0, MAX_MM).astype(np.uint16)
    return z16

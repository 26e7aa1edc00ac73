"""The wire format of a depth frame."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from airl_mav.camera.frame import (
    LEAST_PX,
    MAX_MM,
    MOST_PX,
    Frame,
    FrameError,
    FurtherImage,
    depth_to_z16,
)
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import UsageError
from airl_mav.profiles.projections import (
    KINDS,
    MOST_COEFFICIENT,
    PROJECTIONS,
    UNDISTORTED,
    CameraKind,
    Projection,
)

lengths = st.floats(-MOST_PX, MOST_PX)
focals = st.floats(LEAST_PX, MOST_PX)


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    width, height = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    projection, focal = draw(st.sampled_from(list(PROJECTIONS))), draw(focals)
    if projection == "cylindrical":
        focal = max(focal, width / (2.0 * math.pi))
    kind = draw(st.sampled_from(KINDS))
    some = st.floats(-MOST_COEFFICIENT, MOST_COEFFICIENT)
    bent = st.just(UNDISTORTED) | st.tuples(some, some, some, some)
    distortion = draw(bent) if projection == "fisheye" else UNDISTORTED
    place = draw(lengths), draw(lengths)
    k = Intrinsics(width, height, focal, *place, projection, kind, distortion)
    image = draw(arrays(k.dtype, k.shape))
    sequence = draw(st.integers(0, 2**64 - 1))
    return Frame(sequence, draw(st.integers(-(2**63), 2**63 - 1)), image, k)


@given(frames())
def test_round_trip(frame: Frame) -> None:
    back = Frame.from_bytes(frame.to_bytes())
    assert (back.sequence, back.capture_time_us) == (frame.sequence, frame.capture_time_us)
    assert back.intrinsics == frame.intrinsics
    assert (back.image.dtype, back.image.shape) == (frame.image.dtype, frame.intrinsics.shape)
    np.testing.assert_array_equal(back.image, frame.image)


def test_wire_layout() -> None:
    """Another language can read it: 48 bytes of header, then rows of little-endian millimetres."""
    depth = np.array([[1, 256, 65535], [0, 2, 3]], np.uint16)
    wire = Frame(7, 123_456, depth, Intrinsics(3, 2, 1.5, 1.0, 0.5)).to_bytes()
    assert wire[:4] == b"ADF1"
    assert struct.unpack_from("<QqHH", wire, 4) == (7, 123_456, 3, 2)
    assert struct.unpack_from("<ddd", wire, 24) == (1.5, 1.0, 0.5)
    assert wire[48:] == bytes([1, 0, 0, 1, 255, 255, 0, 0, 2, 0, 3, 0])


def test_a_cylinder_says_so_in_its_first_bytes_and_is_laid_out_alike() -> None:
    depth = np.array([[1, 256, 65535], [0, 2, 3]], np.uint16)
    pinhole = Frame(7, 123_456, depth, Intrinsics(3, 2, 1.5, 1.0, 0.5)).to_bytes()
    wire = Frame(7, 123_456, depth, Intrinsics(3, 2, 1.5, 1.0, 0.5, "cylindrical")).to_bytes()
    assert wire[:4] == b"ADC1"
    assert wire[4:] == pinhole[4:]
    assert Frame.from_bytes(wire).intrinsics.projection == "cylindrical"
    assert Frame.from_bytes(pinhole).intrinsics.projection == "pinhole"


@pytest.mark.parametrize(
    ("kind", "projection", "magic", "channels"),
    [
        ("rgb", "pinhole", b"ARF1", 3),
        ("rgb", "cylindrical", b"ARC1", 3),
        ("grey", "pinhole", b"AGF1", 1),
        ("grey", "cylindrical", b"AGC1", 1),
    ],
)
def test_colours_go_out_pixel_by_pixel_under_their_own_magic(
    kind: CameraKind, projection: Projection, magic: bytes, channels: int
) -> None:
    image = np.arange(6 * channels, dtype=np.uint8).reshape(2, 3, channels)
    lens = Intrinsics(3, 2, 1.5, 1.0, 0.5, projection, kind)
    wire = Frame(7, 123_456, image, lens).to_bytes()
    assert wire[:4] == magic
    assert wire[48:] == bytes(range(6 * channels))
    # A receiver of depth only, as before colour was added, reports the received data.
    with pytest.raises(FrameError, match="bytes do not hold 3x2 pixels of depth"):
        Frame.from_bytes(b"ADF1" + wire[4:])
    with pytest.raises(FrameError, match="magic b'ARX1', expected b'ADF1'"):
        Frame.from_bytes(b"ARX1" + wire[4:])
    with pytest.raises(UsageError, match=f"^{kind} camera: it gives no depth; accepted: depth"):
        _ = Frame.from_bytes(wire).depth_mm


@pytest.mark.parametrize("width", [128, 40, 7])
def test_a_full_turn_is_the_widest_cylinder(width: int) -> None:
    full = Intrinsics.from_fov(width, 2, 2.0 * math.pi, "cylindrical")
    pixels = np.zeros((2, width), np.uint16)
    assert Frame.from_bytes(Frame(0, 0, pixels, full).to_bytes()).intrinsics == full
    wider = Intrinsics(width, 2, 0.999 * full.focal, full.cx, full.cy, "cylindrical")
    with pytest.raises(FrameError, match="more than one turn"):
        Frame.from_bytes(Frame(0, 0, pixels, wider).to_bytes())


def test_pixels_that_are_not_contiguous_go_out_in_order() -> None:
    depth = np.arange(24, dtype=np.uint16).reshape(4, 6)[:, ::2]
    frame = Frame(0, 0, depth, Intrinsics(3, 4, 1.0, 1.0, 1.0))
    np.testing.assert_array_equal(Frame.from_bytes(frame.to_bytes()).depth_mm, depth)


@given(st.binary(max_size=200))
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(FrameError):
        Frame.from_bytes(data)


@given(frames(), st.data())
def test_damaged_frames_are_refused(frame: Frame, data: st.DataObject) -> None:
    wire = frame.to_bytes()
    cut = data.draw(st.integers(0, len(wire) - 1))
    for damaged in (wire[:cut], wire + b"\0", b"ADF2" + wire[4:]):
        with pytest.raises(FrameError):
            Frame.from_bytes(damaged)


def test_a_size_that_the_pixels_do_not_fill_is_refused() -> None:
    wire = bytearray(Frame(0, 0, np.ones((2, 3), np.uint16), Intrinsics(3, 2, 1, 1, 1)).to_bytes())
    struct.pack_into("<HH", wire, 20, 65535, 65535)
    with pytest.raises(FrameError, match="65535x65535"):
        Frame.from_bytes(bytes(wire))


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        (Intrinsics(0, 2, 1.0, 1.0, 1.0), "0x2 pixels"),
        (Intrinsics(3, 0, 1.0, 1.0, 1.0), "3x0 pixels"),
        (Intrinsics(1, 1, 0.0, 1.0, 1.0), "focal 0"),
        (Intrinsics(1, 1, -2.0, 1.0, 1.0), "focal -2"),
        (Intrinsics(1, 1, math.nan, 1.0, 1.0), "focal nan"),
        (Intrinsics(1, 1, math.inf, 1.0, 1.0), "focal inf"),
        (Intrinsics(1, 1, 1.0, math.nan, 1.0), "centre nan"),
        (Intrinsics(1, 1, 1.0, 1.0, -math.inf), "centre 1.0, -inf"),
    ],
)
def test_what_no_camera_takes_is_refused(lens: Intrinsics, said: str) -> None:
    pixels = np.zeros((lens.height, lens.width), np.uint16)
    with pytest.raises(FrameError, match=said):
        Frame.from_bytes(Frame(0, 0, pixels, lens).to_bytes())


def test_z16_rounds_clips_and_keeps_no_return() -> None:
    depth = np.array([[0.0, 0.001, 0.0014, 0.0016, 19.9996, 65.535, 70.0]], np.float32)
    expected = [[0, 1, 1, 2, 20000, MAX_MM, MAX_MM]]
    assert depth_to_z16(depth).tolist() == expected


@given(arrays(np.float32, 20, elements=st.floats(0.0, 65.0, width=32)))
def test_z16_is_within_half_a_millimetre(depth: np.ndarray) -> None:
    frame = Frame(0, 0, depth_to_z16(depth).reshape(4, 5), Intrinsics(5, 4, 1, 1, 1))
    assert frame.depth_m().dtype == np.float32
    np.testing.assert_allclose(frame.depth_m().ravel(), depth, atol=0.00051)


# --- frames of several cameras


@st.composite
def rigs(draw: st.DrawFn) -> Frame:
    main = draw(frames())
    names = st.text("abcdefghijklmnopqrstuvwxyz_0123456789", min_size=1, max_size=24)
    others = draw(st.dictionaries(names, frames(), min_size=1, max_size=4))
    further = {name: FurtherImage(each.image, each.intrinsics) for name, each in others.items()}
    return replace(main, further=further)


@given(rigs())
def test_a_rig_comes_back_with_all_images(frame: Frame) -> None:
    back = Frame.from_bytes(frame.to_bytes())
    assert (back.sequence, back.capture_time_us) == (frame.sequence, frame.capture_time_us)
    assert back.intrinsics == frame.intrinsics
    assert list(back.lenses.items()) == list(frame.lenses.items())
    np.testing.assert_array_equal(back.image, frame.image)
    for name, each in frame.further.items():
        np.testing.assert_array_equal(back.further[name].image, each.image)


@given(rigs(), st.data())
def test_damaged_rigs_are_refused(frame: Frame, data: st.DataObject) -> None:
    wire = frame.to_bytes()
    cut = data.draw(st.integers(0, len(wire) - 1))
    for damaged in (
        wire[:cut],
        wire + b"\0",
        b"AMF2" + wire[4:],
        wire[:4] + b"\xff\xff" + wire[6:],
    ):
        with pytest.raises(FrameError):
            Frame.from_bytes(damaged)


def rig() -> Frame:
    lens = Intrinsics(3, 2, 1.5, 1.0, 0.5)
    grey = Intrinsics(2, 1, 1.0, 0.5, 0.0, kind="grey")
    depth = np.arange(6, dtype=np.uint16).reshape(2, 3)
    down = FurtherImage(np.array([[[8], [9]]], np.uint8), grey)
    return Frame(7, 123_456, depth, lens, further={"down": down})


def test_a_rig_on_the_wire_is_whole_messages_one_behind_the_other() -> None:
    """Another language can read it, and a message of one camera is as it was before."""
    frame = rig()
    main = replace(frame, further={}).to_bytes()
    assert main[:4] == b"ADF1"
    wire = frame.to_bytes()
    assert wire[:6] == b"AMF1" + struct.pack("<H", 2)
    assert wire[6:11] == struct.pack("<BI", 0, len(main))
    assert wire[11 : 11 + len(main)] == main
    rest = wire[11 + len(main) :]
    assert rest[:9] == struct.pack("<BI", 4, 50) + b"down"
    assert rest[9:13] == b"AGF1"
    assert struct.unpack_from("<Qq", rest, 13) == (7, 123_456)
    assert rest[57:] == bytes([8, 9])
    with pytest.raises(FrameError, match="magic b'AMX1'"):
        Frame.from_bytes(b"AMX1" + wire[4:])


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ([("down", 7, 5)], "camera 'down': accepted: first one without a name"),
        ([("", 7, 5), ("", 7, 5)], "camera '': accepted"),
        ([("", 7, 5), ("a", 7, 5), ("a", 7, 5)], "camera 'a': accepted"),
        ([("", 7, 5), ("a", 8, 5)], "camera 'a': an image of another moment"),
        ([("", 7, 5), ("a", 7, 6)], "camera 'a': an image of another moment"),
    ],
)
def test_images_that_are_no_rig_s_are_refused(parts: list[tuple[str, int, int]], told: str) -> None:
    wire = b"AMF1" + struct.pack("<H", len(parts))
    for name, sequence, time_us in parts:
        depth, lens = np.zeros((1, 1), np.uint16), Intrinsics(1, 1, 1.0, 0.0, 0.0)
        message = Frame(sequence, time_us, depth, lens).to_bytes()
        wire += struct.pack("<BI", len(name), len(message)) + name.encode() + message
    with pytest.raises(FrameError, match=told):
        Frame.from_bytes(wire)


def test_a_rig_within_a_rig_is_refused() -> None:
    inner = rig().to_bytes()
    wire = b"AMF1" + struct.pack("<H", 1) + struct.pack("<BI", 0, len(inner)) + inner
    with pytest.raises(FrameError, match="several cameras within one"):
        Frame.from_bytes(wire)

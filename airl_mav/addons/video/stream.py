"""Video of a camera for ground stations: H.264 over RTP, announced by MAVLink's camera protocol.

QGroundControl and MAVSDK find the component by its heartbeat, request CAMERA_INFORMATION, and show
the stream of VIDEO_STREAM_INFORMATION (https://mavlink.io/en/services/camera.html). The component
reports that photos and recording are unsupported.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final, NamedTuple

import numpy as np
from mavsdk import ComponentType, Mavsdk
from mavsdk.plugins.mavlink_direct_server import MavlinkDirectServer, MavlinkMessage
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame, FurtherImage, nearness, rgb_of
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import constants, errors
from airl_mav.core.clock import Clock
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import VehicleProfile
from companion.frame_source import FrameSource, OpenCamera, ReceivedFrame, open_named_camera
from companion.mavsdk_connection import open_connection

LEAST_PX: Final = 320
"""Minimum width of the video [px]; smaller images are enlarged by an integer factor."""

DARKEST: Final = 32.0
"""Grey value of the maximum range, 0 to 255; pixels without a return are darker."""

KEYFRAME_S: Final = 1.0
"""Interval of keyframes [s], and so the maximum wait of a new viewer."""

CRF: Final = 23
"""Quality of x264, its default: 0 = lossless, 51 = worst."""

_CLOCK_HZ: Final = 90_000
"""Clock rate of H.264 time stamps in RTP (RFC 6184)."""


def picture_of(frame: Frame | FurtherImage, range_m: float) -> NDArray[np.uint8]:
    """Return an image as a picture (h, w, 3) with even sides; near = bright, no return = black."""
    if frame.intrinsics.kind == "depth":
        # The shade is linear in nearness from DARKEST to white.
        shade = DARKEST + (255.0 - DARKEST) * nearness(frame.image, range_m)
        grey = np.where(frame.image == 0, 0.0, shade).astype(np.uint8)
        picture = rgb_of(grey[..., None])
    else:
        picture = rgb_of(frame.image)
    # Small images are enlarged by repetition, which keeps pixels visible.
    times = enlargement(frame.intrinsics)
    larger = picture.repeat(times, axis=0).repeat(times, axis=1)
    # H.264 with subsampled colour requires even sides.
    width, height = picture_size(frame.intrinsics)
    return np.ascontiguousarray(larger[:height, :width])


def enlargement(lens: Intrinsics) -> int:
    """Return the integer enlargement factor of a picture."""
    least = max(LEAST_PX / lens.width, 2.0 / lens.height)
    return max(1, math.ceil(least))


def picture_size(lens: Intrinsics) -> tuple[int, int]:
    """Return width and height of the pictures of a camera [px]."""
    times = enlargement(lens)
    return lens.width * times // 2 * 2, lens.height * times // 2 * 2


class RtpVideo:
    """Encoder that sends each picture immediately to one address."""

    def __init__(self, host: str, port: int, size: tuple[int, int], rate_hz: float) -> None:
        """Open a stream of pictures (width, height) to a UDP port; ImportError without PyAV."""
        import av

        self._av = av
        self._container = av.open(f"rtp://{host}:{port}", "w", format="rtp")
        self._stream: Any = self._container.add_stream("libx264", Fraction(round(rate_hz)))
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.time_base = Fraction(1, _CLOCK_HZ)
        # A viewer that joins late waits for the next keyframe.
        self._stream.codec_context.gop_size = max(1, round(KEYFRAME_S * rate_hz))
        # One slice per picture and no buffering, so that each picture is sent at once.
        self._stream.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": f"{CRF}"}
        self._stream.codec_context.thread_count = 1
        self._first_us: int | None = None
        self._last_pts = -1

    def show(self, picture: NDArray[np.uint8], time_us: int) -> None:
        """Send a picture (h, w, 3) at a time [µs], unless older than the last; raises OSError."""
        if self._first_us is None:
            self._first_us = time_us
        # The stream starts at 0 and uses RTP's 90 kHz clock.
        pts = (time_us - self._first_us) * _CLOCK_HZ // constants.US_PER_S
        if pts <= self._last_pts:
            return
        self._last_pts = pts
        image = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        image.pts, image.time_base = pts, Fraction(1, _CLOCK_HZ)
        self._container.mux(self._stream.encode(image))

    def close(self) -> None:
        """End the stream."""
        with suppress(OSError):
            self._container.close()


STREAM_ID: Final = 1
"""Id of the only stream; a request for 0 means all streams."""

MESSAGES: Final = {
    259: "CAMERA_INFORMATION",
    260: "CAMERA_SETTINGS",
    261: "STORAGE_INFORMATION",
    262: "CAMERA_CAPTURE_STATUS",
    269: "VIDEO_STREAM_INFORMATION",
    270: "VIDEO_STREAM_STATUS",
}
"""Messages sent on request (common.xml)."""

CAMERA_INFORMATION, STREAM_INFORMATION, STREAM_STATUS = 259, 269, 270

REQUEST_MESSAGE, VIDEO_START_STREAMING, VIDEO_STOP_STREAMING = 512, 2502, 2503
"""Supported commands."""

OLD_REQUESTS: Final = {521: 259, 522: 260, 525: 261, 527: 262, 2504: 269, 2505: 270}
"""Commands that request one message each, older than REQUEST_MESSAGE; clients still send them."""

WITHOUT_EFFECT: Final = (
    *(526, 529, 530, 531, 532),  # format storage, reset, set mode, zoom, focus
    *(2000, 2001, 2004, 2005, 2010, 2500, 2501),  # photos, tracking, recording
)
"""Unsupported camera commands; without a handler, MAVSDK would not answer them."""

ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
"""MAV_RESULT."""

NAME_BYTES: Final = 32

Fields = dict[str, Any]


@dataclass(frozen=True)
class VideoStream:
    """Description of camera and video."""

    model: str
    """Camera model; at most 31 characters are sent."""
    size_px: tuple[int, int]
    rate_hz: float
    horizontal_fov_deg: float
    port: int


def camera_messages(stream: VideoStream, *, running: bool) -> dict[str, Fields]:
    """Return the fields of `MESSAGES` by name, without the time; 0 = unknown lens sizes."""
    width_px, height_px = stream.size_px
    size = {"resolution_h": width_px, "resolution_v": height_px}
    status = {
        "stream_id": STREAM_ID,
        "flags": int(running),  # VIDEO_STREAM_STATUS_FLAGS_RUNNING
        "framerate": stream.rate_hz,
        **size,
        "bitrate": 0,  # determined by the quality
        "rotation": 0,
        "hfov": round(stream.horizontal_fov_deg),
    }
    return {
        "CAMERA_INFORMATION": {
            "vendor_name": _bytes("airl-mav"),
            "model_name": _bytes(stream.model),
            "firmware_version": 0,
            **dict.fromkeys(("focal_length", "sensor_size_h", "sensor_size_v"), 0.0),
            **size,
            "lens_id": 0,
            "flags": 256,  # CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
            "cam_definition_version": 0,
            "cam_definition_uri": "",
            "gimbal_device_id": 0,
        },
        "CAMERA_SETTINGS": {"mode_id": 1},  # CAMERA_MODE_VIDEO
        "STORAGE_INFORMATION": {
            "storage_id": 0,
            "storage_count": 0,
            "status": 3,  # STORAGE_STATUS_NOT_SUPPORTED
            **dict.fromkeys(("total_capacity", "used_capacity", "available_capacity"), 0.0),
            **dict.fromkeys(("read_speed", "write_speed"), 0.0),
        },
        "CAMERA_CAPTURE_STATUS": {
            **dict.fromkeys(("image_status", "video_status", "image_count"), 0),
            **dict.fromkeys(("image_interval", "available_capacity"), 0.0),
            "recording_time_ms": 0,
        },
        "VIDEO_STREAM_STATUS": status,
        "VIDEO_STREAM_INFORMATION": {
            **status,
            "count": 1,
            "type": 1,  # VIDEO_STREAM_TYPE_RTPUDP, with the port of the receiver as URI
            "name": stream.model[: NAME_BYTES - 1],
            "uri": f"{stream.port}",
            "encoding": 1,  # VIDEO_STREAM_ENCODING_H264
        },
    }


def _bytes(text: str) -> list[int]:
    """Return a name as an array of uint8, the type of these fields."""
    name = text.encode("ascii", "replace")[: NAME_BYTES - 1]
    return list(name.ljust(NAME_BYTES, b"\0"))


class CameraComponent:
    """Camera component that answers requests in MAVSDK's threads."""

    def __init__(self, mavsdk: Mavsdk, stream: VideoStream, clock: Clock) -> None:
        """Announce a stream by a MAVSDK connected as a camera component (`open_connection`)."""
        self.running = True
        """True while the video is enabled; clients may stop and restart it."""
        self._clock, self._stream = clock, stream
        self._server = MavlinkDirectServer(mavsdk.server_component(0))
        streaming = (VIDEO_START_STREAMING, VIDEO_STOP_STREAMING)
        # MAVSDK answers only commands with a subscription.
        for command in (REQUEST_MESSAGE, *OLD_REQUESTS, *streaming, *WITHOUT_EFFECT):
            self._server.subscribe_command(command, self._asked)

    def _asked(self, message: MavlinkMessage, _data: object) -> None:
        fields = json.loads(message.fields_json)
        # An omitted parameter is NaN, which JSON cannot represent.
        one, two = (int(fields.get(name) or 0) for name in ("param1", "param2"))
        sender = message.system_id, message.component_id
        result, wanted = self._carried_out(int(fields["command"]), one, two)
        # The acknowledgement is first, as a client may wait for it alone.
        acknowledged = {
            "command": fields["command"],
            "result": result,
            "progress": 0,
            "result_param2": 0,
            "target_system": sender[0],
            "target_component": sender[1],
        }
        self._send("COMMAND_ACK", acknowledged, sender)
        made = camera_messages(self._stream, running=self.running)
        for name in (MESSAGES[number] for number in wanted):
            if not name.startswith("VIDEO"):
                made[name]["time_boot_ms"] = self._clock.time_us() // constants.US_PER_MS
            self._send(name, made[name], sender)

    def _carried_out(self, command: int, one: int, two: int) -> tuple[int, tuple[int, ...]]:
        """Return the result of a command with its parameters, and the requested messages."""
        if command in (VIDEO_START_STREAMING, VIDEO_STOP_STREAMING):
            # Stream id 0 addresses all streams.
            if one not in (0, STREAM_ID):
                return DENIED, ()
            self.running = command == VIDEO_START_STREAMING
            return ACCEPTED, ()
        asked = one if command == REQUEST_MESSAGE else OLD_REQUESTS.get(command)
        if asked not in MESSAGES:
            return UNSUPPORTED, ()
        if asked == CAMERA_INFORMATION:
            # MAVSDK requests the stream only 20 s later.
            return ACCEPTED, (CAMERA_INFORMATION, STREAM_INFORMATION)
        if asked in (STREAM_INFORMATION, STREAM_STATUS):
            # REQUEST_MESSAGE has the stream id in parameter 2, the older commands in parameter 1.
            which = two if command == REQUEST_MESSAGE else one
            if which not in (0, STREAM_ID):
                return DENIED, ()
        return ACCEPTED, (asked,)

    def _send(self, name: str, fields: Fields, to: tuple[int, int]) -> None:
        self._server.send_message(MavlinkMessage(name, 0, 0, *to, json.dumps(fields)))

    def close(self) -> None:
        """Remove the component."""
        self._server.destroy()


WAIT_S = 0.5
"""Maximum single wait for a frame [wall s], and so the maximum reaction time to `stop`."""

DEFAULT_SYSTEM_ID = 1
"""Default MAV_SYS_ID of vehicles, and system id of MAVSDK's camera component."""


class OnNetwork:
    """Camera component on the MAVLink network, once a vehicle is received there."""

    def __init__(self, url: str, clock: Clock) -> None:
        """Open a MAVSDK connection. Raises UsageError for an unusable address."""
        self._url, self._clock = url, clock
        self._mavsdk = open_connection(url, ComponentType.CAMERA)
        self._component: CameraComponent | None = None

    @property
    def running(self) -> bool:
        """True while the video is enabled, until a client stops it."""
        return self._component is None or self._component.running

    def join(self, stream: VideoStream) -> bool:
        """Join the vehicle if it is received; return True if joined by this call."""
        if self._component is not None:
            return False
        # The vehicle's system id is known only once a vehicle is heard.
        system = next((each for each in self._mavsdk.get_systems() if each.has_autopilot()), None)
        if system is None:
            return False
        number = system.get_system_id()
        if number != DEFAULT_SYSTEM_ID:
            # All messages of a component carry the vehicle's system id, from the first one on.
            self._mavsdk.destroy()
            self._mavsdk = open_connection(self._url, ComponentType.CAMERA, number)
        self._component = CameraComponent(self._mavsdk, stream, self._clock)
        return True

    def close(self) -> None:
        """Leave the network."""
        if self._component is not None:
            self._component.close()
        self._mavsdk.destroy()


class ShownCamera(NamedTuple):
    """Camera with the images to show."""

    camera: str
    """Camera name for `open_named_camera`."""
    vehicle: str
    profile: VehicleProfile
    """Vehicle profile, with the rate, lens and range of the camera."""
    name: str | None = None
    """Name of the additional camera to show; None = the main camera."""
    key: bytes | None = None
    """Key that decrypts the images of an address; None = unencrypted."""

    @property
    def own(self) -> Camera:
        """Camera of the profile. Raises FieldError for an unknown name."""
        if self.name is None:
            return self.profile.camera
        if self.name not in self.profile.cameras:
            has = ", ".join(self.profile.cameras) or "left out, as it has its main one alone"
            raise errors.FieldError("camera_name", self.name, f"of vehicle {self.vehicle}: {has}")
        return self.profile.cameras[self.name]

    def open(self, clock: Clock) -> OpenCamera:
        """Open the camera. Raises FieldError like `open_named_camera`."""
        further = {name: Intrinsics.of(each) for name, each in self.profile.cameras.items()}
        wanted, whose = Intrinsics.of(self.profile.camera), f"vehicle {self.vehicle}"
        return open_named_camera(self.camera, clock, wanted, whose, further, self.key)

    def image(self, frame: Frame) -> Frame | FurtherImage:
        """Return the camera's image of a frame. Raises FieldError without such an image."""
        if self.name is None:
            return frame
        if self.name not in frame.further:
            has = ", ".join(frame.further) or "left out, as there are those of the main one alone"
            raise errors.FieldError("camera_name", self.name, f"whose images come: {has}")
        return frame.further[self.name]


def show_video(
    camera: ShownCamera,
    receiver: tuple[str, int],
    network: OnNetwork | None,
    clock: Clock,
    stop: threading.Event,
    say: Callable[[str], None],
) -> int:
    """Send a camera's video to a host and port until `stop`; return the number of images.

    Raises UsageError for an unusable camera.
    """
    own = camera.own
    host, port = receiver
    with closing(camera.open(clock)) as source:
        say(f"waiting for images of {camera.camera}")
        # The first image decides size and kind of the stream.
        first = _next(source, None, stop)
        if first is None:
            return 0
        lens = camera.image(first.frame).intrinsics
        size, rate_hz = picture_size(lens), own.rate_hz
        stream = VideoStream(
            f"{camera.vehicle} {lens.kind}",
            size,
            rate_hz,
            math.degrees(lens.horizontal_fov_rad),
            port,
        )
        say(
            f"{lens.width} x {lens.height} {lens.kind} as {size[0]} x {size[1]} H.264, RTP to UDP"
            f" {host}:{port}"
        )

        def is_wanted() -> bool:
            # The component joins as soon as a vehicle is heard, even during the video.
            if network is None:
                return True
            if network.join(stream):
                say("ground stations are told of the camera")
            return network.running

        with closing(RtpVideo(host, port, size, rate_hz)) as video:

            def show(seen: ReceivedFrame) -> None:
                video.show(picture_of(camera.image(seen.frame), own.range_m), seen.received_us)

            return _send(source, first, show, is_wanted, stop, say)


def _send(
    source: FrameSource,
    first: ReceivedFrame,
    show: Callable[[ReceivedFrame], None],
    wanted: Callable[[], bool],
    stop: threading.Event,
    say: Callable[[str], None],
) -> int:
    """Send enabled frames; return their number. Network errors are reported once and skipped."""
    sent, seen, failing = 0, first, False
    while not stop.is_set():
        if wanted():
            try:
                show(seen)
            # One line per outage, not one per frame.
            except OSError as error:
                if not failing:
                    say(f"the video cannot be sent: {error.strerror}; it goes on when it can")
                failing = True
            else:
                sent, failing = sent + 1, False
        following = _next(source, seen, stop)
        if following is None:
            break
        seen = following
    return sent


def _next(
    source: FrameSource, seen: ReceivedFrame | None, stop: threading.Event
) -> ReceivedFrame | None:
    newer_than = -1 if seen is None else seen.frame.sequence
    while not stop.is_set():
        found = source.wait(newer_than, WAIT_S)
        if found is not None:
            return found
    return None

"""The video of a camera as a program: opens the camera, sends what it sees, tells who asks."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Any, NamedTuple

from mavsdk import ComponentType, Mavsdk

from airl_mav.camera.frame import Frame, FurtherImage
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock
from airl_mav.core.errors import FieldError
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import VehicleProfile
from companion.camera import FrameSource, ReceivedFrame
from companion.camera_component import CameraComponent, Stream
from companion.cameras.by_name import OpenCamera, open_named_camera
from companion.mavsdk_connection import open_connection
from companion.video import RtpVideo, Watcher, picture_of, picture_size

WAIT_S = 0.5
"""Longest single wait for a frame [wall s]: so soon a wish to end is seen."""

DEFAULT_SYSTEM_ID = 1
"""Of vehicles whose MAV_SYS_ID nobody has changed, and of MAVSDK's camera component."""


class OnNetwork:
    """The camera's component on the MAVLink network, once a vehicle is heard there."""

    def __init__(self, url: str, clock: Clock) -> None:
        """Open a MAVSDK connection. Raises UsageError for an address that cannot be used."""
        self._url, self._clock = url, clock
        self._mavsdk = open_connection(url, ComponentType.CAMERA)
        self._component: CameraComponent | None = None

    @property
    def running(self) -> bool:
        """Whether the video is wanted; it is until somebody stops it."""
        return self._component is None or self._component.running

    def join(self, stream: Stream) -> bool:
        """Join the vehicle, if it is heard; return whether that has happened just now."""
        if self._component is not None:
            return False
        system = _vehicle(self._mavsdk)
        if system is None:
            return False
        number = system.get_system_id()
        if number != DEFAULT_SYSTEM_ID:
            # A component says which vehicle it is part of from its first message on.
            self._mavsdk.destroy()
            self._mavsdk = open_connection(self._url, ComponentType.CAMERA, number)
        self._component = CameraComponent(self._mavsdk, stream, self._clock)
        return True

    def close(self) -> None:
        """Leave the network."""
        if self._component is not None:
            self._component.close()
        self._mavsdk.destroy()


def _vehicle(mavsdk: Mavsdk) -> Any:
    """Return the system with an autopilot that is heard; None: none is."""
    return next((system for system in mavsdk.get_systems() if system.has_autopilot()), None)


class ShownCamera(NamedTuple):
    """Whose images are shown."""

    camera: str
    """As `open_named_camera` takes it."""
    vehicle: str
    profile: VehicleProfile
    """Whose camera that is: its rate, its lens and range."""
    name: str | None = None
    """Of the further camera that is shown; None: the main one is."""

    @property
    def own(self) -> Camera:
        """The camera of the profile. Raises FieldError for a name that is none."""
        if self.name is None:
            return self.profile.camera
        if self.name not in self.profile.cameras:
            has = ", ".join(self.profile.cameras) or "left out, as it has its main one alone"
            raise FieldError("camera_name", self.name, f"of vehicle {self.vehicle}: {has}")
        return self.profile.cameras[self.name]

    def open(self, clock: Clock) -> OpenCamera:
        """Open it. Raises FieldError as `open_named_camera`."""
        further = {name: Intrinsics.of(each) for name, each in self.profile.cameras.items()}
        wanted, whose = Intrinsics.of(self.profile.camera), f"vehicle {self.vehicle}"
        return open_named_camera(self.camera, clock, wanted, whose, further)

    def image(self, frame: Frame) -> Frame | FurtherImage:
        """Return its image of a frame. Raises FieldError where there is none."""
        if self.name is None:
            return frame
        if self.name not in frame.further:
            has = ", ".join(frame.further) or "left out, as there are those of the main one alone"
            raise FieldError("camera_name", self.name, f"whose images come: {has}")
        return frame.further[self.name]


def show_video(
    camera: ShownCamera,
    watcher: Watcher,
    network: OnNetwork | None,
    clock: Clock,
    stop: threading.Event,
    say: Callable[[str], None],
) -> int:
    """Send what a camera sees until somebody stops it; return the number of pictures.

    Args:
        camera: Whose images are shown.
        watcher: Who is sent the video.
        network: Where ground stations are told of it; None: nobody is.
        clock: For the stamps.
        stop: Set to end.
        say: Called with lines for the user.

    Raises:
        UsageError: The camera cannot be used, or there is none of that name.
    """
    own = camera.own
    with closing(camera.open(clock)) as source:
        say(f"waiting for images of {camera.camera}")
        first = _next(source, None, stop)
        if first is None:
            return 0
        lens = camera.image(first.frame).intrinsics
        size, rate_hz = picture_size(lens), own.rate_hz
        stream = Stream(
            f"{camera.vehicle} {lens.kind}",
            size,
            rate_hz,
            math.degrees(lens.horizontal_fov_rad),
            watcher.port,
        )
        say(
            f"{lens.width} x {lens.height} {lens.kind} as {size[0]} x {size[1]} H.264, RTP to UDP"
            f" {watcher.host}:{watcher.port}"
        )

        def is_wanted() -> bool:
            if network is None:
                return True
            if network.join(stream):
                say("ground stations are told of the camera")
            return network.running

        with closing(RtpVideo(*watcher, size, rate_hz)) as video:

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
    """Send frame after frame while they are wanted; return their number.

    A radio link comes and goes: what cannot be sent is left out, which is said once.
    """
    sent, seen, failing = 0, first, False
    while not stop.is_set():
        if wanted():
            try:
                show(seen)
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
    """Return the next frame; None: somebody has asked to end."""
    newer_than = -1 if seen is None else seen.frame.sequence
    while not stop.is_set():
        found = source.wait(newer_than, WAIT_S)
        if found is not None:
            return found
    return None

"""The video of a camera as a program: opens the camera, sends what it sees, tells who asks."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Any

from mavsdk import ComponentType, Mavsdk

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock
from airl_mav.profiles.vehicle import VehicleProfile
from companion.camera import FrameSource, ReceivedFrame
from companion.camera_component import CameraComponent, Stream
from companion.cameras.by_name import open_named_camera
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


def show_video(
    camera: str,
    vehicle: str,
    profile: VehicleProfile,
    watcher: Watcher,
    network: OnNetwork | None,
    clock: Clock,
    stop: threading.Event,
    say: Callable[[str], None],
) -> int:
    """Send what a camera sees until somebody stops it; return the number of pictures.

    Args:
        camera: Its name, as `open_named_camera` takes it.
        vehicle: Name of the profile.
        profile: Whose camera that is: its rate, its lens and range.
        watcher: Who is sent the video.
        network: Where ground stations are told of it; None: nobody is.
        clock: For the stamps.
        stop: Set to end.
        say: Called with lines for the user.

    Raises:
        UsageError: The camera cannot be used.
    """
    wanted = Intrinsics.of(profile.camera)
    with closing(open_named_camera(camera, clock, wanted, f"vehicle {vehicle}")) as source:
        say(f"waiting for images of {camera}")
        first = _next(source, None, stop)
        if first is None:
            return 0
        lens = first.frame.intrinsics
        size, rate_hz = picture_size(lens), profile.camera.rate_hz
        stream = Stream(
            f"{vehicle} {lens.kind}",
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
            return _send(source, first, video, profile.camera.range_m, is_wanted, stop, say)


def _send(
    source: FrameSource,
    first: ReceivedFrame,
    video: RtpVideo,
    range_m: float,
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
                video.show(picture_of(seen.frame, range_m), seen.received_us)
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

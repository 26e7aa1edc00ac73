"""`airl video`: camera video for QGroundControl and all RTP players."""

from __future__ import annotations

import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from pathlib import Path

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import run_command
from airl_mav.core import constants, files
from airl_mav.core.child_process import ChildProcess
from airl_mav.core.clock import WallClock
from airl_mav.core.errors import FieldError
from airl_mav.core.progress import new_console
from airl_mav.core.scheduling import give_way
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario import aircraft, model, stand_alone

GIMBAL_PORT = 13_280
"""Port to which PX4 SITL's instance 0 forwards MAVLink for a gimbal (px4-rc.mavlink), like the
built-in flight controller of `airl-firmware`. This link is fast enough and otherwise unused."""


class VideoOptions(stand_alone.NamedCamera):
    """Show a camera's images in QGroundControl, or any player of RTP; Ctrl-C ends it.

    Ground stations discover the camera by MAVLink's camera protocol and need no settings.

    Examples:
        airl video
        airl video --to 192.168.1.5:5600 --connect udpin://0.0.0.0:13280
        airl video --vehicle my-quad.toml --camera realsense
        airl video --vehicle quad-rig --camera-name down
    """

    vehicle: aircraft.VehicleName = aircraft.DEFAULT_VEHICLE
    camera_name: str | None = Field(
        default=None,
        description="additional camera of the vehicle to show; default: the main camera",
    )
    to: str = Field(
        default="127.0.0.1:5600",
        description="HOST:PORT of the receiver: UDP, H.264 in RTP; QGroundControl listens on 5600",
    )
    connect: str | None = Field(
        default=f"udpin://127.0.0.1:{GIMBAL_PORT}",
        description="MAVSDK connection on which the flight controller forwards the camera's"
        " messages; default: PX4 SITL's gimbal link; None: not announced to ground stations",
    )


NICENESS = 10
"""Niceness of the video process: policy and flight controller have priority."""

OPTIONS = VideoOptions
EXTRAS = ("film",)


def run(options: VideoOptions, console: Console | None = None) -> int:
    """Send the video until Ctrl-C; return exit status 0."""
    # Imported here: `--help` does not need MAVSDK.
    from airl_mav.addons.video.stream import OnNetwork, ShownCamera, show_video

    console = console or new_console(soft_wrap=True)
    receiver = receiver_of(options.to)
    profile, clock = load_vehicle(options.vehicle), WallClock()
    with ExitStack() as held:
        network = None
        if options.connect is not None:
            network = held.enter_context(closing(OnNetwork(options.connect, clock)))
        give_way(NICENESS)
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        shown = options.camera, options.vehicle, profile, options.camera_name
        camera = ShownCamera(*shown, options.read_camera_key())
        sent = show_video(
            *(camera, receiver, network, clock, stop),
            lambda text: console.print(text, highlight=False),
        )
    console.print(f"{sent} pictures sent", highlight=False)
    return 0


def receiver_of(address: str, field: str = "to") -> tuple[str, int]:
    """Return the address of HOST:PORT. Raises FieldError, naming the field, if it is invalid."""
    host, _, port = address.rpartition(":")
    # RTCP uses the next port.
    if not host or not port.isdecimal() or not 1 <= int(port) < aircraft.GREATEST_PORT:
        raise FieldError(field, address, f"HOST:PORT, port 1..{aircraft.GREATEST_PORT - 1}")
    try:
        socket.getaddrinfo(host, int(port), type=socket.SOCK_DGRAM)
    except OSError as error:
        raise FieldError(field, address, problem=f"no such host: {error.strerror}") from None
    return host, int(port)


MODULE = "airl_mav.addons.video.command"


def video_words(asked: model.Scenario, to: str) -> list[str]:
    """Return the options of `airl video` for a camera and a viewer; FieldError if unsupported."""
    if asked.level != "sitl":
        raise FieldError(
            "video", to, problem="accepted: with level sitl, whose camera has a socket"
        )
    ports = asked.open_ports
    if ports.camera_port == 0:
        raise FieldError("video", to, problem="accepted: with a camera port of your choice, not 0")
    camera = f"tcp://{constants.LOOPBACK}:{ports.camera_port}"
    words = ["--camera", camera, "--vehicle", asked.vehicle, "--to", to]
    if asked.camera_key is not None:
        words += ["--camera-key", str(asked.camera_key)]
    return [*words, "--connect", _network(asked) or "None"]


def _network(asked: model.Scenario) -> str | None:
    """Return the camera's connection to the vehicle; None for a signed link or other firmware."""
    if asked.firmware == "px4":
        return f"udpin://{constants.LOOPBACK}:{GIMBAL_PORT + asked.real.instance}"
    if asked.firmware == "builtin" and asked.signing_key is None:
        return f"udpout://{constants.LOOPBACK}:{asked.open_ports.gcs_local_port}"
    return None


def shown_beside(
    asked: model.Scenario, to: str, say: Callable[[str], None]
) -> AbstractContextManager[None]:
    """Return a context that shows the flights' camera. Raises FieldError if unsupported."""
    receiver_of(to, "video")
    return _shown(video_words(asked, to), say)


@contextmanager
def _shown(words: list[str], say: Callable[[str], None]) -> Iterator[None]:
    """Show the video within the context; flights continue if the video fails, with a message."""
    with files.scratch_folder("airl-video-") as folder:
        # The guard ends the video with its parent.
        command = [sys.executable, "-m", MODULE, *words]
        child = ChildProcess(command, Path(folder) / "video.log", guarded=True)
        try:
            yield
        finally:
            if child.poll() is not None:
                say(f"the video ended early\n{child.log_tail()}")
            child.stop()


if __name__ == "__main__":
    run_command("airl video", "airl_mav.addons.video.command")

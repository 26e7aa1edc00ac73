"""The video of a rehearsal's camera: `airl video` as a process beside the flights."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from airl_mav.core.child_process import ChildProcess
from airl_mav.core.errors import FieldError
from airl_mav.core.ports import LOOPBACK
from airl_mav.scenario.model import Scenario
from companion.video import GIMBAL_PORT

MODULE = "airl_mav.cli.video"


def video_words(asked: Scenario, to: str) -> list[str]:
    """Return the options of `airl video` for a camera and a watcher; FieldError: no address."""
    if asked.level != "sitl":
        raise FieldError(
            "video", to, problem="accepted: with level sitl, whose camera has a socket"
        )
    ports = asked.open_ports
    if ports.camera_port == 0:
        raise FieldError("video", to, problem="accepted: with a camera port of your choice, not 0")
    camera = f"tcp://{LOOPBACK}:{ports.camera_port}"
    words = ["--camera", camera, "--vehicle", asked.vehicle, "--to", to]
    return [*words, "--connect", _network(asked) or "None"]


def _network(asked: Scenario) -> str | None:
    """Return where the camera joins the vehicle's network; None: unsigned, or other firmware."""
    if asked.firmware == "px4":
        return f"udpin://{LOOPBACK}:{GIMBAL_PORT + asked.real.instance}"
    if asked.firmware == "builtin" and asked.signing_key is None:
        return f"udpout://{LOOPBACK}:{asked.open_ports.gcs_local_port}"
    return None


@contextmanager
def video_shown(words: list[str], say: Callable[[str], None]) -> Iterator[None]:
    """Show the video while the context lasts; the flights go on if it fails, which is said then."""
    with tempfile.TemporaryDirectory(prefix="airl-video-") as folder:
        # Behind a guard: it must not outlive whoever started it.
        command = [sys.executable, "-m", MODULE, *words]
        child = ChildProcess(command, Path(folder) / "video.log", guarded=True)
        try:
            yield
        finally:
            if child.poll() is not None:
                say(f"the video ended early\n{child.log_tail()}")
            child.stop()

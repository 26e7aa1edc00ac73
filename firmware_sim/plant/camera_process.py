"""A camera whose images take longer than a tick: a process of its own takes them.

The vehicle flies on in real time while an image is drawn. A frame is published when it is done,
with the time at which it was exposed, as a slow camera's is; exposures that are due meanwhile are
left out. Only where time is that of the wall clock: elsewhere it waits for an image.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Thread

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.camera.render import Motion
from airl_mav.core.scheduling import give_way
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.camera_kind import Renderer
from airl_mav.profiles.conditions import SensorNoise
from firmware_sim.flight_controller import FirmwareLostError
from firmware_sim.plant.camera_server import SimulatedCamera

NICENESS = 10
"""Images are late in any case; ticks must not be."""


@dataclass(frozen=True)
class _Restart:
    """An episode begins."""

    time_us: int


@dataclass(frozen=True)
class _Take:
    """A frame is due."""

    time_us: int
    motion: Motion


@dataclass(frozen=True)
class _Taken:
    """A frame is done, and when the next one is due [µs]."""

    frame: Frame
    next_us: int


class CameraProcess:
    """A process that takes the frames of one episode's camera after the other's.

    It is started for the first of them, and ends with this process, however that ends.
    """

    def __init__(self) -> None:
        """Start nothing yet."""
        self._line: Connection | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: SimpleQueue[_Taken | EOFError | None] = SimpleQueue()
        self._reading: Thread | None = None

    def camera(
        self,
        camera: Camera,
        arena: Arena,
        start_us: int,
        noise: SensorNoise | None,
        seed: int,
        renderer: Renderer,
        further: Mapping[str, Camera] | None = None,
    ) -> SlowCamera:
        """Return an episode's camera when it has taken a first picture; see `SimulatedCamera`.

        The camera of the episode before takes no more frames.

        Raises:
            FirmwareLostError: It could not.
        """
        if self._process is None:
            self._start()
        self.send((camera, arena, start_us, noise, seed, renderer, further))
        while self.receive() is not None:
            pass  # A frame of the episode before was still being taken.
        return SlowCamera(self, start_us)

    def _start(self) -> None:
        self._line, theirs = Pipe()
        with theirs:
            # Not by -m: what is sent would then be of other classes, those of __main__.
            called = f"from {__name__} import main; main({theirs.fileno()})"
            self._process = subprocess.Popen(  # noqa: S603 (this package)
                [sys.executable, "-c", called],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # That of the firmware may be a channel.
                pass_fds=[theirs.fileno()],
            )
        self._reading = Thread(target=self._read, args=(self._line,), name="images", daemon=True)
        self._reading.start()

    def _read(self, line: Connection) -> None:
        """Take in what arrives until the process has ended.

        An image exceeds the pipe's buffer. Its reader waits for the writer.
        """
        with suppress(EOFError, OSError):
            while True:
                self._answers.put(line.recv())
        self._answers.put(EOFError())

    @property
    def answers(self) -> bool:
        """Whether something has arrived, or the process has ended."""
        return not self._answers.empty()

    def send(self, what: object) -> None:
        """Ask for something. Raises FirmwareLostError."""
        if self._line is None:
            raise self._lost()
        try:
            self._line.send(what)
        except OSError:
            raise self._lost() from None

    def receive(self) -> _Taken | None:
        """Wait for the next answer; None: a camera is ready. Raises FirmwareLostError."""
        if self._line is None:
            raise self._lost()
        answer = self._answers.get()
        if isinstance(answer, EOFError):
            self._answers.put(answer)
            raise self._lost()
        return answer

    def _lost(self) -> FirmwareLostError:
        what = "the process that draws the camera's images "
        if self._process is None:
            return FirmwareLostError(what + "was ended")
        code = self._process.wait()
        how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        return FirmwareLostError(f"{what}has ended {how}")

    def close(self) -> None:
        """End the process. Harmless when called again."""
        if self._line is not None and self._process is not None and self._reading is not None:
            self._process.kill()
            self._process.wait()
            self._reading.join()
            self._line.close()
        self._line = self._process = self._reading = None


class SlowCamera:
    """Takes frames in another process, one at a time; an `OnboardCamera`."""

    def __init__(self, process: CameraProcess, start_us: int) -> None:
        """Take the process, which has made the camera, and when a frame is due [µs]."""
        self._process = process
        self._busy = False
        """Whether a frame is being taken."""
        self._taken_us: int | None = None
        """When that was exposed [µs]; None: there is none, or its episode is over."""
        self._next_us = start_us

    @property
    def next_us(self) -> int:
        """Simulated time from which on there is something to do [µs]."""
        return self._next_us if self._taken_us is None else self._taken_us

    def restart(self, time_us: int) -> None:
        """Begin an episode at `time_us` [µs]. A frame that is being taken is dropped."""
        self._taken_us, self._next_us = None, time_us
        self._process.send(_Restart(time_us))

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Publish the frame that is done, if one is, and have one taken, if it is due.

        Raises:
            FirmwareLostError: The process has ended.
        """
        if self._busy and self._process.answers:
            taken, self._busy = self._process.receive(), False
            if taken is not None and taken.frame.capture_time_us == self._taken_us:
                self._taken_us, self._next_us = None, taken.next_us
                publish(taken.frame)
        if not self._busy and time_us >= self._next_us:
            self._process.send(_Take(time_us, motion))
            self._busy, self._taken_us = True, time_us


def main(number: int) -> None:
    """Take what is asked for until the line ends.

    Args:
        number: File descriptor of the line.
    """
    give_way(NICENESS)
    line = Connection(number)
    with suppress(EOFError, OSError):
        while True:
            match line.recv():
                case tuple(episode):
                    taking = SimulatedCamera(*episode)
                    line.send(None)
                case _Restart(time_us):
                    taking.restart(time_us)
                case _Take(time_us, motion):
                    frame = taking.take(time_us, motion)
                    line.send(_Taken(frame, taking.next_us))
    # Nothing is left to be done: taking a renderer's threads down would only take time.
    os._exit(0)

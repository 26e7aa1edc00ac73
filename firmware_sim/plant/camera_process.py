"""Camera with images that take longer than a tick, rendered in a separate process.

The vehicle keeps flying in real time while an image is rendered. A frame is published when it is
complete, with its exposure time, as with a slow camera; exposures due during rendering are skipped.
Used only in real time; otherwise the simulation waits for each image.
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
from airl_mav.profiles.conditions import SensorNoise
from airl_mav.profiles.projections import Renderer
from firmware_sim.interfaces import FirmwareLostError
from firmware_sim.plant.camera_server import SimulatedCamera

NICENESS = 10
"""Niceness of the process: images may be late, but ticks must not be."""


@dataclass(frozen=True)
class _Restart:
    """Request to start an episode."""

    time_us: int


@dataclass(frozen=True)
class _Take:
    """Request to take a frame."""

    time_us: int
    motion: Motion


@dataclass(frozen=True)
class _Taken:
    """Completed frame, and the time of the next one [µs]."""

    frame: Frame
    next_us: int


class CameraProcess:
    """Process that takes the frames of the cameras of successive episodes.

    Starts with the first camera, and ends with the parent process in all cases.
    """

    def __init__(self) -> None:
        """Create the object without a process."""
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
        """Return an episode's camera after a first image; see `SimulatedCamera`.

        The camera of the previous episode takes no further frames.

        Raises:
            FirmwareLostError: The process has ended.
        """
        if self._process is None:
            self._start()
        self.send((camera, arena, start_us, noise, seed, renderer, further))
        while self.receive() is not None:
            pass  # Frame of the previous episode, still in progress.
        return SlowCamera(self, start_us)

    def _start(self) -> None:
        self._line, theirs = Pipe()
        with theirs:
            # Not -m: sent objects would then have the classes of __main__.
            called = f"from {__name__} import main; main({theirs.fileno()})"
            self._process = subprocess.Popen(  # noqa: S603 (this package)
                [sys.executable, "-c", called],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # The firmware's stdout may be a channel.
                pass_fds=[theirs.fileno()],
            )
        self._reading = Thread(target=self._read, args=(self._line,), name="images", daemon=True)
        self._reading.start()

    def _read(self, line: Connection) -> None:
        """Read answers until the process has ended.

        An image exceeds the pipe's buffer, so a read blocks until the writer has finished.
        """
        with suppress(EOFError, OSError):
            while True:
                self._answers.put(line.recv())
        self._answers.put(EOFError())

    @property
    def answers(self) -> bool:
        """True if an answer has arrived, or the process has ended."""
        return not self._answers.empty()

    def send(self, what: object) -> None:
        """Send a request. Raises FirmwareLostError."""
        if self._line is None:
            raise self._lost()
        try:
            self._line.send(what)
        except OSError:
            raise self._lost() from None

    def receive(self) -> _Taken | None:
        """Wait for the next answer; None = a camera is ready. Raises FirmwareLostError."""
        if self._line is None:
            raise self._lost()
        answer = self._answers.get()
        if isinstance(answer, EOFError):
            # Keep the end in the queue: every later call must raise as well.
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
        """End the process. Repeated calls have no effect."""
        if self._line is not None and self._process is not None and self._reading is not None:
            self._process.kill()
            self._process.wait()
            # The reader ends with the process's end of the pipe.
            self._reading.join()
            self._line.close()
        self._line = self._process = self._reading = None


class SlowCamera:
    """Camera in another process, one frame at a time; an `OnboardCamera`."""

    def __init__(self, process: CameraProcess, start_us: int) -> None:
        """Store the process, which has created the camera, and the time of the first frame [µs]."""
        self._process = process
        self._busy = False
        """True while a frame is in progress."""
        self._taken_us: int | None = None
        """Exposure time of the frame in progress [µs]; None = no frame, or its episode is over."""
        self._next_us = start_us

    @property
    def next_us(self) -> int:
        """Earliest simulated time of the next required call [µs]."""
        return self._next_us if self._taken_us is None else self._taken_us

    def restart(self, time_us: int) -> None:
        """Start an episode at `time_us` [µs]. A frame in progress is dropped."""
        self._taken_us, self._next_us = None, time_us
        self._process.send(_Restart(time_us))

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Publish a completed frame, and request the next frame if due.

        Raises:
            FirmwareLostError: The process has ended.
        """
        if self._busy and self._process.answers:
            taken, self._busy = self._process.receive(), False
            # A frame of an earlier episode has another time and is dropped.
            if taken is not None and taken.frame.capture_time_us == self._taken_us:
                self._taken_us, self._next_us = None, taken.next_us
                publish(taken.frame)
        # At most one frame is in progress, so a slow renderer cannot build up a queue.
        if not self._busy and time_us >= self._next_us:
            self._process.send(_Take(time_us, motion))
            self._busy, self._taken_us = True, time_us

    def skip_unread(self, read_us: int) -> None:
        """Skip nothing: the time to render decides which frames exist."""


def main(number: int) -> None:
    """Process requests until the connection closes.

    Args:
        number: File descriptor of the connection.
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
    # Immediate exit: shutting down a renderer's threads would only take time.
    os._exit(0)

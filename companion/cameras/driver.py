"""Interface of camera drivers, and the thread that keeps their newest image as a frame.

A driver is a class made without arguments, with a `lens` and `read`; time stamps, size and threads
are handled here.
"""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame, FurtherImage
from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from companion.camera import ReceivedFrame
from companion.cameras.fitting import Fitting, Lens

READ_S = 0.1
"""A driver is asked for its next image for this long at a time [s], so that it can be closed."""

FAILED_S = 5.0
"""A camera that delivers nothing for so long has failed [s of waiting]."""


OLDEST_US = US_PER_S
"""An image that seems to be older is stamped by another clock [µs]."""


def plausible_age_us(age_us: int) -> int:
    """Return an image's age by its stamp [µs]; 0 for a stamp of another clock."""
    return age_us if 0 <= age_us <= OLDEST_US else 0


class Silence:
    """How long a driver has waited for its next image."""

    def __init__(self) -> None:
        """Begin with none."""
        self._waited_s = 0.0

    def broken(self) -> None:
        """An image has come."""
        self._waited_s = 0.0

    def lasted(self, waited_s: float) -> None:
        """None came in this time [s]. Raises RuntimeError when that makes 5 s."""
        self._waited_s += waited_s
        if self._waited_s >= FAILED_S:
            raise RuntimeError(f"no image for {FAILED_S:g} s")


class DepthImage(NamedTuple):
    """One image of a camera, as its driver returns it."""

    depth_mm: NDArray[np.uint16]  # (height, width) along the optical axis [mm]; 0 = no return
    age_us: int
    """Time since the exposure, by the driver's stamps [µs]; 0 where it has none."""
    number: int | None = None
    """Counts up by one per image that the camera takes; None where the camera does not count."""
    further: Mapping[str, NDArray[np.uint16]] = {}
    """Images that further cameras took at the same moment, by name; see `lenses`."""


class DepthCamera(Protocol):
    """A camera of the companion computer; `lenses` names the lenses of additional images."""

    @property
    def lens(self) -> Lens:
        """Return the lens; it stays the same."""

    def read(self, timeout_s: float) -> DepthImage | None:
        """Wait for the next image; None after a timeout [s]. Exceptions are camera failures."""

    def close(self) -> None:
        """Let go of the camera."""


def missing_between(last: int | None, number: int | None) -> int:
    """Return the number of images missing between two; None without numbers or after a restart."""
    if last is None or number is None:
        return 0
    return max(0, number - last - 1)


class CameraThread:
    """The newest image of a driver, as a frame of the wanted size. Implements `FrameSource`."""

    def __init__(
        self,
        name: str,
        camera: DepthCamera,
        clock: Clock,
        fitting: Fitting,
        further: Mapping[str, Fitting] | None = None,
    ) -> None:
        """Start to read a driver, which `close` closes; images without a fitting are left out."""
        self.failure: str | None = None
        """Why no more images come, once the driver has raised."""
        self.dropped = 0
        """Images that the camera took and the driver never returned, by their numbers."""
        self._name, self._camera, self._clock, self._fitting = name, camera, clock, fitting
        self._further = further or {}
        self._newest: ReceivedFrame | None = None
        self._changed = threading.Condition()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read_on, name="camera", daemon=True)
        self._thread.start()

    def latest(self) -> ReceivedFrame | None:
        """Return the newest frame so far, without waiting; None before the first."""
        return self._newest

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame that is not the one already seen; see `FrameSource`."""
        with self._changed:
            arrived = self._changed.wait_for(
                lambda: (
                    self._newest is not None and self._newest.frame.sequence != newer_than_sequence
                ),
                timeout_s,
            )
            return self._newest if arrived else None

    def close(self) -> None:
        """End the thread and let go of the camera."""
        self._ended.set()
        self._thread.join(10.0 * READ_S)
        self._camera.close()

    def _read_on(self) -> None:
        sequence, last_number = 0, None
        try:
            while not self._ended.is_set():
                image = self._camera.read(READ_S)
                if image is None:
                    continue
                taken_us = self._clock.time_us() - image.age_us
                self.dropped += missing_between(last_number, image.number)
                last_number = image.number
                # Fitted before the stamp of arrival: it is part of how long a frame takes.
                depth_mm = self._fitting.fit(image.depth_mm)
                if missing := self._further.keys() - image.further.keys():
                    raise ValueError(f"an image without those of {', '.join(sorted(missing))}")
                further = {
                    called: FurtherImage(fitting.fit(image.further[called]), fitting.wanted)
                    for called, fitting in self._further.items()
                }
                frame = Frame(sequence, taken_us, depth_mm, self._fitting.wanted, further=further)
                received = ReceivedFrame(frame, self._clock.time_us())
                with self._changed:
                    self._newest = received
                    self._changed.notify_all()
                sequence += 1
        except Exception as error:
            # A driver may raise anything. The watchdog stops the vehicle: no frame comes.
            told = " ".join(f"{type(error).__name__}: {error}".split())
            self.failure = f"camera {self._name} failed: {told}"
            traceback.print_exc(file=sys.stderr)

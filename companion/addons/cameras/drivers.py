"""Camera drivers by name, built-in or custom, and the thread that keeps their newest image.

A driver is a class constructed without arguments, with a `lens` and `read`; time stamps, size and
threads are handled here.
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
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.plugins import CAMERAS, load_part, reference
from companion.addons.cameras.fitting import Fitting, Lens, check_coverage
from companion.frame_source import OpenCamera, ReceivedFrame

REALSENSE, OAK_D, ROS2, ROSBAG = "realsense", "oak-d", "ros2", "rosbag"
"""Names of built-in drivers, before a colon."""

EXTRAS = {
    REALSENSE: "librealsense (pip install pyrealsense2)",
    OAK_D: "depthai (pip install 'airl-mav[oak]')",
    ROS2: "Cyclone DDS and rosbags (pip install 'airl-mav[ros2]')",
    ROSBAG: "rosbags (pip install 'airl-mav[ros2]')",
}


def open_driver(
    name: str,
    clock: Clock,
    wanted: Intrinsics,
    whose: str,
    further: Mapping[str, Intrinsics] | None = None,
) -> OpenCamera:
    """Open a camera by the name of its driver; see `frame_source.open_named_camera`.

    Names are "realsense", "realsense:SERIAL" or "realsense:FILE.bag"; "oak-d" or "oak-d:DEVICE";
    "ros2:/TOPIC"; "rosbag:PATH" or "rosbag:PATH:/TOPIC"; FILE.py:NAME, MODULE:NAME or the entry
    point of a driver. A driver's additional images are converted to the cameras in `further`.
    """
    _check_fits(name, wanted, whose)
    camera = _driver(name, clock)
    lenses: Mapping[str, Lens] = getattr(camera, "lenses", {})
    # Only images that both policy and driver have are converted.
    given = {each: lens for each, lens in (further or {}).items() if each in lenses}
    fitting = Fitting(camera.lens, wanted)
    # A check that fails must release the camera.
    try:
        check_coverage(name, camera.lens, fitting, whose)
        others = {}
        for each, lens in given.items():
            _check_fits(name, lens, f"{whose} ({each})")
            others[each] = Fitting(lenses[each], lens)
            check_coverage(name, lenses[each], others[each], f"{whose} ({each})")
    except FieldError:
        camera.close()
        raise
    return CameraThread(name, camera, clock, fitting, others)


def _check_fits(name: str, wanted: Intrinsics, whose: str) -> None:
    """Raise FieldError for a camera kind unsupported by drivers."""
    if wanted.kind != "depth":
        raise FieldError(
            "camera",
            name,
            problem=f"drivers give depth images, the camera of {whose} is of kind {wanted.kind!r};"
            " accepted: tcp://HOST:PORT or ipc://PATH of a publisher of such images",
        )


def _driver(name: str, clock: Clock) -> DepthCamera:
    brand, _, which = name.partition(":")
    # Missing optional packages become one line that names the extra to install.
    if brand in EXTRAS:
        try:
            return _shipped(brand, which, clock)
        except ImportError as error:
            raise FieldError("camera", name, problem=f"needs {EXTRAS[brand]}: {error}") from None
    # Custom drivers resolve last: they cannot replace the built-in names.
    if reference(CAMERAS, name) is None:
        accepted = (
            "tcp://HOST:PORT, ipc://PATH, realsense, oak-d, ros2:/TOPIC, rosbag:PATH,"
            " FILE.py:NAME or MODULE:NAME"
        )
        raise FieldError("camera", name, accepted)
    made = load_part(CAMERAS, name, lambda part: callable(getattr(part, "read", None)))
    try:
        camera: DepthCamera = made()
    except Exception as error:
        # A driver may raise any exception if its camera is missing.
        told = " ".join(f"{type(error).__name__}: {error}".split())
        raise FieldError("camera", name, problem=told) from error
    return camera


def _shipped(brand: str, which: str, clock: Clock) -> DepthCamera:
    """Open a camera of a built-in driver, imported on demand, as its packages are optional."""
    if brand == REALSENSE:
        from companion.addons.cameras.realsense import open_realsense

        return open_realsense(which)
    if brand == OAK_D:
        from companion.addons.cameras.oak_d import open_oak_d

        return open_oak_d(which)
    # A ROS 2 topic is absolute; a recording needs a path.
    if not which.startswith("/") if brand == ROS2 else not which:
        raise FieldError("camera", f"{brand}:{which}", "ros2:/TOPIC or rosbag:PATH")
    if brand == ROS2:
        from companion.addons.cameras.ros2 import Ros2Camera

        return Ros2Camera(which)
    from companion.addons.cameras.rosbag import RosBag

    return RosBag(which, clock)


READ_S = 0.1
"""Timeout of one `read` of a driver [s]; between reads the thread can end."""

FAILED_S = 5.0
"""Time without an image after which a camera has failed [s of waiting]."""


OLDEST_US = US_PER_S
"""Maximum age of an image [µs]; older stamps are from another clock."""


def plausible_age_us(age_us: int) -> int:
    """Return an image's age by its stamp [µs]; 0 for a stamp of another clock."""
    return age_us if 0 <= age_us <= OLDEST_US else 0


class Silence:
    """Timer of a driver's wait for its next image."""

    def __init__(self) -> None:
        """Create the timer at 0 s."""
        self._waited_s = 0.0

    def broken(self) -> None:
        """Reset the timer after an image."""
        self._waited_s = 0.0

    def lasted(self, waited_s: float) -> None:
        """Add a wait without an image [s]. Raises RuntimeError after 5 s in total."""
        self._waited_s += waited_s
        if self._waited_s >= FAILED_S:
            raise RuntimeError(f"no image for {FAILED_S:g} s")


class DepthImage(NamedTuple):
    """Image returned by a camera driver."""

    depth_mm: NDArray[np.uint16]  # (height, width) along the optical axis [mm]; 0 = no return
    age_us: int
    """Time since the exposure, by the driver's stamps [µs]; 0 without stamps."""
    number: int | None = None
    """Image counter, increases by one per captured image; None = not supported."""
    further: Mapping[str, NDArray[np.uint16]] = {}
    """Simultaneous images of additional cameras, by name; see `lenses`."""


class DepthCamera(Protocol):
    """Camera of the companion computer; `lenses` has the lenses of additional images by name."""

    @property
    def lens(self) -> Lens:
        """Return the constant lens."""

    def read(self, timeout_s: float) -> DepthImage | None:
        """Wait for the next image; None after a timeout [s]. Exceptions are camera failures."""

    def close(self) -> None:
        """Release the camera."""


def missing_between(last: int | None, number: int | None) -> int:
    """Return the number of images missing between two; 0 without numbers or after a restart."""
    if last is None or number is None:
        return 0
    return max(0, number - last - 1)


class CameraThread:
    """Newest image of a driver, as a frame of the target size. Implements `FrameSource`."""

    def __init__(
        self,
        name: str,
        camera: DepthCamera,
        clock: Clock,
        fitting: Fitting,
        further: Mapping[str, Fitting] | None = None,
    ) -> None:
        """Start to read a driver, which `close` closes; images without a fitting are omitted."""
        self.failure: str | None = None
        """Error of the driver, after which images end; None = no error."""
        self.dropped = 0
        """Number of captured images that the driver never returned, by the image counters."""
        self._name, self._camera, self._clock, self._fitting = name, camera, clock, fitting
        self._further = further or {}
        self._newest: ReceivedFrame | None = None
        self._changed = threading.Condition()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read_on, name="camera", daemon=True)
        # The thread starts last: it uses all attributes above.
        self._thread.start()

    def latest(self) -> ReceivedFrame | None:
        """Return the newest frame without waiting; None before the first frame."""
        return self._newest

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a frame with another sequence; see `FrameSource`."""
        with self._changed:
            arrived = self._changed.wait_for(
                # Inequality, not order: the sequence restarts with the driver.
                lambda: (
                    self._newest is not None and self._newest.frame.sequence != newer_than_sequence
                ),
                timeout_s,
            )
            return self._newest if arrived else None

    def close(self) -> None:
        """End the thread and release the camera."""
        self._ended.set()
        self._thread.join(10.0 * READ_S)
        self._camera.close()

    def _read_on(self) -> None:
        sequence, last_number = 0, None
        try:
            while not self._ended.is_set():
                image = self._camera.read(READ_S)
                # A timeout of `read` gives the loop a chance to end.
                if image is None:
                    continue
                # The capture time is on the companion's clock, for every clock that a driver uses.
                taken_us = self._clock.time_us() - image.age_us
                self.dropped += missing_between(last_number, image.number)
                last_number = image.number
                # Fitted before the arrival stamp, as fitting is part of a frame's latency.
                depth_mm = self._fitting.fit(image.depth_mm)
                if missing := self._further.keys() - image.further.keys():
                    raise ValueError(f"an image without those of {', '.join(sorted(missing))}")
                further = {
                    called: FurtherImage(fitting.fit(image.further[called]), fitting.wanted)
                    for called, fitting in self._further.items()
                }
                frame = Frame(sequence, taken_us, depth_mm, self._fitting.wanted, further=further)
                received = ReceivedFrame(frame, self._clock.time_us())
                # Only the newest frame is kept; waiting threads wake together.
                with self._changed:
                    self._newest = received
                    self._changed.notify_all()
                sequence += 1
        except Exception as error:
            # A driver may raise any exception. Without frames, the watchdog stops the vehicle.
            told = " ".join(f"{type(error).__name__}: {error}".split())
            self.failure = f"camera {self._name} failed: {told}"
            traceback.print_exc(file=sys.stderr)

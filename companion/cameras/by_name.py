"""Lookup of the camera in `--camera`: an address, a built-in driver or a custom driver."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock
from airl_mav.core.errors import FieldError
from airl_mav.core.plugins import CAMERAS, load_part, reference
from companion.cameras.driver import CameraThread, DepthCamera
from companion.cameras.fitting import Fitting, Lens, check_coverage
from companion.frame_source import FrameSource, open_camera

REALSENSE, OAK_D, ROS2, ROSBAG = "realsense", "oak-d", "ros2", "rosbag"
"""Names of built-in drivers, before a colon."""

EXTRAS = {
    REALSENSE: "librealsense (pip install pyrealsense2)",
    OAK_D: "depthai (pip install 'airl-mav[oak]')",
    ROS2: "Cyclone DDS and rosbags (pip install 'airl-mav[ros2]')",
    ROSBAG: "rosbags (pip install 'airl-mav[ros2]')",
}


class OpenCamera(FrameSource, Protocol):
    """Frame source that can be closed and reports failures."""

    @property
    def failure(self) -> str | None:
        """Return the reason for missing frames; None = no failure, or unknown."""

    @property
    def dropped(self) -> int:
        """Return the number of lost camera images; 0 if unknown."""

    def close(self) -> None:
        """Release the camera."""


def open_named_camera(
    name: str,
    clock: Clock,
    wanted: Intrinsics,
    whose: str,
    further: Mapping[str, Intrinsics] | None = None,
) -> OpenCamera:
    """Open a camera by name; FieldError if it is missing, sees too little or has no depth.

    Names are tcp://HOST:PORT or ipc://PATH, used unchanged; "realsense", "realsense:SERIAL" or
    "realsense:FILE.bag"; "oak-d" or "oak-d:DEVICE"; "ros2:/TOPIC"; "rosbag:PATH" or
    "rosbag:PATH:/TOPIC"; FILE.py:NAME, MODULE:NAME or the entry point of a driver. Images are
    converted to the `wanted` camera of `whose`, such as "vehicle quad"; a driver's additional
    images to the cameras in `further`, by name.
    """
    # An address has a scheme; the publisher defines its own camera, so nothing is converted.
    if "://" in name:
        return open_camera(name, clock)
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
        from companion.cameras.realsense import open_realsense

        return open_realsense(which)
    if brand == OAK_D:
        from companion.cameras.oak_d import open_oak_d

        return open_oak_d(which)
    # A ROS 2 topic is absolute; a recording needs a path.
    if not which.startswith("/") if brand == ROS2 else not which:
        raise FieldError("camera", f"{brand}:{which}", "ros2:/TOPIC or rosbag:PATH")
    if brand == ROS2:
        from companion.cameras.ros2 import Ros2Camera

        return Ros2Camera(which)
    from companion.cameras.rosbag import RosBag

    return RosBag(which, clock)

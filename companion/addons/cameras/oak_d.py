"""Luxonis OAK-D stereo cameras, through depthai (the extra `oak`).

The camera performs the stereo matching, as in the profile `quad-oak-d`. Images have 640 x 400
pixels, disparities up to 95 px in steps of an eighth.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from typing import Any

import numpy as np

from airl_mav.core import clock, errors
from companion.addons.cameras import drivers, fitting

# On import, depthai's crash reporter handles signals, including SIGXFSZ: at a file size limit of a
# log, the companion would end in flight instead of continuing without the log.
os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
import depthai as dai

RATE_HZ = 30.0
SIZE_PX = 640, 400
"""Width and height of the matched images (400P): half the sensors' resolution, at which the
camera's matcher keeps up with 30 images/s in subpixel mode."""

SUBPIXEL_BITS = 3
"""Fractional bits of disparity: steps of 2^-3 px."""

_US = timedelta(microseconds=1)


class OakD:
    """Depth images of a running pipeline. Implements `driver.DepthCamera`."""

    def __init__(
        self,
        name: str,
        pipeline: Any,
        depth: Any,
        now: Callable[[], timedelta] | None = None,
    ) -> None:
        """Start a `depthai.Pipeline`, and wait for its first image, which describes the lens.

        `close` stops the pipeline. `depth` is the rectified output: RAW16 [mm], 0 = no return;
        `now` is the monotonic host time of depthai's stamps. Raises FieldError without an image, or
        if the first image lacks intrinsics or is not a depth image.
        """
        self._pipeline, self._silence = pipeline, drivers.Silence()
        self._now: Callable[..., timedelta] = dai.Clock.now if now is None else now
        # A queue of one frame without blocking: only the newest image counts.
        self._queue = depth.createOutputQueue(maxSize=1, blocking=False)
        self._pipeline.start()
        # The first image reports the rectified lens; it is also the first result of `read`.
        try:
            first = self._taken(drivers.FAILED_S)
            if first is None:
                raise ValueError(f"no image for {drivers.FAILED_S:g} s")
            self.lens = _lens_of(first)
            """Lens of the rectified images, from the calibration stored on the device."""
            _checked(first)
        except (RuntimeError, ValueError) as error:
            self.close()
            raise errors.FieldError("camera", name, problem=" ".join(str(error).split())) from None
        self._first: Any | None = first

    def read(self, timeout_s: float) -> drivers.DepthImage | None:
        """Wait for the next image; RuntimeError after 5 s or disconnection, else ValueError."""
        frame, self._first = self._first, None
        if frame is None:
            frame = self._taken(timeout_s)
        if frame is None:
            self._silence.lasted(timeout_s)
            return None
        self._silence.broken()
        # Middle of the exposure, computed by depthai from the readout stamp.
        taken = frame.getTimestamp(dai.CameraExposureOffset.MIDDLE)
        return drivers.DepthImage(
            _checked(frame),
            drivers.plausible_age_us((self._now() - taken) // _US),
            # Sequence numbers count captured images, so gaps show drops.
            frame.getSequenceNum(),
        )

    def close(self) -> None:
        """Stop the camera and disconnect."""
        with suppress(RuntimeError):  # unplugged: nothing to stop
            self._pipeline.stop()
            # Wait for the threads: depthai crashes if they outlive the pipeline.
            self._pipeline.wait()

    def _taken(self, timeout_s: float) -> Any | None:
        try:
            return self._queue.get(timedelta(seconds=timeout_s))
        except dai.MessageQueue.QueueException:
            raise RuntimeError("the connection is closed") from None


def _lens_of(frame: Any) -> fitting.Lens:
    """Return the lens of an image, as used by depthai's point-cloud nodes, or raise ValueError."""
    about = frame.getTransformation()
    # Without a factory calibration the intrinsics are invalid, and so are distances.
    if not about.isValid():
        raise ValueError("its images come without intrinsics: the device is not calibrated")
    (fx, _, cx), (_, fy, cy), _ = about.getIntrinsicMatrix()
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0.0):
        raise ValueError(f"focal lengths {fx:g} and {fy:g} px, which is no pinhole")
    width, height = about.getSize()
    return fitting.Lens(width, height, fx, fy, cx, cy)


def _checked(frame: Any) -> Any:
    """Return the depth (height, width) of an image [mm]. Raises ValueError for another kind."""
    if frame.getType() != dai.ImgFrame.Type.RAW16:
        raise ValueError(f"an image of type {frame.getType().name}; accepted: RAW16")
    # Copied, as depthai may return its internal memory.
    return np.array(frame.getFrame(), np.uint16)


def open_oak_d(which: str, _clock: clock.Clock) -> OakD:
    """Open a camera and start the stereo matching, or raise FieldError.

    `which` is "" for the first camera, a device id listed by `depthai`, or a network address (PoE),
    which need not be listed.
    """
    name = f"oak-d:{which}" if which else "oak-d"
    found = [each.getDeviceId() for each in dai.Device.getAllAvailableDevices()]
    # A network camera (PoE) need not answer the discovery.
    if not _is_address(which):
        if not found:
            raise errors.FieldError("camera", name, problem="depthai finds no camera")
        if which and which not in found:
            raise errors.FieldError("camera", name, f"oak-d:{' or oak-d:'.join(found)}")
    try:
        device = dai.Device(dai.DeviceInfo(which)) if which else dai.Device()
        pipeline = dai.Pipeline(device)
        depth = _matching(pipeline)
    except RuntimeError as error:
        raise errors.FieldError("camera", name, problem=" ".join(str(error).split())) from None
    return OakD(name, pipeline, depth)


def _is_address(which: str) -> bool:
    try:
        ipaddress.ip_address(which)
    except ValueError:
        return False
    return True


def _matching(pipeline: Any) -> Any:
    """Configure stereo matching as in the profile; return the output of depth images."""
    stereo = pipeline.create(dai.node.StereoDepth).build(
        autoCreateCameras=True, size=SIZE_PX, fps=RATE_HZ
    )
    stereo.setRectification(True)
    # Reject disparities not confirmed by the other image, which are wrong at edges.
    stereo.setLeftRightCheck(True)
    stereo.setExtendedDisparity(False)
    stereo.setSubpixel(True)
    stereo.setSubpixelFractionalBits(SUBPIXEL_BITS)
    stereo.initialConfig.setDepthUnit(dai.LengthUnit.MILLIMETER)
    return stereo.depth

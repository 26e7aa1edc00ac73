"""A camera driver of one's own: a lens, and a method that waits for the next image.

    airl-firmware --arena static-obstacles &
    airl-companion --camera examples/own_camera.py:SimulatorCamera --goal 20 5

This one takes the simulator's images as a camera's, so that it runs without any hardware. Thread,
time stamps and the image size of the policy are the companion's business.
"""

import os

import zmq

from airl_mav.camera.frame import Frame
from companion.addons.cameras.drivers import DepthImage
from companion.addons.cameras.fitting import Lens


class SimulatorCamera:
    """The depth camera of airl-firmware, read as a driver reads its hardware."""

    def __init__(self):
        """Open the camera; what is raised here ends the program with one line."""
        self.socket = zmq.Context.instance().socket(zmq.SUB)
        self.socket.setsockopt(zmq.CONFLATE, 1)  # the newest image only
        self.socket.subscribe(b"")
        self.socket.connect(os.environ.get("CAMERA", "tcp://127.0.0.1:5600"))
        first = self._next(10.0)
        if first is None:
            raise RuntimeError("no image for 10 s")
        k = first.intrinsics
        self.lens = Lens(k.width, k.height, fx=k.focal, fy=k.focal, cx=k.cx, cy=k.cy)

    def read(self, timeout_s):
        """Return the next image, uint16 (height, width) [mm] and its age [µs], or None."""
        frame = self._next(timeout_s)
        return None if frame is None else DepthImage(frame.depth_mm, age_us=0)

    def close(self):
        """Let go of the camera."""
        self.socket.close()

    def _next(self, timeout_s):
        if not self.socket.poll(1000.0 * timeout_s):
            return None
        return Frame.from_bytes(self.socket.recv())

"""Makes a camera's images those of the vehicle profile's camera, with which policies are trained.

The profile's camera is a pinhole of few pixels, in the middle of what a real one sees. Each of its
pixels is looked up in the camera's image at the points of a grid, and the nearest return of them
wins: the function with which the shipped layouts shrink an image for the network, so a thin
obstacle is not lost, and a hole of the stereo matcher is "no return" only where all points are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import FieldError
from airl_mav.policy.images import nearest_returns

MOST_POINTS = 16
"""Points looked up along each side of a pixel, at most."""

LEAST_COVERAGE = 0.9
"""Share of the wanted image that a camera must see. A D435 at the end of its tolerance, 84 degrees
wide instead of 87, sees 0.91 of the image of the vehicle profile `quad-d435`."""


@dataclass(frozen=True)
class Lens:
    """A pinhole camera whose images are free of distortion, as depth cameras deliver them.

    A pixel (u, v) looks along ((u - cx) / fx, (v - cy) / fy, 1) in the optical frame (right, down,
    forward). Pixel centres are at whole numbers, as in librealsense and ROS 2's CameraInfo.
    """

    width: int
    height: int
    fx: float
    """Focal length in columns [px]."""
    fy: float
    """Focal length in rows [px]."""
    cx: float
    cy: float

    @property
    def field_of_view(self) -> str:
        """Horizontal and vertical field of view, in words."""
        wide = 2.0 * math.degrees(math.atan2(0.5 * self.width, self.fx))
        high = 2.0 * math.degrees(math.atan2(0.5 * self.height, self.fy))
        return f"{wide:.0f} x {high:.0f} deg"

    @classmethod
    def of(cls, k: Intrinsics) -> Lens:
        """Return the lens of a profile's camera, a pinhole."""
        return cls(k.width, k.height, k.focal, k.focal, k.cx, k.cy)


class Fitting:
    """From the images of one camera to those of another that looks the same way."""

    def __init__(self, lens: Lens, wanted: Intrinsics) -> None:
        """Find where each pixel of the wanted camera, a pinhole, lies in the images of the lens."""
        self.wanted = wanted
        """What `fit` returns images of."""
        points = math.ceil(max(lens.fx, lens.fy) / wanted.focal)
        points = min(max(points, 1), MOST_POINTS)
        self._columns, off_side = _places(
            *(wanted.width, wanted.focal, wanted.cx), *(lens.width, lens.fx, lens.cx), points
        )
        self._rows, off_end = _places(
            *(wanted.height, wanted.focal, wanted.cy), *(lens.height, lens.fy, lens.cy), points
        )
        self._unseen = off_end[:, None] | off_side[None, :]
        self._shape = lens.height, lens.width
        self.coverage = 1.0 - float(self._unseen.mean())
        """Share of the wanted image that the lens sees, 0 to 1."""

    def fit(self, depth_mm: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return the wanted image (wanted.height, wanted.width) [mm]; 0 = no return.

        Args:
            depth_mm: Z16 image (height, width) of the lens [mm]; 0 = no return.

        Raises:
            ValueError: An image of another size or type.
        """
        if depth_mm.shape != self._shape or depth_mm.dtype != np.uint16:
            raise ValueError(
                f"an image of {depth_mm.dtype} {depth_mm.shape}; accepted: uint16 {self._shape}"
            )
        seen = depth_mm[np.ix_(self._rows, self._columns)]
        seen[self._unseen] = 0
        # Values of nearest_returns are one less; "no return" wraps back to 0.
        nearest = nearest_returns(seen[None], self.wanted.height, self.wanted.width)
        fitted: NDArray[np.uint16] = nearest[0] + np.uint16(1)
        return fitted


def _places(
    size: int,
    focal: float,
    centre: float,
    lens_size: int,
    lens_focal: float,
    lens_centre: float,
    points: int,
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return for each point along one axis its nearest pixel of the lens, and whether it has none.

    Both (size x points,); where there is none the pixel is one at the edge.
    """
    at = (np.arange(size * points) + 0.5) / points - 0.5
    place = np.rint(lens_centre + lens_focal * (at - centre) / focal).astype(np.intp)
    return np.clip(place, 0, lens_size - 1), (place < 0) | (place >= lens_size)


def check_coverage(name: str, lens: Lens, fitting: Fitting, whose: str) -> None:
    """Raise FieldError for a camera that does not see what the policy is to see.

    Args:
        name: What the camera is called.
        lens: The camera.
        fitting: Of its images to what is wanted.
        whose: Whose camera is wanted: "vehicle quad".
    """
    if fitting.coverage >= LEAST_COVERAGE:
        return
    raise FieldError(
        "camera",
        name,
        problem=f"it sees {lens.field_of_view}: {100.0 * fitting.coverage:.0f} % of what the camera"
        f" of {whose} sees ({Lens.of(fitting.wanted).field_of_view}); accepted: at least"
        f" {100.0 * LEAST_COVERAGE:.0f} %. Name a vehicle profile whose [camera] is yours, and a"
        " policy trained with it",
    )

"""The images of n vehicles whose cameras have a table `imaging`: those of the rehearsal's."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.imaging import ImageFormation
from airl_mav.camera.render import Motion
from airl_mav.envs.colour_images import Looks
from airl_mav.envs.fleet import Fleet
from airl_mav.profiles.camera import Camera


class FormedImages:
    """Takes them one by one, with the function that the rehearsal's camera calls.

    A gain that follows the light must be there at once (`conditions.check_twin_imaging`): nothing
    outlasts an image, so that one camera serves all vehicles.
    """

    def __init__(self, camera: Camera, looks: Looks, name: str = "") -> None:
        """Take the camera, what holds the vehicles' arenas, and the name of a further camera."""
        self._formation, self._looks = ImageFormation(camera, name), looks

    def render(
        self,
        fleet: Fleet,
        who: NDArray[np.bool_],
        seeds: NDArray[np.int64],
        frames: NDArray[np.int64],
        out: NDArray[Any],
    ) -> None:
        """Write the images of the vehicles in `who` (n,).

        Args:
            fleet: How they move, and when.
            who: (n,) whose image is taken; the others' stays as it is.
            seeds: (n,) of the episodes.
            frames: (n,) numbers of the images in the episodes.
            out: (n, h, w, channels) written.
        """
        for i in np.flatnonzero(who).tolist():
            arena = self._looks.arenas[i]
            motion = Motion(
                fleet.position[i], fleet.quaternion[i], fleet.velocity[i], fleet.omega[i]
            )
            elapsed_us, seed, frame = int(fleet.time_us[i]), int(seeds[i]), int(frames[i])
            out[i] = self._formation.take(arena, elapsed_us, motion, seed, frame).image

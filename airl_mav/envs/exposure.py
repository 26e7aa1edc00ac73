"""The cameras of n vehicles: when each takes its frames, and what was on the newest one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Mount
from airl_mav.envs.arenas import ArenaBatch
from airl_mav.envs.camera import lens_of, look
from airl_mav.envs.draws import Stream, stream
from airl_mav.envs.fleet import Fleet
from airl_mav.envs.randomise import noisy_depth
from airl_mav.envs.spec import Randomisation
from airl_mav.envs.state import State, pack_generators, restore, take, unpack_generators
from airl_mav.profiles.vehicle import Camera


class Cameras:
    """Frames come at the camera's rate, at any phase of the decisions: the episode's seed's."""

    def __init__(
        self, n: int, camera: Camera, transport_us: int, randomisation: Randomisation
    ) -> None:
        """Take n cameras, the time from capture to decoded [µs], and the noise."""
        self.intrinsics = Intrinsics.of(camera)
        self.image = np.zeros((n, self.intrinsics.height, self.intrinsics.width), np.uint16)
        """(n, h, w) newest frames, Z16 [mm]."""
        self._period_us = camera.period_us
        self._transport_us = transport_us
        self._randomisation = randomisation
        self._noisy = bool(randomisation.depth_noise or randomisation.depth_dropout)
        self._mount = Mount(
            (camera.forward_m, 0.0, -camera.up_m), float(np.deg2rad(camera.pitch_up_deg))
        )
        self._lens = lens_of(self.intrinsics, camera.range_m)
        self._first_us = np.zeros(n, np.int64)
        self._rngs: list[np.random.Generator | None] = [None] * n

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i."""
        self._first_us[i] = -int(stream(seed, Stream.CAMERA).random() * self._period_us)
        self._rngs[i] = stream(seed, Stream.DEPTH)

    def age_us(self, time_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how old the newest decoded frame is at a time (n,) [µs] of each episode."""
        since_us = time_us - self._transport_us - self._first_us
        age: NDArray[np.int64] = self._transport_us + since_us % self._period_us
        return age

    def look(self, fleet: Fleet, arenas: ArenaBatch, who: NDArray[np.bool_]) -> None:
        """Take the frames of the vehicles in `who` (n,), from where they are now."""
        look(fleet, arenas, who, self._mount, self._lens, self.image)
        if self._noisy:
            for i in np.flatnonzero(who):
                rng = self._rngs[i]
                if rng is not None:
                    self.image[i] = noisy_depth(self.image[i], self._randomisation, rng)

    def get_state(self) -> State:
        """Return the frames, their phases, and where the generators of the noise stand."""
        return {
            "image": self.image.copy(),
            "first_us": self._first_us.copy(),
            "generators": pack_generators(self._rngs),
        }

    def set_state(self, state: State) -> None:
        """Go on from a saved state. Raises UsageError when it does not fit."""
        restore(self.image, state, "image")
        restore(self._first_us, state, "first_us")
        self._rngs = unpack_generators(take(state, "generators"))

"""Cameras of n vehicles: frame timing, rendering, noise and faults.

One compiled call renders the images of all vehicles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.noise import DepthNoise, noise_of, noisy_frame
from airl_mav.camera.projection import LensConstants, Scene, lens_of
from airl_mav.camera.raycast import render_depth
from airl_mav.camera.render import Motion, Mount, camera_pose, colour
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.core.streams import Stream, stream
from airl_mav.envs.arena_batch import ArenaBatch, move_obstacles, relief_of
from airl_mav.envs.decision import FrameTimes
from airl_mav.envs.faults import delays_of, gym_faults, later_us
from airl_mav.envs.fleet import Fleet, FramePoses
from airl_mav.envs.mesh_batch import MeshBatch, MeshesSeen, meshes_in
from airl_mav.envs.saved_state import Stateful
from airl_mav.faults import NOISE_SEED, Fault
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import SensorNoise

NEVER_US = 1 << 50
"""Time beyond the end of any flight [µs]."""


class Eye(NamedTuple):
    """Depth camera of n vehicles, as an argument for kernels."""

    mount: Mount
    lens: LensConstants
    image: NDArray[Any]
    """(n, h, w) newest depth images [mm]."""
    meshes: MeshBatch | None


class Eyes:
    """Images of one camera on each of n vehicles."""

    def __init__(
        self,
        n: int,
        camera: Camera,
        noise: SensorNoise,
        looks: Any,
        meshes: MeshesSeen | None,
        name: str = "",
    ) -> None:
        """Create n cameras; `name` = an additional camera. Other arguments as in `Cameras`."""
        self.intrinsics = Intrinsics.of(camera)
        self.image = np.zeros((n, *self.intrinsics.shape), self.intrinsics.dtype)
        """(n, ...) newest images, each as `camera.frame.Frame.image`."""
        self._noise = noise_of(camera, noise, name)
        self._mount = Mount.of(camera)
        self._lens = lens_of(self.intrinsics, camera.range_m)
        self._meshes = MeshesSeen(0) if meshes is None else meshes
        self._colour: Any = None
        """Renderer of colour images; None for depth cameras."""
        if self.intrinsics.kind != "depth":
            # Colour needs the appearance of an arena, which the depth kernels do not have.
            assert looks is not None  # noqa: S101 - colour cameras require arenas
            self._colour = colour("batch")(self.intrinsics, self._mount, looks, self._meshes)
        self._formed: Any = None
        """Image formation for single images, as in the rehearsal; None without a table `imaging`.
        It keeps no state between images (`check_gym_imaging`), so it serves all
        vehicles."""
        if camera.imaging is not None and looks is not None:
            self._formed, self._looks = colour("sensor")(camera, name), looks

    @property
    def eye(self) -> Eye | None:
        """Camera for the depth kernels; None if images require more than depth rendering."""
        # Only plain depth is rendered inside the flight kernels.
        if self._formed is not None or self._colour is not None or self._noise is not None:
            return None
        return self._eye(self.image)

    def _eye(self, image: NDArray[Any]) -> Eye:
        return Eye(self._mount, self._lens, image, self._meshes.by_depth)

    def take(
        self,
        fleet: Fleet | FramePoses,
        arenas: ArenaBatch,
        who: NDArray[np.bool_],
        seeds: NDArray[np.int64],
        frames: NDArray[np.int64],
        out: NDArray[Any] | None = None,
    ) -> None:
        """Take the images of the vehicles in `who` (n,) at their present poses.

        Args:
            fleet: Poses, motion and times.
            arenas: Arenas (n,), an element for each vehicle.
            who: (n,) vehicles to render; other images are unchanged.
            seeds: (n,) seeds of the episodes, for the noise.
            frames: (n,) numbers of the images in the episodes.
            out: (n, ...) written; None = `image`.
        """
        image: NDArray[Any] = self.image if out is None else out
        if self._formed is not None:
            poses = (fleet.position, fleet.quaternion, fleet.velocity, fleet.omega)
            for i in np.flatnonzero(who).tolist():
                motion, numbers = Motion(*(each[i] for each in poses)), (seeds[i], frames[i])
                arena, elapsed_us = self._looks.arenas[i], int(fleet.time_us[i])
                formed = self._formed.take(arena, elapsed_us, motion, *map(int, numbers))
                image[i] = formed.image
        elif self._colour is None:
            render_images(fleet, arenas, who, self._eye(image))
        else:
            self._colour.render(fleet, arenas, who, image)
        if self._noise is not None:
            _make_noisy(image, self._noise, who, seeds, frames)


class Cameras(Stateful):
    """Cameras of n vehicles; frames come at the main camera's rate, with a random phase.

    The phase is drawn from the seed. Additional cameras are triggered with the main one.
    """

    def __init__(
        self,
        n: int,
        camera: Camera,
        transport_us: int,
        noise: SensorNoise,
        faults: Sequence[Fault] = (),
        looks: Any = None,
        meshes: MeshesSeen | None = None,
        further: Mapping[str, Camera] | None = None,
    ) -> None:
        """Make the cameras of n vehicles.

        Args:
            n: Number of vehicles.
            camera: The main camera.
            transport_us: Time from capture to decoded frame [µs].
            noise: Noise settings of the images.
            faults: Camera faults of all vehicles: `delay` affects whole frames, others the main
                camera's images.
            looks: Appearance of the arenas; required by colour cameras.
            meshes: Meshes of the arenas; None = no meshes.
            further: Additional cameras by name; None = no additional cameras.
        """
        self._main = Eyes(n, camera, noise, looks, meshes)
        self.further = {
            name: Eyes(n, each, noise, looks, meshes, name)
            for name, each in (further or {}).items()
        }
        """Additional cameras by name, triggered with the main camera."""
        failing = gym_faults(faults, "camera")
        # Delays shift whole frames; the other faults change pixels.
        self._late = [each for each in failing if each.fault.kind == "delay"]
        self._first_us = np.zeros(n, np.int64)
        self.times = FrameTimes(
            self._first_us, camera.period_us, transport_us, delays_of(self._late)
        )
        """Times of capture and decoding of frames."""
        self._changed = [each for each in failing if each.fault.kind != "delay"]
        """Faults that change images, in the order of the episode's faults."""
        stuck = [each.number for each in failing if each.fault.kind == "stuck"]
        self._frozen = {number: np.zeros_like(self.image) for number in stuck}
        """Frozen image of a stuck camera, by the fault's number."""
        self._freeze_us = {number: np.zeros(n, np.int64) for number in stuck}
        """Capture time of the frozen image, past or future [µs]."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the main camera."""
        return self._main.intrinsics

    @property
    def image(self) -> NDArray[Any]:
        """(n, ...) newest images of the main cameras, each as `camera.frame.Frame.image`."""
        return self._main.image

    @property
    def latest_us(self) -> int:
        """Maximum time from capture to decoded frame [µs]."""
        late_s = sum(each.fault.amount for each in self._late)
        return self.times.transport_us + round(late_s * US_PER_S)

    @property
    def eye(self) -> Eye | None:
        """Camera for the depth kernels; None if images require more than depth rendering."""
        if self._changed or self.further:
            return None
        return self._main.eye

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i."""
        # The first frame lies up to a period before the start, so every start has a frame.
        self._first_us[i] = -int(stream(seed, Stream.CAMERA).random() * self.times.period_us)
        for each in self._changed:
            if each.number in self._frozen:
                # First frame after the fault's start; the start of the episode always has a frame.
                since_us = each.from_us - int(self._first_us[i])
                wait_us = -since_us % self.times.period_us if each.from_us else 0
                self._freeze_us[each.number][i] = each.from_us + wait_us

    def delay_us(self, capture_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the additional delay [µs] of frames captured at a time (n,) [µs]."""
        return later_us(self._late, capture_us)

    @property
    def may_freeze(self) -> bool:
        """True if any camera may be stuck."""
        return bool(self._freeze_us)

    def next_freeze_us(self, time_us: NDArray[np.int64]) -> NDArray[np.int64] | None:
        """Return the time (n,) of the next frozen image after these times; None = never."""
        if not self._freeze_us:
            return None
        # A flight's time is at a whole tick, so a capture is due at the nearest tick.
        ticks = [(at - time_us + TICK_US // 2) // TICK_US for at in self._freeze_us.values()]
        due = [np.where(each > 0, time_us + each * TICK_US, NEVER_US) for each in ticks]
        soonest: NDArray[np.int64] = np.minimum.reduce(due)
        return soonest

    def freeze(
        self,
        fleet: Fleet,
        arenas: ArenaBatch,
        seeds: NDArray[np.int64],
    ) -> None:
        """Store the images that are due; a stuck camera shows them from now on."""
        for number, at_us in self._freeze_us.items():
            who = np.abs(fleet.time_us - at_us) <= TICK_US // 2
            if who.any():
                frames = self._frames(fleet.time_us)
                self._main.take(fleet, arenas, who, seeds, frames, self._frozen[number])

    def capture(
        self,
        fleet: Fleet | FramePoses,
        arenas: ArenaBatch,
        who: NDArray[np.bool_],
        seeds: NDArray[np.int64],
    ) -> None:
        """Capture the frames of the vehicles in `who` (n,) at their present poses.

        The noise is drawn from the episodes' `seeds` (n,).
        """
        frames = self._frames(fleet.time_us)
        # Always pass the same type, so that the kernels are compiled once.
        fleet = FramePoses(*(getattr(fleet, name) for name in FramePoses._fields))
        for eyes in (self._main, *self.further.values()):
            eyes.take(fleet, arenas, who, seeds, frames)
        for each in self._changed:
            acts = who & each.at(fleet.time_us)
            if each.number in self._frozen:
                taken = acts & (fleet.time_us + TICK_US // 2 >= self._freeze_us[each.number])
                self.image[taken] = self._frozen[each.number][taken]
            elif acts.any():
                # Requested noise only: the stages of the camera were applied above.
                noise = DepthNoise(None, SensorNoise(depth_noise=each.fault.amount))
                # Each fault has its own noise stream.
                own = NOISE_SEED * (each.number + 1) + seeds
                _make_noisy(self.image, noise, acts, own, frames)

    def _frames(self, time_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers (n,) of frames captured at these times (n,) [µs]."""
        # Captures happen at whole ticks, up to half a tick before their time.
        frames: NDArray[np.int64] = (
            time_us + TICK_US // 2 - self._first_us
        ) // self.times.period_us
        return frames

    def _held(self) -> Mapping[str, Any]:
        held: dict[str, Any] = {"image": self.image, "first_us": self._first_us}
        # Omitted for one camera, as in earlier checkpoints.
        if self.further:
            held["further"] = {name: each.image for name, each in self.further.items()}
        return held


def _make_noisy(
    image: NDArray[Any],
    noise: DepthNoise,
    who: NDArray[np.bool_],
    seeds: NDArray[np.int64],
    frames: NDArray[np.int64],
) -> None:
    """Add noise to the images (n, ...) of `who` (n,), by their numbers (n,) in the episodes."""
    for i in np.flatnonzero(who).tolist():
        image[i] = noisy_frame(image[i], noise, int(seeds[i]), int(frames[i]))


@kernel
def scene_in(arenas: ArenaBatch, i: int) -> Scene:
    """Return room and obstacles of arena i."""
    n = arenas.n_obstacles[i]
    shape, center = arenas.shape[i, :n], arenas.center[i, :n]
    return Scene(arenas.bounds[i], shape, center, arenas.half_size[i, :n], arenas.yaw[i, :n])


@large_kernel
def render_images(
    fleet: Fleet | FramePoses, arenas: ArenaBatch, who: NDArray[np.bool_], eye: Eye | None
) -> None:
    """Render the depth image of every vehicle in `who` at its present pose.

    Args:
        fleet: Poses and times.
        arenas: Arenas (n,), an element for each vehicle; obstacles move to its time.
        who: (n,) vehicles to render; other images are unchanged.
        eye: The camera. Writes its image: depth [mm], 0 = no return, rounded and clipped as in
            `camera.frame.depth_to_z16`. None = nothing is rendered.
    """
    if eye is None:
        return
    image = np.empty(eye.image.shape[1:], np.float32)
    for i in range(len(who)):
        # `_to_z16` overwrites the same buffer for each vehicle.
        if not who[i]:
            continue
        move_obstacles(arenas, i, fleet.time_us[i])
        count = arenas.n_obstacles[i]
        position, quaternion = camera_pose(fleet.position[i], fleet.quaternion[i], eye.mount)
        scene = scene_in(arenas, i)
        meshes = meshes_in(eye.meshes, i, count, relief_of(arenas, i))
        render_depth(image, position, quaternion, eye.lens, scene, meshes)
        _to_z16(image, eye.image[i])


@kernel
def _to_z16(depth_m: NDArray[np.float32], out: NDArray[np.uint16]) -> None:
    """Write depth [m] as millimetres; `camera.frame.depth_to_z16` without temporaries."""
    for v in range(depth_m.shape[0]):
        for u in range(depth_m.shape[1]):
            mm = np.rint(depth_m[v, u] * np.float32(MM_PER_M))
            out[v, u] = np.uint16(min(mm, np.float32(MAX_MM)))

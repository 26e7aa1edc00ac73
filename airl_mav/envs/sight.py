"""Camera input of an environment's networks: vehicle cameras and their layout."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.faults.fault import Fault
from airl_mav.policy.observation_spec import (
    ObservationSpec,
    SeenCamera,
    camera_mismatch,
    further_mismatch,
)
from airl_mav.profiles.camera import Camera, check_noise, check_twin_imaging
from airl_mav.profiles.vehicle import VehicleProfile


class Sight(NamedTuple):
    """Cameras in use, and their observation layout."""

    camera: Camera
    """Main camera."""
    further: dict[str, Camera]
    """Additional cameras of the vehicle that the environment names."""
    observation: ObservationSpec

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the main camera."""
        return Intrinsics.of(self.camera)

    @property
    def lenses(self) -> dict[str, Intrinsics]:
        """Intrinsics of the additional cameras by name."""
        return {name: Intrinsics.of(each) for name, each in self.further.items()}

    @property
    def coloured(self) -> bool:
        """True if any camera is a colour or grey camera."""
        return any(each.kind != "depth" for each in (self.camera, *self.further.values()))


def sight_of(spec: EnvironmentSpec, vehicle: VehicleProfile) -> Sight:
    """Return the camera input of an environment's networks.

    Raises:
        UsageError: The vehicle's cameras do not match the layout, or a camera is missing.
    """
    camera = spec.camera.of(vehicle.camera)
    observation = ObservationSpec(
        layout=spec.layout,
        height_px=spec.image_height_px,
        width_px=spec.image_width_px,
        projection=camera.projection,
        horizontal_fov_deg=camera.horizontal_fov_deg,
        distortion=camera.distortion,
        range_m=camera.range_m,
        kind=camera.kind,
        frames=spec.frames,
        in_flight=spec.in_flight,
        goal_height=spec.goal_height,
        cameras=further_seen(spec, vehicle),
    )
    sight = Sight(camera, {name: vehicle.cameras[name] for name in spec.cameras}, observation)
    if problem := camera_mismatch(observation, sight.intrinsics):
        raise UsageError(f"image_width_px, image_height_px: {problem}")
    if problem := further_mismatch(observation, sight.lenses):
        raise UsageError(f"cameras: {problem}")
    # A level scan assumes that the middle of the image is ahead.
    if spec.layout == "scan" and camera.yaw_deg != 0.0:
        accepted = "another with a camera that does not look ahead (camera.yaw_deg)"
        raise FieldError("layout", spec.layout, accepted)
    return sight


def further_seen(spec: EnvironmentSpec, vehicle: VehicleProfile) -> dict[str, SeenCamera]:
    """Return the observation layout of additional cameras by name.

    Raises:
        FieldError: The vehicle has no camera with this name.
    """
    found = {}
    for name, asked in spec.cameras.items():
        camera = vehicle.cameras.get(name)
        if camera is None:
            has = ", ".join(map(repr, vehicle.cameras)) or "none beside its main one"
            problem = f"vehicle {spec.vehicle} has no such camera; accepted: {has}"
            raise FieldError(f"cameras.{name}", problem=problem)
        found[name] = SeenCamera(
            height_px=asked.image_height_px or camera.height_px,
            width_px=asked.image_width_px or camera.width_px,
            projection=camera.projection,
            horizontal_fov_deg=camera.horizontal_fov_deg,
            distortion=camera.distortion,
            range_m=camera.range_m,
            kind=camera.kind,
            frames=asked.frames,
        )
    return found


def check_conditions(sight: Sight, spec: EnvironmentSpec, faults: Sequence[Fault]) -> None:
    """Raise FieldError for camera conditions that the twin does not support."""
    further = sight.further.values()
    check_noise(sight.camera, spec.randomisation, faults, "randomisation", further)
    check_twin_imaging(sight.camera)
    for name, camera in sight.further.items():
        check_twin_imaging(camera, name)

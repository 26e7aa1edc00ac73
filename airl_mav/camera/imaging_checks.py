"""Checks of camera settings; imports little, so that commands can reject bad settings early."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib.util import find_spec

from airl_mav.core.errors import FieldError
from airl_mav.faults.fault import Fault
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.camera_kind import Renderer
from airl_mav.profiles.conditions import SensorNoise


def check_noise(
    camera: Camera,
    asked: SensorNoise,
    faults: Sequence[Fault],
    table: str = "sensors",
    further: Iterable[Camera] = (),
) -> None:
    """Raise FieldError for depth noise or faults without any depth camera."""
    if camera.kind == "depth":
        return
    measured = any(each.kind == "depth" for each in further)
    for name in ("depth_noise", "depth_dropout"):
        if (value := getattr(asked, name)) and not measured:
            raise FieldError(f"{table}.{name}", value, f"0 with a camera of kind {camera.kind!r}")
    for fault in faults:
        if (fault.part, fault.kind) == ("camera", "noise"):
            accepted = f"a depth camera; the vehicle's is of kind {camera.kind!r}"
            raise FieldError("faults", str(fault), accepted)


def check_renderer(
    camera: Camera, renderer: Renderer, arena: ArenaSpec, further: Iterable[Camera] = ()
) -> None:
    """Raise FieldError for cameras or arenas that a renderer does not support."""
    if renderer == "raycast":
        return
    for each in (camera, *further):
        _check_drawn(each, renderer, arena)


def _check_drawn(camera: Camera, renderer: Renderer, arena: ArenaSpec) -> None:
    accepted = None
    if camera.kind == "depth":
        accepted = "raycast with a depth camera; mitsuba draws colour"
    elif camera.imaging is not None:
        accepted = "raycast with a camera that has a table imaging"
    elif arena.appearance.fog.drawn:
        accepted = "raycast in an arena with fog"
    elif find_spec("mitsuba") is None:
        accepted = "raycast: mitsuba is not installed (pip install 'airl-mav[render]')"
    if accepted is not None:
        raise FieldError("renderer", renderer, accepted)


def check_twin_imaging(camera: Camera, name: str = "") -> None:
    """Raise FieldError for auto-exposure lag, unsupported where only decisions take frames."""
    auto = None if camera.imaging is None else camera.imaging.auto_exposure
    if auto is not None and auto.time_constant_s > 0.0:
        raise FieldError(
            f"{f'cameras.{name}' if name else 'camera'}.imaging.auto_exposure.time_constant_s",
            auto.time_constant_s,
            "0 in the batch twin, which takes the frames of decisions alone; any in lockstep",
        )

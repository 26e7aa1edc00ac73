"""The cameras that a vehicle has beside its main one: by name, all triggered with that."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, ValidationError

from airl_mav.core.errors import FieldError
from airl_mav.profiles.camera import Camera

MOST: Final = 32
"""Further cameras of a vehicle, at most: the largest images of all of them fit into one frame."""

_NAME = re.compile(r"[a-z][a-z0-9_]{0,23}")

_SAY_WHICH = ("model", "name")
"""No names: a file's table that has them replaces that of its base (`loading`)."""

ACCEPTED_NAME: Final = (
    "a name of a-z, 0-9 and _ that begins with a letter, 24 characters at most, but for"
    f" {' and '.join(_SAY_WHICH)}"
)


def is_camera_name(name: str) -> bool:
    """Return whether a further camera may be called so."""
    return _NAME.fullmatch(name) is not None and name not in _SAY_WHICH


def camera_named(name: str) -> str:
    """Return a further camera's name. Raises ValueError for one that none can have."""
    if not is_camera_name(name):
        raise ValueError(f"{name!r}: accepted: {ACCEPTED_NAME}")
    return name


def _each_by_itself(value: Any) -> Any:
    """Raise FieldError that names the camera, where its fields contradict each other."""
    if not isinstance(value, Mapping):
        return value
    if len(value) > MOST:
        raise FieldError("cameras", len(value), f"at most {MOST} further cameras")
    for name, table in value.items():
        if not (isinstance(name, str) and is_camera_name(name)):
            raise FieldError("cameras", name, ACCEPTED_NAME)
        if not isinstance(table, Mapping):
            continue
        try:
            Camera.model_validate(table)
        except FieldError as error:
            field = re.sub(r"^camera\b", f"cameras.{name}", error.field)
            raise FieldError(field, error.value, error.accepted, error.problem) from None
        except ValidationError:
            pass  # The vehicle's own validation says where.
    return value


FurtherCameras = Annotated[dict[str, Camera], BeforeValidator(_each_by_itself)]
"""By name."""


def with_the_rate(data: Any) -> Any:
    """Return what a vehicle profile is read from, further cameras with the main one's rate.

    What is no profile is returned as it is, for the validation to refuse.
    """
    if not isinstance(data, Mapping):
        return data
    main, further = data.get("camera"), data.get("cameras")
    rate = main.get("rate_hz") if isinstance(main, Mapping) else getattr(main, "rate_hz", None)
    if rate is None or not isinstance(further, Mapping):
        return data
    filled = {
        name: {"rate_hz": rate, **table} if isinstance(table, Mapping) else table
        for name, table in further.items()
    }
    return {**data, "cameras": filled}


def check_rates(main: Camera, further: Mapping[str, Camera]) -> None:
    """Raise FieldError for a further camera that is not triggered with the main one."""
    for name, camera in further.items():
        if camera.rate_hz != main.rate_hz:
            raise FieldError(
                f"cameras.{name}.rate_hz",
                camera.rate_hz,
                f"{main.rate_hz:g} Hz, the main camera's, or left out: all are triggered together",
            )

"""Layouts of the user's: classes, made without arguments, whose objects are a `Layout`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import plugins
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.policy.observation import Observation
from airl_mav.policy.observation_spec import Box, Encoded, ObservationSpec


class Layout(Protocol):
    """A layout of the user's."""

    def boxes(self, spec: ObservationSpec) -> Mapping[str, Box]:
        """Return its arrays by key: `spec.kind` uint8 (channels, height, width), others float32.

        The same of the keys of further cameras (`spec.further_keys`).
        """
        ...

    def encode(self, spec: ObservationSpec, seen: Observation) -> Mapping[str, NDArray[Any]]:
        """Return those arrays for n vehicles, as `encode_layout` does: of each from its own row."""
        ...


def own_boxes(spec: ObservationSpec) -> dict[str, Box]:
    """Return the arrays of a layout of the user's by key, sorted, if a network can take them."""
    found = {key: Box(*box) for key, box in sorted(_own(spec.layout).boxes(spec).items())}
    images = {spec.kind, *spec.further_keys.values()}
    wrong = [
        f"{key} {np.dtype(box.dtype)} {box.shape}"
        for key, box in found.items()
        if len(box.shape) != (3 if key in images else 1)
        or np.dtype(box.dtype) != np.dtype(np.uint8 if key in images else np.float32)
    ]
    if wrong or not images <= found.keys():
        problem = f"its arrays are {', '.join(wrong) or ', '.join(found)}"
        named = ", ".join((spec.kind, *sorted(spec.further_keys.values())))
        wanted = f"{named} uint8 (channels, height, width), all others float32 (k,)"
        raise FieldError(
            plugins.LAYOUTS.field, spec.layout, problem=f"{problem}; accepted: {wanted}"
        )
    return found


def own_arrays(spec: ObservationSpec, seen: Observation) -> Encoded:
    """Return what a layout of the user's makes of an observation, if it is what it says."""
    found, wanted = _own(spec.layout).encode(spec, seen), own_boxes(spec)
    encoded = {key: np.asarray(found[key]) for key in wanted if key in found}
    n = len(seen.goal)
    for key, box in wanted.items():
        array = encoded.get(key)
        if array is None or array.shape != (n, *box.shape) or array.dtype != box.dtype:
            given = "nothing" if array is None else f"{array.dtype} {array.shape}"
            raise UsageError(
                f"layout {spec.layout!r}: gives {given} for {key!r}; accepted:"
                f" {np.dtype(box.dtype)} {(n, *box.shape)}"
            )
    return encoded


@cache
def _own(name: str) -> Layout:
    """Return a layout of the user's. Raises FieldError."""
    door = plugins.LAYOUTS
    methods = ("boxes", "encode")
    found = plugins.load_part(
        door, name, lambda made: all(callable(getattr(made, each, None)) for each in methods)
    )
    try:
        return cast("Layout", found() if isinstance(found, type) else found)
    except Exception as error:
        problem = f"cannot be made without arguments: {type(error).__name__}: {error}"
        raise FieldError(door.field, name, problem=problem) from error

"""The state of environments as named arrays, for checkpoints."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError

State = dict[str, NDArray[Any]]
"""Arrays by name; "fleet/position" is `position` of the part `fleet`."""


def join_states(parts: Mapping[str, Mapping[str, NDArray[Any]]]) -> State:
    """Return the states of several parts as one."""
    return {f"{part}/{key}": value for part, state in parts.items() for key, value in state.items()}


def state_of_part(state: Mapping[str, NDArray[Any]], part: str) -> State:
    """Return the state of one part. Raises UsageError when there is none."""
    found = {key[len(part) + 1 :]: value for key, value in state.items() if _is_of(key, part)}
    if not found:
        raise UsageError(f"state: nothing of {part!r} in it: not of this environment")
    return found


def restore_array(target: NDArray[Any], state: Mapping[str, NDArray[Any]], key: str) -> None:
    """Write a saved array over one in place.

    Raises:
        UsageError: It is missing, or of another shape or type.
    """
    value = saved_array(state, key)
    if value.shape != target.shape or value.dtype != target.dtype:
        raise UsageError(
            f"state: {key} is {value.dtype} {value.shape}; accepted: {target.dtype} {target.shape}"
        )
    target[...] = value


def saved_array(state: Mapping[str, NDArray[Any]], key: str) -> NDArray[Any]:
    """Return a saved array. Raises UsageError when it is missing."""
    if key not in state:
        raise UsageError(f"state: {key} is missing: not of this environment")
    return np.asarray(state[key])


def pack(value: Any) -> NDArray[np.uint8]:
    """Return anything that JSON can hold as bytes (k,)."""
    return np.frombuffer(json.dumps(value).encode(), np.uint8).copy()


def unpack(array: NDArray[Any]) -> Any:
    """Return what `pack` took; tuples come back as lists."""
    return json.loads(array.astype(np.uint8).tobytes())


def pack_generators(generators: Iterable[np.random.Generator | None]) -> NDArray[np.uint8]:
    """Return the states of generators as bytes (k,)."""
    return pack([None if rng is None else rng.bit_generator.state for rng in generators])


def unpack_generators(array: NDArray[Any]) -> list[np.random.Generator | None]:
    """Return generators with the packed states."""
    return [None if state is None else _generator(state) for state in unpack(array)]


def _generator(state: Mapping[str, Any]) -> np.random.Generator:
    rng = np.random.default_rng(0)
    rng.bit_generator.state = state
    return rng


def _is_of(key: str, part: str) -> bool:
    return key.startswith(f"{part}/")

"""The state of environments as named arrays, for checkpoints."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError

State = dict[str, NDArray[Any]]
"""Arrays by name; "fleet/position" is `position` of the part `fleet`."""


class Stateful(ABC):
    """Base class of objects with checkpoint support."""

    @abstractmethod
    def _held(self) -> Mapping[str, Any]:
        """Return all variable state by name: arrays, lists of generators, nested dicts, parts."""

    def get_state(self) -> State:
        """Return the whole state, as copies."""
        return _taken(self._held())

    def set_state(self, state: State) -> None:
        """Restore a saved state; the next step continues as without interruption.

        Raises:
            UsageError: The state is from another environment.
        """
        _put_back(self._held(), state)


def _taken(held: Mapping[str, Any]) -> State:
    state: State = {}
    for name, part in held.items():
        if isinstance(part, np.ndarray):
            state[name] = part.copy()
        elif isinstance(part, list):
            state[name] = pack_generators(part)
        else:
            inner = part.get_state() if isinstance(part, Stateful) else _taken(part)
            state |= {f"{name}/{key}": array for key, array in inner.items()}
    return state


def _put_back(held: Mapping[str, Any], state: State) -> None:
    for name, part in held.items():
        if isinstance(part, np.ndarray):
            _restore_array(part, state, name)
        elif isinstance(part, list):
            # In place, because the part owns the list.
            part[:] = unpack_generators(saved_array(state, name))
        elif isinstance(part, Stateful):
            part.set_state(state_of_part(state, name))
        else:
            _put_back(part, state_of_part(state, name))


def state_of_part(state: State, part: str) -> State:
    """Return the state of one part. Raises UsageError if it is missing."""
    prefix = f"{part}/"
    found = {key[len(prefix) :]: value for key, value in state.items() if key.startswith(prefix)}
    if not found:
        raise UsageError(f"state: nothing of {part!r} in it: not of this environment")
    return found


def _restore_array(target: NDArray[Any], state: State, key: str) -> None:
    """Write a saved array over one in place. Raises UsageError for another shape or type."""
    value = saved_array(state, key)
    if value.shape != target.shape or value.dtype != target.dtype:
        raise UsageError(
            f"state: {key} is {value.dtype} {value.shape}; accepted: {target.dtype} {target.shape}"
        )
    # In place: kernels and other parts share the array.
    target[...] = value


def saved_array(state: State, key: str) -> NDArray[Any]:
    """Return a saved array. Raises UsageError if it is missing."""
    if key not in state:
        raise UsageError(f"state: {key} is missing: not of this environment")
    return np.asarray(state[key])


def pack(value: Any) -> NDArray[np.uint8]:
    """Return any JSON-compatible value as bytes (k,)."""
    return np.frombuffer(json.dumps(value).encode(), np.uint8).copy()


def unpack(array: NDArray[Any]) -> Any:
    """Return the value from `pack`; tuples become lists."""
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

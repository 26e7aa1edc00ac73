"""Snapshots of a simulation, to continue from one state any number of times.

A simulation is pickled in memory. Constant objects (setup, arena, functions without a closure) and
the clock are shared. Array views remain views: a copy would no longer follow its base array.
"""

from __future__ import annotations

import io
import pickle
from types import FunctionType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from firmware_sim.simulation import Simulation


class SimulationSnapshot:
    """State of a simulation: plant, built-in autopilot, camera, faults and record."""

    def __init__(self, simulation: Simulation, *shared: object) -> None:
        """Copy the state except for `shared` objects; see `Simulation.snapshot`."""
        internals = simulation.autopilot.internals
        if internals is None:
            raise ValueError("a snapshot needs the built-in autopilot")
        self._shared = list(shared)
        state = io.BytesIO()
        on_message, internals.on_message = internals.on_message, None
        try:
            _Pickler(state, self._shared).dump(simulation)
        except (TypeError, AttributeError, pickle.PicklingError) as error:
            raise ValueError(f"a snapshot needs a flight without links and logs: {error}") from None
        finally:
            internals.on_message = on_message
        self._state = state.getvalue()

    def restore(self) -> Simulation:
        """Return a new simulation in this state, which shares only the clock with others.

        Callbacks for texts of the autopilot are not restored. Close the simulation after use.
        """
        simulation: Simulation = _Unpickler(io.BytesIO(self._state), self._shared).load()
        return simulation


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, shared: list[object]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._shared = shared
        self._numbers = {id(each): number for number, each in enumerate(shared)}

    def persistent_id(self, obj: object) -> int | None:
        """Return the number of a shared object; None = the object is copied."""
        number = self._numbers.get(id(obj))
        if number is None and isinstance(obj, FunctionType) and obj.__closure__ is None:
            number = self._numbers[id(obj)] = len(self._shared)
            self._shared.append(obj)
        return number

    def reducer_override(self, obj: Any) -> Any:
        """Pickle an array view as a view of its base array."""
        if not isinstance(obj, np.ndarray) or not isinstance(obj.base, np.ndarray):
            return NotImplemented
        address, base = obj.__array_interface__["data"][0], obj.base
        offset = address - base.__array_interface__["data"][0]
        return _view, (base, obj.dtype, obj.shape, offset, obj.strides, obj.flags.writeable)


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, shared: list[object]) -> None:
        super().__init__(file)
        self._shared = shared

    def persistent_load(self, number: int) -> object:
        """Return a shared object."""
        return self._shared[number]


def _view(
    base: NDArray[Any],
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    offset: int,
    strides: tuple[int, ...],
    writeable: bool,
) -> NDArray[Any]:
    view: NDArray[Any] = np.ndarray(shape, dtype, base, offset, strides)
    view.flags.writeable = writeable
    return view

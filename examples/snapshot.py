"""Fly twice from one state: a snapshot of the vehicle and the built-in flight controller."""

from __future__ import annotations

import io
import pickle
from contextlib import closing
from types import FunctionType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.generate import generate
from airl_mav.core.clock import SimClock
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.simulation import EpisodeSetup, HoverStart, Simulation


class Snapshot:
    """State of a simulation in memory.

    Raises ValueError for real firmware, and for a simulation with open logs or links.
    """

    def __init__(self, simulation: Simulation) -> None:
        internals = simulation.autopilot.internals
        if internals is None:
            raise ValueError("a snapshot needs the built-in autopilot")
        self._functions: list[object] = []
        state = io.BytesIO()
        on_message, internals.on_message = internals.on_message, None
        try:
            _Pickler(state, self._functions).dump(simulation)
        except (TypeError, AttributeError, pickle.PicklingError) as error:
            raise ValueError(f"a snapshot needs a flight without links and logs: {error}") from None
        finally:
            internals.on_message = on_message
        self._state = state.getvalue()

    def restore(self) -> Simulation:
        """Return a new simulation in this state. Close it after use."""
        simulation: Simulation = _Unpickler(io.BytesIO(self._state), self._functions).load()
        return simulation


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, functions: list[object]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._functions = functions
        self._numbers: dict[int, int] = {}

    def persistent_id(self, obj: object) -> int | None:
        """Return the number of a function without a closure, which is not copied."""
        number = self._numbers.get(id(obj))
        if number is None and isinstance(obj, FunctionType) and obj.__closure__ is None:
            number = self._numbers[id(obj)] = len(self._functions)
            self._functions.append(obj)
        return number

    def reducer_override(self, obj: Any) -> Any:
        """Pickle an array view as a view: a copy would no longer follow its base array."""
        if not isinstance(obj, np.ndarray) or not isinstance(obj.base, np.ndarray):
            return NotImplemented
        address, base = obj.__array_interface__["data"][0], obj.base
        offset = address - base.__array_interface__["data"][0]
        return _view, (base, obj.dtype, obj.shape, offset, obj.strides, obj.flags.writeable)


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, functions: list[object]) -> None:
        super().__init__(file)
        self._functions = functions

    def persistent_load(self, number: int) -> object:
        """Return a function."""
        return self._functions[number]


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


def hover(simulation: Simulation) -> bytes:
    """Fly one second; return the motion."""
    for _ in range(250):
        simulation.tick()
    return simulation.plant.motion.tobytes()


if __name__ == "__main__":
    vehicle, spec = load_vehicle("quad"), load_profile("arenas", "crowded", ArenaSpec)
    arena = generate(spec, 1, name="crowded", vehicle_width_m=vehicle.body.width_m)
    setup = EpisodeSetup(vehicle, arena, seed=1)
    with closing(Simulation(setup, start_us=0, clock=SimClock())) as simulation:
        HoverStart(altitude_m=2.5).fly(simulation)
        simulation.begin()
        snapshot = Snapshot(simulation)
        first = hover(simulation)
    with closing(snapshot.restore()) as again:
        print(f"bit-identical: {hover(again) == first}")

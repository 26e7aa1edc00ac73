"""The store of parameters that MAVLink reads and writes."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from airl_mav.profiles.parameters import SPECS, parameter_values
from firmware_sim.autopilot.port import ParameterValue

_BY_NAME = {spec.name: i for i, spec in enumerate(SPECS)}


class Parameters:
    """A vehicle's parameters. Implements `port.ParameterStore`."""

    def __init__(self, overrides: Mapping[str, int | float] | None = None) -> None:
        """Start from the defaults and a vehicle profile's overrides; see `parameter_values`."""
        values = parameter_values(overrides or {})
        self._values = list(values.values())
        self._floats = {name: float(value) for name, value in values.items()}
        self.value: Callable[[str], float] = self._floats.__getitem__
        """Returns a value; fast enough for flight code that asks at every tick. Raises KeyError if
        the name is unknown."""
        self._listeners: list[Callable[[], None]] = []

    def on_change(self, listener: Callable[[], None]) -> None:
        """Call `listener` after every change."""
        self._listeners.append(listener)

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(SPECS)

    def __getitem__(self, name: str) -> float:
        """Return a value as a float. Raises KeyError for an unknown name."""
        return self._floats[name]

    def by_name(self, name: str) -> ParameterValue | None:
        """Return a parameter, or None when there is no such name."""
        index = _BY_NAME.get(name)
        return None if index is None else self.by_index(index)

    def by_index(self, index: int) -> ParameterValue | None:
        """Return a parameter, or None when the index is out of range."""
        if not 0 <= index < len(SPECS):
            return None
        return ParameterValue(SPECS[index].name, self._values[index], index)

    def set(self, name: str, value: int | float) -> ParameterValue | None:
        """Store a value, clamped to the range, and return what is stored now.

        A value that is not finite changes nothing.
        """
        index = _BY_NAME.get(name)
        if index is None:
            return None
        spec = SPECS[index]
        if value == value and abs(value) != float("inf"):
            kind = type(spec.default)
            stored = kind(min(spec.high, max(spec.low, value)))
            self._values[index], self._floats[name] = stored, float(stored)
            for listener in self._listeners:
                listener()
        return self.by_index(index)

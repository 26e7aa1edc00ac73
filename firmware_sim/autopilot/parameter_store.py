"""The store of parameters that MAVLink reads and writes, and the bounded view that is flown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Protocol

from airl_mav.core.errors import UsageError
from airl_mav.profiles.parameters import SPEC_BY_NAME, SPECS, flown_values, parameter_values
from firmware_sim.autopilot.autopilot_state import Message, Severity
from firmware_sim.autopilot.port import ParameterValue

_INDEX = {spec.name: i for i, spec in enumerate(SPECS)}
FLOAT32_RELATIVE = 1e-6
"""Values that differ by no more than this share are the same as MAVLink carries them."""

_INT32_LOW, _INT32_HIGH = -(2**31), 2**31 - 1


class Keeper(Protocol):
    """Memory of parameters that outlives the flight controller."""

    def read(self) -> Mapping[str, int | float]:
        """Return what is kept. Raises UsageError when it cannot be read."""

    def write(self, values: Mapping[str, int | float]) -> None:
        """Keep these instead. Raises OSError when they cannot be written."""


class Parameters:
    """A vehicle's parameters. Implements `port.ParameterStore`.

    As in PX4, whatever is set is stored as given. Flight code sees it within the bounds that can
    be flown.
    """

    def __init__(
        self,
        overrides: Mapping[str, int | float] | None = None,
        keeper: Keeper | None = None,
    ) -> None:
        """Start from the defaults.

        Args:
            overrides: Those of a vehicle profile, checked; see `parameter_values`. They are this
                vehicle's defaults.
            keeper: Has what users have set before, and keeps what they set; None: nobody does.
                Unknown names, and what does not fit a parameter's type, are left out.

        Raises:
            UsageError: An override is unknown or out of range, or what is kept cannot be read.
        """
        values = parameter_values(overrides or {})
        self._defaults = dict(values)
        self._values = list(values.values())
        self._flown = flown_values(overrides or {})
        self.value: Callable[[str], float] = self._flown.__getitem__
        """Returns a value as it is flown; fast enough for flight code that asks at every tick.
        Raises KeyError if the name is unknown."""
        self.revision = 0
        """Another number after each change of a value, the same until then."""
        self._listeners: list[Callable[[], None]] = []
        self._bounded: set[str] = {name for name in overrides or () if self._is_bounded(name)}
        """Parameters whose stored value is flown bounded, and said to be."""
        self._texts: list[Message] = [self._bounded_text(name) for name in sorted(self._bounded)]
        self._keeper = keeper
        if keeper is not None:
            for name, value in keeper.read().items():
                self._store(name, value)

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call `listener` after every change; return what ends that, to be called once."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def take_texts(self) -> list[Message]:
        """Return what is to be told of values that are not flown as stored, since the last call.

        Each is told once, and again only after it was flown as stored.
        """
        taken, self._texts = self._texts, []
        return taken

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(SPECS)

    def __getitem__(self, name: str) -> float:
        """Return a value as it is flown. Raises KeyError for an unknown name."""
        return self._flown[name]

    def by_name(self, name: str) -> ParameterValue | None:
        """Return a parameter as stored, or None when there is no such name."""
        index = _INDEX.get(name)
        return None if index is None else self.by_index(index)

    def by_index(self, index: int) -> ParameterValue | None:
        """Return a parameter as stored, or None when the index is out of range."""
        if not 0 <= index < len(SPECS):
            return None
        return ParameterValue(SPECS[index].name, self._values[index], index)

    def set(self, name: str, value: int | float) -> ParameterValue | None:
        """Store a value as given, and return what is stored now; None when there is no such name.

        What is no number of the parameter's type (NaN, infinite, beyond an INT32) changes nothing.
        """
        if self._store(name, value):
            self._changed()
        return self.by_name(name)

    def reset(self) -> None:
        """Return to the defaults, a vehicle profile's overrides included."""
        for name, value in self._defaults.items():
            self._store(name, value)
        self._changed()

    def load(self) -> bool:
        """Return to what is kept, to the defaults where nothing is; return whether that went well.

        Without a keeper there is nothing to return to: nothing changes.
        """
        if self._keeper is not None:
            try:
                kept = self._keeper.read()
            except UsageError:
                return False
            for name, value in {**self._defaults, **kept}.items():
                self._store(name, value)
            self._changed()
        return True

    def save(self) -> bool:
        """Keep what differs from the defaults; return whether that went well.

        Without a keeper there is nothing to do, and so nothing that could fail.
        """
        if self._keeper is not None:
            try:
                self._keeper.write(self.changed())
            except OSError:
                return False
        return True

    def changed(self) -> dict[str, int | float]:
        """Return the parameters that differ from the vehicle's defaults."""
        pairs = zip(self._defaults.items(), self._values, strict=True)
        return {name: value for (name, default), value in pairs if value != default}

    def _changed(self) -> None:
        for listener in self._listeners:
            listener()

    def _store(self, name: str, value: int | float) -> bool:
        index = _INDEX.get(name)
        if index is None or not math.isfinite(value):
            return False
        spec = SPECS[index]
        stored = type(spec.default)(value)
        if isinstance(stored, int) and not _INT32_LOW <= stored <= _INT32_HIGH:
            return False
        self._values[index] = stored
        self.revision += 1
        self._flown[name] = spec.flown(stored)
        if not self._is_bounded(name):
            self._bounded.discard(name)
        elif name not in self._bounded:
            self._bounded.add(name)
            self._texts.append(self._bounded_text(name))
        return True

    def _is_bounded(self, name: str) -> bool:
        stored = self._values[_INDEX[name]]
        return SPEC_BY_NAME[name].is_used and not math.isclose(
            self._flown[name], stored, rel_tol=FLOAT32_RELATIVE
        )

    def _bounded_text(self, name: str) -> Message:
        value, flown = self._values[_INDEX[name]], self._flown[name]
        return Message(Severity.WARNING, f"{name} {value:g} is flown as {flown:g}")

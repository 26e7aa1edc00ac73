"""Parameter store for MAVLink, with a bounded view for flight code."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from airl_mav.core.errors import UsageError
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName, px4_release
from firmware_sim.autopilot import autopilot_state

FLOAT32_RELATIVE = 1e-6
"""Relative difference up to which values are equal after float32 transfer over MAVLink."""

_INT32_LOW, _INT32_HIGH = -(2**31), 2**31 - 1


class Keeper(Protocol):
    """Persistent storage of parameters across flight controllers."""

    def read(self) -> Mapping[str, int | float]:
        """Return the stored parameters. Raises UsageError if reading fails."""

    def write(self, values: Mapping[str, int | float]) -> None:
        """Replace the stored parameters. Raises OSError if writing fails."""


class Parameters:
    """Parameters of a vehicle.

    As in PX4, values are stored as given. Flight code reads them clipped to supported limits.
    """

    def __init__(
        self,
        overrides: Mapping[str, int | float] | None = None,
        keeper: Keeper | None = None,
        release: PX4ReleaseName = CURRENT,
    ) -> None:
        """Start from the defaults.

        `overrides` of a vehicle profile, checked by `parameter_values`, are this vehicle's
        defaults. `keeper` stores the user's values; unknown names and values of the wrong type are
        ignored. `release` is the PX4 release whose parameters these are. Raises UsageError for an
        invalid override, or if the storage cannot be read.
        """
        self.release = px4_release(release)
        """PX4 release of the parameters."""
        self._index = {spec.name: i for i, spec in enumerate(self.release.specs)}
        values = self.release.parameter_values(overrides or {})
        self._defaults = dict(values)
        self._values = list(values.values())
        self._flown = self.release.flown_values(overrides or {})
        self.value: Callable[[str], float] = self._flown.__getitem__
        """Look-up of values clipped for flight, fast enough for a call in every tick. Raises
        KeyError if the name is unknown."""
        self.revision = 0
        """Counter that increases with each change of a value."""
        self.history: list[tuple[str, float, float]] = []
        """Name, old and new value of each change; the MAVLink server takes them."""
        self._listeners: list[Callable[[], None]] = []
        self._bounded: set[str] = {name for name in overrides or () if self._is_bounded(name)}
        """Parameters whose value is clipped for flight, and reported as such."""
        self._texts: list[autopilot_state.OperatorText] = [
            self._bounded_text(name) for name in sorted(self._bounded)
        ]
        self._keeper = keeper
        # Stored values come after the overrides: the user's choice wins.
        if keeper is not None:
            for name, value in keeper.read().items():
                self._store(name, value)

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call `listener` after every change; return a function to unregister it once."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def take_texts(self) -> list[autopilot_state.OperatorText]:
        """Return new texts about clipped values since the last call.

        Each is reported once, and again only after an unclipped value.
        """
        taken, self._texts = self._texts, []
        return taken

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(self.release.specs)

    def __getitem__(self, name: str) -> float:
        """Return a value clipped for flight. Raises KeyError for an unknown name."""
        return self._flown[name]

    def by_name(self, name: str) -> ParameterValue | None:
        """Return a parameter as stored, or None if the name is unknown."""
        index = self._index.get(name)
        return None if index is None else self.by_index(index)

    def by_index(self, index: int) -> ParameterValue | None:
        """Return a parameter as stored, or None if the index is out of range."""
        if not 0 <= index < len(self.release.specs):
            return None
        return ParameterValue(self.release.specs[index].name, self._values[index], index)

    def set(self, name: str, value: int | float) -> ParameterValue | None:
        """Store a value as given; return the stored parameter, or None if the name is unknown.

        Values outside the parameter's type (NaN, infinite, beyond INT32) have no effect.
        """
        if self._store(name, value):
            self._changed()
        return self.by_name(name)

    def reset(self, names: Iterable[str] | None = None) -> None:
        """Return parameters, None = all, to the defaults, including a profile's overrides."""
        for name in self._defaults if names is None else names:
            self._store(name, self._defaults[name])
        self._changed()

    def load(self) -> bool:
        """Reload the stored values and defaults; return success.

        Without storage nothing changes.
        """
        if self._keeper is not None:
            try:
                kept = self._keeper.read()
            except UsageError:
                return False
            # Names that are no longer stored return to their defaults.
            for name, value in {**self._defaults, **kept}.items():
                self._store(name, value)
            self._changed()
        return True

    def save(self) -> bool:
        """Store the values that differ from the defaults; return success.

        Without storage there is nothing to do, so the call succeeds.
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
        index = self._index.get(name)
        if index is None or not math.isfinite(value):
            return False
        spec = self.release.specs[index]
        # The default's type decides: INT32 values are truncated.
        stored = type(spec.default)(value)
        if isinstance(stored, int) and not _INT32_LOW <= stored <= _INT32_HIGH:
            return False
        if stored != self._values[index]:
            self.history.append((name, self._values[index], stored))
        self._values[index] = stored
        self.revision += 1
        # Flight code reads the clipped value, clients the stored one.
        self._flown[spec.current_name] = spec.flown(stored)
        if not self._is_bounded(name):
            self._bounded.discard(name)
        elif name not in self._bounded:
            self._bounded.add(name)
            self._texts.append(self._bounded_text(name))
        return True

    def _is_bounded(self, name: str) -> bool:
        stored, spec = self._values[self._index[name]], self.release.spec_by_name[name]
        return spec.is_used and not math.isclose(
            self._flown[spec.current_name], stored, rel_tol=FLOAT32_RELATIVE
        )

    def _bounded_text(self, name: str) -> autopilot_state.OperatorText:
        value = self._values[self._index[name]]
        flown = self._flown[self.release.spec_by_name[name].current_name]
        return autopilot_state.OperatorText(
            autopilot_state.Severity.WARNING, f"{name} {value:g} is flown as {flown:g}"
        )


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """Parameter as stored."""

    name: str
    value: int | float
    """Value: int for INT32 parameters, float for REAL32."""
    index: int

"""Parameters that outlive the flight controller: a file, as QGroundControl writes and loads it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.profiles.parameters import SPEC_BY_NAME
from firmware_sim.external.parameter_file import qgroundcontrol_file

_COLUMNS = 5
"""Vehicle id, component id, name, value, type: between tabs."""


class KeptParameters:
    """Parameters that users have set, by name. Implements `parameter_store.Keeper`."""

    def __init__(self, path: Path) -> None:
        """Keep them in a file that may not exist yet, in a folder that does."""
        self._path = path

    def read(self) -> dict[str, int | float]:
        """Return what is kept; nothing when there is no file yet.

        Parameters that PX4 has and this flight controller has not are left out.

        Raises:
            UsageError: The file cannot be read, or is no file of parameters.
        """
        try:
            lines = self._path.read_text(encoding="utf-8").splitlines()
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"{self._path}: cannot be read: {error}") from None
        values: dict[str, int | float] = {}
        for number, line in enumerate(lines, start=1):
            if not line.strip() or line.startswith("#"):
                continue
            columns = line.split("\t")
            try:
                _, _, name, text, _ = columns
                spec = SPEC_BY_NAME.get(name)
                value = int(text) if spec and isinstance(spec.default, int) else float(text)
            except ValueError:
                raise UsageError(
                    f"{self._path}: line {number}: accepted: {_COLUMNS} columns between tabs, "
                    f"vehicle, component, name, value, type; has {line!r}"
                ) from None
            if spec is not None:
                values[name] = value
        return values

    def write(self, values: Mapping[str, int | float]) -> None:
        """Keep these instead. Raises OSError when they cannot be written."""
        replace_file(self._path, qgroundcontrol_file(values).encode())

"""Parameter files: for the tools of external firmware, and to keep parameters between starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from firmware_sim.external.parameter_client import Value
from pathlib import Path

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.profiles.parameters import SPEC_BY_NAME

_INT32, _REAL32 = 6, 9
"""MAV_PARAM_TYPE in QGroundControl's files."""


def ardupilot_file(settings: Mapping[str, Value]) -> str:
    """Return a file in ArduPilot's format: `--defaults` of its SITL, Mission Planner, MAVProxy."""
    return "".join(f"{name} {value:g}\n" for name, value in settings.items())


def qgroundcontrol_file(settings: Mapping[str, Value]) -> str:
    """Return a file for QGroundControl (Vehicle Setup > Parameters > Tools), format "Parameters".

    Lines contain vehicle id, component id, name, value and type, separated by tabs.
    """
    head = "# Vehicle-Id Component-Id Name Value Type\n"
    return head + "".join(
        f"1\t1\t{name}\t{value}\t{_INT32}\n"
        if isinstance(value, int)
        else f"1\t1\t{name}\t{value:.9g}\t{_REAL32}\n"
        for name, value in settings.items()
    )


_COLUMNS = 5
"""Number of columns, separated by tabs: vehicle id, component id, name, value, type."""


class KeptParameters:
    """Stored user parameters, by name. Implements `parameter_store.Keeper`."""

    def __init__(self, path: Path) -> None:
        """Set the file, which may not exist yet, in an existing folder."""
        self._path = path

    def read(self) -> dict[str, int | float]:
        """Return the stored parameters; {} without a file.

        PX4 parameters that the built-in flight controller lacks are omitted.

        Raises:
            UsageError: The file cannot be read, or is not a parameter file.
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
        """Replace the stored parameters. Raises OSError if the file cannot be written."""
        replace_file(self._path, qgroundcontrol_file(values).encode())

"""The process of external firmware and its working folders, behind the parent-death guard.

Neither PX4 nor ArduPilot ends by itself when its simulator is gone.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.child_process import ChildProcess
from firmware_sim.flight_controller import FirmwareLostError, FirmwareMissingError


@dataclass(frozen=True)
class StartCommand:
    """How a program is started in a folder of its own."""

    argv: Sequence[str]
    """Program and arguments."""
    environment: Mapping[str, str]
    """Added to our own environment."""


class FirmwareProcess(ChildProcess):
    """One process of external firmware; it ends with us, also when we are killed."""

    def __init__(self, name: str, command: StartCommand, cwd: Path, log: Path) -> None:
        """Start it in a folder; what it prints is appended to `log`.

        `name` is what it is called in messages: PX4. Raises FirmwareMissingError if the program is
        not there, or may not be run.
        """
        self.name = name
        program = Path(command.argv[0])
        if not os.access(program, os.X_OK) or not program.is_file():
            raise FirmwareMissingError(f"{name}: {program}: not an executable program")
        super().__init__(command.argv, log, guarded=True, cwd=cwd, environment=command.environment)

    def check(self) -> None:
        """Raise FirmwareLostError when the process has ended."""
        exited = self.poll()
        if exited is not None:
            tail = self.log_tail()
            raise FirmwareLostError(
                f"{self.name} ended ({exited}); log: {self.log}" + (f"\n{tail}" if tail else "")
            )


class WorkingFolders:
    """One working folder after the other; firmware keeps parameters and flight logs there."""

    def __init__(self, name: str, kept: Path | None, log: Path | None) -> None:
        """Choose the place.

        Args:
            name: Name of the firmware: px4.
            kept: Folder that keeps the working folders; None = temporary ones, one at a time.
            log: Log of what the process prints; None = a file beside the working folders.
        """
        self._name = name
        self._flights = 0
        self._temporary = kept is None
        root = Path(tempfile.mkdtemp(prefix=f"airl-{name}-")) if kept is None else kept
        root.mkdir(parents=True, exist_ok=True)
        self._root = root.absolute()
        self.log = (log or root / f"{name}.log").absolute()

    def fresh(self) -> Path:
        """Return a new, empty working folder: nothing carries over from an earlier flight."""
        if self._temporary:
            shutil.rmtree(self._path, ignore_errors=True)
        while True:
            self._flights += 1
            # Processes that fly side by side may keep their folders in the same place.
            with suppress(FileExistsError):
                self._path.mkdir()
                return self._path

    def newest(self, suffix: str) -> Path | None:
        """Return the file with a suffix that was written last in the present folder, if any."""
        found = self._path.rglob(f"*{suffix}")
        return max(found, key=lambda path: path.stat().st_mtime_ns, default=None)

    def close(self) -> None:
        """Remove what is temporary; harmless when called again."""
        if self._temporary:
            shutil.rmtree(self._root, ignore_errors=True)

    @property
    def _path(self) -> Path:
        return self._root / f"{self._name}-{self._flights:03d}"

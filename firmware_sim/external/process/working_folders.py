"""Where a firmware process runs: a folder for each flight, and one log."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path


class WorkingFolders:
    """Folders for one flight after the other: parameters and flight logs of the firmware."""

    def __init__(self, name: str, kept: Path | None, log: Path | None) -> None:
        """Take where to be.

        Args:
            name: What the firmware is called: px4.
            kept: Folder that the flights' folders stay in; None = temporary ones, one at a time.
            log: What the process prints goes here; None = a file in the flights' folder.
        """
        self._kept = kept
        self._temporary: Path | None = None
        self._name = name
        self._flights = 0
        if kept is not None:
            kept.mkdir(parents=True, exist_ok=True)
        else:
            self._temporary = Path(tempfile.mkdtemp(prefix=f"airl-{name}-"))
        root = kept or self._temporary or Path()
        self.log = (log or root / f"{name}.log").absolute()
        self._root = root.absolute()

    def fresh(self) -> Path:
        """Return a new, empty folder: nothing of an earlier flight is known in it."""
        if self._temporary is not None:
            shutil.rmtree(self._root / self._folder, ignore_errors=True)
        while True:
            self._flights += 1
            path = self._root / self._folder
            if not path.exists():
                path.mkdir()
                return path

    def close(self) -> None:
        """Remove what is temporary; harmless when called again."""
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)

    @property
    def _folder(self) -> str:
        return f"{self._name}-{self._flights:03d}"

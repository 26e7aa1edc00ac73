"""Working folders of a firmware process: one for each flight, and one log."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path


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
        self._flights += 1
        while self._path.exists():
            self._flights += 1
        self._path.mkdir()
        return self._path

    def close(self) -> None:
        """Remove what is temporary; harmless when called again."""
        if self._temporary:
            shutil.rmtree(self._root, ignore_errors=True)

    @property
    def _path(self) -> Path:
        return self._root / f"{self._name}-{self._flights:03d}"

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
        """Return a new, empty working folder: nothing carries over from an earlier flight."""
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

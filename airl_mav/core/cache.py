"""Folders for generated files that can be rebuilt, mainly compiled code."""

from __future__ import annotations

import os
from pathlib import Path


def writable_folder(name: str) -> Path | None:
    """Return a folder with a given name for generated files, created if necessary.

    The folder is beside the package's byte code, or in the user's cache if the package is
    read-only. Returns None if both are read-only.
    """
    package = Path(__file__).resolve().parents[1]
    for parent in (package / "__pycache__", Path.home() / ".cache" / "airl-mav"):
        folder = parent / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return None

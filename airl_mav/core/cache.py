"""Folders for what is made on this machine and may be made again: compiled code above all."""

from __future__ import annotations

import os
from pathlib import Path


def writable_folder(name: str) -> Path | None:
    """Return a folder with that name for generated files, made if need be.

    Beside the package's own byte code, or in the user's cache where the package cannot be written.
    None where neither can.
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

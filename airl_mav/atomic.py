"""Files that are either the old one or the whole new one, whenever the process dies."""

from __future__ import annotations

import io
import os
import shutil
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray


def add_arrays(path: Path, prefix: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Add arrays to an .npz under `prefix`, in place of any there; the file is never half-written.

    The old archive is copied as bytes and appended to, so that adding an episode costs a copy and
    not a second compression of the whole run.
    """
    partial = path.with_name(path.name + ".partial")
    # Arrays of an episode that a kill cut off and that is flown again.
    stale = False
    if path.exists():
        with zipfile.ZipFile(path) as old:
            stale = any(name.startswith(prefix) for name in old.namelist())
        if not stale:
            shutil.copyfile(path, partial)
    mode: Literal["a", "w"] = "a" if path.exists() and not stale else "w"
    with zipfile.ZipFile(partial, mode, zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        if stale:
            with zipfile.ZipFile(path) as old:
                for member in old.infolist():
                    if not member.filename.startswith(prefix):
                        new.writestr(member, old.read(member))
        for name, array in arrays.items():
            with new.open(f"{prefix}{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
    _commit(partial, path)


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name to a new .npz, in place of any old one."""
    buffer = io.BytesIO()
    keywords: dict[str, Any] = dict(arrays)
    np.savez(buffer, **keywords)
    replace_file(path, buffer.getvalue())


def replace_file(path: Path, data: bytes) -> None:
    """Write a file so that a reader sees the old one or the whole new one, never a part."""
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(data)
    _commit(partial, path)


def _commit(partial: Path, path: Path) -> None:
    """Put a finished file in place, on the disk."""
    with partial.open("rb+") as file:
        os.fsync(file.fileno())
    partial.replace(path)
    with suppress(OSError):  # Not every file system lets a folder be synced.
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

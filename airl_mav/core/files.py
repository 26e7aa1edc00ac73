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


def add_arrays(path: Path, groups: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
    """Add groups of arrays to an .npz; the file is the old one or the whole new one.

    The old archive is copied as bytes and appended to, so that adding costs a copy and not a second
    compression of the whole run.

    Args:
        path: The archive; made when there is none.
        groups: Arrays by name, by group; their keys become `<group>/<name>`. All that the archive
            has of these groups is replaced.
    """
    partial = path.with_name(path.name + ".partial")
    old = path.exists()
    if old:
        shutil.copyfile(path, partial)
    with _archive(partial, "a" if old else "w") as new:
        stale = any(_group_of(name) in groups for name in new.namelist())
        if not stale:
            _write_groups(new, groups)
    if stale:
        # Arrays of an episode that a kill cut off and that is flown again.
        with _archive(partial, "w") as new:
            _copy_others(path, new, groups)
            _write_groups(new, groups)
    _commit(partial, path)


def _archive(path: Path, mode: Literal["a", "w"]) -> zipfile.ZipFile:
    return zipfile.ZipFile(path, mode, zipfile.ZIP_DEFLATED, compresslevel=1)


def _copy_others(
    path: Path, new: zipfile.ZipFile, groups: Mapping[str, Mapping[str, NDArray[Any]]]
) -> None:
    """Copy what an archive has of all other groups."""
    with zipfile.ZipFile(path) as old:
        for member in old.infolist():
            if _group_of(member.filename) not in groups:
                new.writestr(member, old.read(member))


def _write_groups(new: zipfile.ZipFile, groups: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
    for group, arrays in groups.items():
        for name, array in arrays.items():
            with new.open(f"{group}/{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)


def _group_of(name: str) -> str:
    return name.partition("/")[0]


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

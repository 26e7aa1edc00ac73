"""Episodes saved some at a time: at level gym they end faster than single ones can be saved.

The same files and the same promise as `RunFolder.save_episode`: arrays first, then the lines that
commit them.
"""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.atomic import replace_file
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.harness.run_folder import EPISODES_FILE, LATENCY_FILE, TRAJECTORIES_FILE, RunFolder

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Episode:
    """One episode, flown."""

    record: EpisodeRecord
    trajectory: Trajectory
    latency: Arrays
    """Stamps by column; see docs/run-folder.md."""


def save_episodes(folder: RunFolder, episodes: Sequence[Episode]) -> None:
    """Save episodes; on return they are on the disk."""
    paths = {e.record.index: e.trajectory.arrays() for e in episodes}
    _add(folder.path / TRAJECTORIES_FILE, paths)
    _add(folder.path / LATENCY_FILE, {e.record.index: e.latency for e in episodes})
    lines = b"".join(e.record.to_json().encode() + b"\n" for e in episodes)
    with (folder.path / EPISODES_FILE).open("ab") as file:
        file.write(lines)
        file.flush()
        os.fsync(file.fileno())


def _add(path: Path, episodes: Mapping[int, Arrays]) -> None:
    """Add the arrays of episodes to an archive, in place of any of theirs that are there."""
    buffer = io.BytesIO()
    old = path.read_bytes() if path.exists() else b""
    if old and not _holds_any(old, episodes):
        # As bytes: a second compression of the whole run would cost more than the flights.
        buffer.write(old)
        old = b""
    with zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        if old:
            _copy_others(old, new, episodes)
        for index, arrays in episodes.items():
            for name, array in arrays.items():
                with new.open(f"{index:03d}/{name}.npy", "w", force_zip64=True) as stream:
                    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
    replace_file(path, buffer.getvalue())


def _holds_any(archive: bytes, episodes: Mapping[int, Arrays]) -> bool:
    """Return whether an archive has arrays of an episode: a kill came before its line."""
    with zipfile.ZipFile(io.BytesIO(archive)) as old:
        return any(_episode_of(name) in episodes for name in old.namelist())


def _copy_others(archive: bytes, new: zipfile.ZipFile, episodes: Mapping[int, Arrays]) -> None:
    """Copy the arrays of all other episodes."""
    with zipfile.ZipFile(io.BytesIO(archive)) as old:
        for member in old.infolist():
            if _episode_of(member.filename) not in episodes:
                new.writestr(member, old.read(member))


def _episode_of(name: str) -> int:
    return int(name.partition("/")[0])

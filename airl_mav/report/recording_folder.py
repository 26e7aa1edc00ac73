"""Conversion of a black box to a run folder beside it, for reports and comparisons."""

from __future__ import annotations

import hashlib
from pathlib import Path

from airl_mav.black_box.mcap_file import read_black_box
from airl_mav.core.errors import UsageError
from airl_mav.core.files import sha256_of
from airl_mav.rehearsal.run_folder import RUN_FILE, RunFolder, load_info
from airl_mav.report.recorded_flight import DIGEST, episode_of, info_of

WITH_LOG = "-with-log"
"""Suffix of the run folder's name for a flight with a vehicle log."""


def take_in(path: Path, ulg: Path | None = None) -> Path:
    """Return the run folder of a black box and its vehicle's log, created beside it if missing."""
    box = read_black_box(path)
    folder = path.with_suffix("") if ulg is None else path.with_name(f"{path.stem}{WITH_LOG}")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if ulg is not None:
        # Imported here: pyulog is an extra.
        from airl_mav.report.logged_episode import logged_episode_of
        from airl_mav.vehicle_log import read_vehicle_log

        log = read_vehicle_log(ulg)
        digest = hashlib.sha256(f"{digest} {sha256_of(ulg)}".encode()).hexdigest()
    if (folder / RUN_FILE).exists():
        if load_info(folder).config.get(DIGEST) != digest:
            raise UsageError(
                f"{folder}: holds another run; accepted: that of {path.name}, or no such folder"
            )
        return folder
    episode = episode_of(box) if ulg is None else logged_episode_of(box, log)
    RunFolder.adopt(folder, info_of(box, digest)).save_episodes([episode])
    return folder

"""The run folder of a black box, beside it, which every report and comparison reads."""

from __future__ import annotations

import hashlib
from pathlib import Path

from airl_mav.black_box.reading import read_black_box
from airl_mav.core.errors import UsageError
from airl_mav.core.files import sha256_of
from airl_mav.rehearsal.run_folder import RUN_FILE, RunFolder, load_info
from airl_mav.report.recorded_flight import DIGEST, episode_of, info_of

WITH_LOG = "-with-log"
"""Ends the name of the run folder of a flight with the vehicle's own log."""


def take_in(path: Path, ulg: Path | None = None) -> Path:
    """Make the run folder of a black box, beside it, and return it; it may be there already.

    Args:
        path: The black box.
        ulg: The vehicle's own log of the flight; None: what the companion recorded is all.

    Raises:
        UsageError: The file is no black box, the log is of another flight, or the folder holds
            something else.
    """
    box = read_black_box(path)
    folder = path.with_suffix("") if ulg is None else path.with_name(f"{path.stem}{WITH_LOG}")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if ulg is not None:
        # Imported here: pyulog is an extra.
        from airl_mav.report.logged_flight import logged_episode_of
        from airl_mav.vehicle_log.ulog import read_vehicle_log

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

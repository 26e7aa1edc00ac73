"""What commands take for a run: its folder, or the black box of a flight."""

from __future__ import annotations

from pathlib import Path

from airl_mav.black_box.messages import SUFFIX
from airl_mav.cli.options import check_installed


def folder_of(path: Path, ulg: Path | None = None) -> Path:
    """Return a run's folder, made of a black box and its log if need be, or raise UsageError."""
    if path.suffix != SUFFIX or path.is_dir():
        return path
    check_installed("black-box" if ulg is None else "refit")
    # Imported here: MCAP is an extra.
    from airl_mav.report.recording_folder import take_in

    return take_in(path, ulg)

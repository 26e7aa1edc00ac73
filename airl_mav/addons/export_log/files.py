"""Export of a run's flights: MCAP and ULog files, and a live Foxglove server."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Literal

from airl_mav.addons.export_log.recorded import RecordedFlight
from airl_mav.addons.export_log.ulog_log import write_ulog
from airl_mav.core.files import replacing
from airl_mav.report.replay.replayed_flight import ReplayedRun
from firmware_sim.interfaces import ULOG_SUFFIX

Format = Literal["mcap", "ulog"]


def flight_of(run: ReplayedRun, index: int) -> RecordedFlight:
    """Return a flight of a run; raise UsageError if the flight or its arena is missing."""
    return RecordedFlight(run.flight(run.record(index)), run.info)


def write_flight(flight: RecordedFlight, run: Path, out: Path, kind: Format) -> Path:
    """Write a flight to a folder and return the file's path; a recorded ULog is copied."""
    name = f"flight-{flight.replayed.record.index:03d}"
    if kind == "mcap":
        # Imported here: MCAP and Foxglove's messages are extras.
        from airl_mav.addons.export_log.mcap_export import write_mcap

        path = out / f"{name}.mcap"
        write_mcap(flight, path)
        return path
    path, own = out / f"{name}{ULOG_SUFFIX}", run / f"{name}{ULOG_SUFFIX}"
    if not own.exists():
        write_ulog(flight, path)
    elif not (path.exists() and path.samefile(own)):
        with replacing(path) as partial:
            shutil.copyfile(own, partial)
    return path

"""Export files of a run's flights."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Literal

import numpy as np

from airl_mav.black_box.writing import McapFile
from airl_mav.core.constants import US_PER_S
from airl_mav.core.files import replacing
from airl_mav.rehearsal.run_folder import info_data
from airl_mav.report.export_log.recorded import RecordedFlight
from airl_mav.report.export_log.told import FlightMessages
from airl_mav.report.export_log.ulog_log import write_ulog
from airl_mav.report.replay.runs import ReplayedRun
from firmware_sim.flight_log.log_folder import ULOG_SUFFIX


def write_mcap(flight: RecordedFlight, path: Path) -> None:
    """Write a flight as MCAP, replacing an existing file."""
    messages = FlightMessages(flight)
    with replacing(path) as partial, partial.open("wb") as opened:
        file = McapFile(opened, run_of(flight))
        for message in messages:
            unix_us = messages.began_unix_us + message.time_us
            file.add(message.channel, message.data, unix_us)
        file.finish()


def run_of(flight: RecordedFlight) -> dict[str, Any]:
    """Return the run's description as in a black box, with the settings of this flight."""
    record, info = flight.replayed.record, flight.info
    config = info.config
    pilot, limits = dict(config.get("pilot") or {}), dict(config.get("limits") or {})
    pilot["goal_radius_m"] = record.goal_radius_m
    pilot.setdefault("hold_s", _hold_s(flight))
    limits["flight_s"] = record.time_limit_s
    told = {
        "goal": list(record.goal),
        "seed": record.seed,
        "speed": config.get("speed") or info.setup.speed or 1.0,
        "pilot": pilot,
        "limits": limits,
    }
    return {**info_data(info), "config": {**config, **told}, "seeds": [record.seed]}


def _hold_s(flight: RecordedFlight) -> float:
    """Return the median hold time of actions [s], for older runs without this setting."""
    columns = flight.decisions
    if not len(columns.get("sent_us", ())):
        return 0.0
    return float(np.median(columns["held_until_us"] - columns["sent_us"])) / US_PER_S


Format = Literal["mcap", "ulog"]


def flight_of(run: ReplayedRun, index: int) -> RecordedFlight:
    """Return a flight of a run; raise UsageError if the flight or its arena is missing."""
    return RecordedFlight(run.flight(run.record(index)), run.info)


def write_flight(flight: RecordedFlight, run: Path, out: Path, kind: Format) -> Path:
    """Write a flight to a folder and return the file's path; a recorded ULog is copied."""
    name = f"flight-{flight.replayed.record.index:03d}"
    if kind == "mcap":
        # Imported here: MCAP and Foxglove's messages are extras.
        from airl_mav.report.export_log.files import write_mcap

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

"""From a run folder to its report: the arenas are generated again from their seeds."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.flight.record import EpisodeRecord
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo, load
from airl_mav.report.html import build_report, pictured
from airl_mav.report.worst import EXAMINED, ranked


def rebuild(path: Path) -> tuple[LoadedRun, Path | None]:
    """Read a run folder and write its report.

    Returns:
        The run, and the path of the page; None when no episode was finished.

    Raises:
        UsageError: The folder holds no run, or a profile of it cannot be found any more.
    """
    run = load(path)
    if not run.episodes:
        return run, None
    vehicle = _vehicle(run.info)
    arenas = _arenas([*ranked(run)[:EXAMINED], *pictured(run)], vehicle)
    return run, build_report(run, arenas, vehicle=_as_flown(vehicle, run.info))


def pictured_arenas(run: LoadedRun) -> dict[int, Arena]:
    """Make the arenas of the flights that get pictures, by episode index. Raises UsageError."""
    return _arenas(pictured(run), _vehicle(run.info))


def _vehicle(info: RunInfo) -> VehicleProfile:
    """Return the vehicle of a run. Raises UsageError."""
    return load_profile("vehicles", info.setup.vehicle.name, VehicleProfile)


def _as_flown(vehicle: VehicleProfile, info: RunInfo) -> VehicleProfile:
    """Return the vehicle with the camera that an environment put in place of its own."""
    change = info.config.get("environment", {}).get("camera", {})
    given = {name: value for name, value in change.items() if value is not None}
    camera = vehicle.camera.model_copy(update=given)
    return vehicle.model_copy(update={"camera": camera})


def _arenas(records: Iterable[EpisodeRecord], vehicle: VehicleProfile) -> dict[int, Arena]:
    """Make the arenas of some flights, by episode index. Raises UsageError."""
    specs: dict[str, ArenaSpec] = {}
    arenas: dict[int, Arena] = {}
    for record in records:
        if record.arena not in specs:
            specs[record.arena] = load_profile("arenas", record.arena, ArenaSpec)
        if record.index not in arenas:
            arenas[record.index] = generate(
                specs[record.arena],
                record.arena_seed,
                name=record.arena,
                vehicle_width_m=vehicle.body.width_m,
            )
    return arenas

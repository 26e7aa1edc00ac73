"""From a run folder to its report: the arenas are generated again from their seeds."""

from __future__ import annotations

from pathlib import Path

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.harness.run_folder import LoadedRun, load
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.report.html import build_report, pictured


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
    return run, build_report(run, pictured_arenas(run))


def pictured_arenas(run: LoadedRun) -> dict[int, Arena]:
    """Make the arenas of the flights that get pictures, by episode index. Raises UsageError."""
    vehicle = load_profile("vehicles", run.info.setup.vehicle.name, VehicleProfile)
    return {
        episode.index: generate(
            load_profile("arenas", episode.arena, ArenaSpec),
            episode.arena_seed,
            name=episode.arena,
            vehicle_width_m=vehicle.body.width_m,
        )
        for episode in pictured(run)
    }

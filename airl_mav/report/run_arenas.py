"""Reconstruction of a run's vehicle and arenas from profiles and seeds."""

from __future__ import annotations

from collections.abc import Iterable

from airl_mav.arena.geometry import Arena
from airl_mav.core.errors import UsageError
from airl_mav.core.plugins import GENERATORS, is_loaded, load_part
from airl_mav.flight.episode_record import NO_ARENA, EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.arena import OBSTACLES, ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo


def vehicle_of(info: RunInfo) -> VehicleProfile:
    """Return the vehicle of a run with its changes; raise UsageError if its profile is missing."""
    vehicle = load_profile("vehicles", info.setup.vehicle.name, VehicleProfile)
    change = info.config.get("environment", {}).get("camera", {})
    given = {name: value for name, value in change.items() if value is not None}
    camera = vehicle.camera.model_copy(update=given)
    body = vehicle.body.model_copy(update=info.config.get("vehicle_body", {}))
    return vehicle.model_copy(update={"camera": camera, "body": body})


def check_trust(arena: str, spec: ArenaSpec) -> None:
    """Raise UsageError for an arena with a custom generator that this process did not load.

    A run folder from an untrusted source must not select the code to run.
    """
    if spec.generator != OBSTACLES and not is_loaded(GENERATORS, spec.generator):
        raise UsageError(
            f"arena {arena}: its generator {spec.generator!r} is code that would run on this "
            "machine; accepted: with --trust, if you trust its maker"
        )


def spec_of(arena: str) -> ArenaSpec:
    """Return an arena's profile; raise UsageError if it is missing or its generator untrusted."""
    spec = load_profile("arenas", arena, ArenaSpec)
    check_trust(arena, spec)
    return spec


def trust_arenas(run: LoadedRun) -> None:
    """Load the custom generators of a run's arenas. Raises UsageError."""
    for arena in {record.arena for record in run.episodes} - {NO_ARENA}:
        spec = load_profile("arenas", arena, ArenaSpec)
        if spec.generator != OBSTACLES:
            load_part(GENERATORS, spec.generator)


def arenas_of(records: Iterable[EpisodeRecord], vehicle: VehicleProfile) -> dict[int, Arena]:
    """Generate the arenas of flights, by episode index. Raises UsageError."""
    # Imported here: serving a page or rejecting an invalid run must not wait for numba.
    from airl_mav.arena.generate import generate
    from airl_mav.arena.tours import set_out_later

    specs: dict[str, ArenaSpec] = {}
    arenas: dict[int, Arena] = {}
    for record in records:
        if record.arena == NO_ARENA:
            continue
        if record.arena not in specs:
            specs[record.arena] = spec_of(record.arena)
        if record.index not in arenas:
            arena = generate(
                specs[record.arena],
                record.arena_seed,
                name=record.arena,
                vehicle_width_m=vehicle.body.width_m,
                zone=record.zone,
            )
            arenas[record.index] = set_out_later(arena, record.tours_s)
    return arenas


def arena_of(run: LoadedRun, episode: EpisodeRecord) -> Arena | None:
    """Generate the arena of a flight; None if a profile is missing."""
    try:
        return arenas_of([episode], vehicle_of(run.info)).get(episode.index)
    except UsageError:
        return None


def flown_path(run: LoadedRun, record: EpisodeRecord) -> Trajectory | None:
    """Return a flight's path up to the verdict, without the landing recorded after it."""
    path = run.trajectories.get(record.index)
    if path is None or not len(path):
        return None
    return path.between(int(path.time_us[0]), record.ended_us)

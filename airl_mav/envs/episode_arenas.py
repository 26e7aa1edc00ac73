"""Arenas of N flights, generated from seeds, ahead of time if the seeds are known."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from airl_mav.arena import geometry, placement
from airl_mav.arena.generate import generate
from airl_mav.camera.render import colour
from airl_mav.core.errors import UsageError
from airl_mav.envs import arena_batch, mesh_batch
from airl_mav.envs.spec import Curriculum, EnvironmentSpec
from airl_mav.profiles.arena import ArenaSpec

SLOWEST_M_S = 0.1
"""Minimum speed of a moving obstacle in an arena [m/s]."""

WIDEST_M = 50.0
"""Maximum gap between obstacles in an arena [m]."""


class CurriculumStage(NamedTuple):
    """Arena and zone of a curriculum stage."""

    arena: ArenaSpec
    zone: int
    """Zone of the arena that bounds the goal."""


def stages_of(settings: Curriculum | None, arena: ArenaSpec) -> list[CurriculumStage]:
    """Return the stages of a curriculum, easiest first; the arena's zones without a curriculum."""
    zones = len(arena.zones_m)
    settings = settings or Curriculum()
    count = settings.stages or zones
    # One stage, or the last one: everything as in the arena's profile.
    return [
        CurriculumStage(
            _eased(settings, arena, k / (count - 1) if count > 1 else 1.0),
            round(k * (zones - 1) / (count - 1)) if count > 1 else zones - 1,
        )
        for k in range(count)
    ]


def check_stage(stages: list[CurriculumStage], arena: ArenaSpec, stage: int | None) -> None:
    """Raise UsageError for a stage out of range."""
    if stage is None or 0 <= stage < len(stages):
        return
    if len(stages) == len(arena.zones_m):
        placement.zone_radius_m(arena, stage)
    raise UsageError(f"zone = {stage}: accepted: 0 <= value <= {len(stages) - 1}, the stages")


def _eased(settings: Curriculum, arena: ArenaSpec, gone: float) -> ArenaSpec:
    """Return an arena between the first stage (gone = 0) and the last stage (gone = 1)."""
    if gone >= 1.0:
        return arena
    count = settings.count + (1.0 - settings.count) * gone
    speed = settings.speed + (1.0 - settings.speed) * gone
    # The gap shrinks to the profile's value as the other quantities grow.
    gap_m = arena.min_clearance_m + (1.0 - gone) * settings.clearance_m
    static, moving = (
        kind.model_copy(update={"count": tuple(round(count * number) for number in kind.count)})
        for kind in (arena.static, arena.moving)
    )
    slower = tuple(max(SLOWEST_M_S, speed * each) for each in arena.moving.speed_m_s)
    moving = moving.model_copy(update={"speed_m_s": slower})
    changes = {"static": static, "moving": moving, "min_clearance_m": min(gap_m, WIDEST_M)}
    return arena.model_copy(update=changes)


class CurriculumState:
    """Open zone of the curriculum, and the outcomes that decide on the next one.

    The window of outcomes is rolling and must be full; it starts empty in every zone.
    """

    def __init__(self, settings: Curriculum, zones: int) -> None:
        """Start in the smallest of `zones` zones."""
        self.zone = 0
        self._settings = settings
        self._zones = zones
        self._outcomes: deque[bool] = deque(maxlen=settings.window)

    def record(self, zone: int, *, success: bool) -> None:
        """Record an episode's outcome; outcomes of earlier zones are ignored."""
        # The zone may have opened while the episode flew.
        if zone != self.zone:
            return
        self._outcomes.append(success)
        full = len(self._outcomes) == self._settings.window
        rate = sum(self._outcomes) / len(self._outcomes)
        if full and rate >= self._settings.threshold and self.zone < self._zones - 1:
            self.zone += 1
            self._outcomes.clear()

    def state(self) -> tuple[int, tuple[bool, ...]]:
        """Return zone and outcomes, for `restore`."""
        return self.zone, tuple(self._outcomes)

    def restore(self, zone: int, outcomes: tuple[bool, ...]) -> None:
        """Restore a saved state."""
        self.zone = zone
        self._outcomes = deque(outcomes, maxlen=self._settings.window)


class EpisodeArenas:
    """One arena per slot."""

    def __init__(
        self,
        spec: EnvironmentSpec,
        arena: ArenaSpec,
        n: int,
        vehicle_width_m: float,
        arena_seed: int | None,
        *,
        looks: bool = False,
    ) -> None:
        """Start without arenas.

        Args:
            spec: Environment, for its curriculum and the arena's name.
            arena: The arena's profile.
            n: Number of slots.
            vehicle_width_m: Width of a vehicle with a path to each goal [m].
            arena_seed: Seed of arena and goal of all episodes; None = the episode's seed.
            looks: True if the appearance is needed, for colour cameras.
        """
        self.spec = arena
        self.stages = stages_of(spec.curriculum, arena)
        self._name, self._vehicle_width_m = Path(spec.arena).stem, vehicle_width_m
        self._arena_seed = arena_seed
        self.present: list[geometry.Arena | None] = [None] * n
        """Arena of each slot; None before its first episode."""
        self.seeds = np.zeros(n, np.int64)
        """(n,) seeds of the episodes."""
        self.zones = np.full(n, -1, np.int64)
        """(n,) zones, or stages, that bound the goals; -1 = the whole arena."""
        self.begun = np.zeros(n, np.bool_)
        """(n,) True if an episode has started."""
        self.batch = arena_batch.batch_of([])
        """Arenas for the kernels; replaced when an arena exceeds their capacity."""
        self.looks = colour("looks")(n) if looks else None
        """Appearance of the arenas; None if not needed."""
        self.meshes = mesh_batch.MeshesSeen(n)
        """Meshes visible to cameras."""
        self._ahead: dict[tuple[int, int | None], geometry.Arena] = {}
        """Arenas generated ahead, by seed and zone."""

    def check_zone(self, zone: int | None) -> None:
        """Raise UsageError for a zone or stage out of range."""
        check_stage(self.stages, self.spec, zone)

    def begin(self, i: int, seed: int, zone: int | None) -> None:
        """Put slot i into the arena of an episode. Raises UsageError if generation fails."""
        arena = self._ahead.pop((seed, zone), None) or self._made(seed, zone)
        self.present[i], self.begun[i] = arena, True
        self.seeds[i], self.zones[i] = seed, -1 if zone is None else zone
        self._look_at(i, arena)
        if len(self.batch.bounds) == 0:
            # Other slots use the first arena until their episodes start.
            self.batch = arena_batch.batch_of([arena] * len(self.present))
        try:
            arena_batch.put_arena(self.batch, i, arena)
        except ValueError:
            # The arena exceeds the batch's capacity.
            self.batch = arena_batch.with_room(self.batch, arena)
            arena_batch.put_arena(self.batch, i, arena)

    def prepare(self, seeds: Sequence[int], zone: int | None) -> None:
        """Generate the arenas of likely next episodes; discards previously prepared ones.

        Only affects the duration of `begin`. Generated in a row, arenas take half as long as one at
        a time between two steps, each of which empties the processor's caches.
        """
        self._ahead.clear()
        for seed in seeds:
            # A failed arena raises an error when its episode starts.
            with suppress(UsageError):
                self._ahead[seed, zone] = self._made(seed, zone)

    def prepared(self, seeds: Sequence[int], zone: int | None) -> bool:
        """Return True if all of these arenas were generated ahead."""
        return all((seed, zone) in self._ahead for seed in seeds)

    def restore(self) -> None:
        """Regenerate all arenas from `seeds`, `zones` and `begun`."""
        self.present[:] = [
            self._made(int(seed), None if zone < 0 else int(zone)) if begun else None
            for seed, zone, begun in zip(self.seeds, self.zones, self.begun, strict=True)
            # Slots without an episode need a row too.
        ]
        spare = next((arena for arena in self.present if arena is not None), None)
        room = [spare if arena is None else arena for arena in self.present]
        self.batch = arena_batch.batch_of([arena for arena in room if arena is not None])
        for i, arena in enumerate(self.present):
            if arena is not None:
                self._look_at(i, arena)

    def _look_at(self, i: int, arena: geometry.Arena) -> None:
        """Add meshes and appearance of slot i's arena for the cameras."""
        self.meshes.put(i, arena)
        if self.looks is not None:
            self.looks.put(i, arena)

    def _made(self, seed: int, zone: int | None) -> geometry.Arena:
        stage = None if zone is None else self.stages[zone]
        return generate(
            self.spec if stage is None else stage.arena,
            seed if self._arena_seed is None else self._arena_seed,
            name=self._name,
            vehicle_width_m=self._vehicle_width_m,
            zone=None if stage is None else stage.zone,
        )

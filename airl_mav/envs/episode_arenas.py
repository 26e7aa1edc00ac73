"""The arenas that N flights are in: made from their seeds, ahead of time where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.core.errors import UsageError
from airl_mav.envs.arenas import batch_of, put_arena, with_room
from airl_mav.envs.colour_images import Looks
from airl_mav.envs.curriculum import check_stage, stages_of
from airl_mav.envs.meshes import MeshesSeen
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.profiles.arena import ArenaSpec


class EpisodeArenas:
    """One arena a slot."""

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
        """Make none yet.

        Args:
            spec: The environment: its curriculum, and what its arena is called.
            arena: The arena's profile.
            n: Number of slots.
            vehicle_width_m: A vehicle of this width has a way to each goal [m].
            arena_seed: Seed of arena and goal of all episodes; None: each episode's own.
            looks: Whether it matters how they look: a camera sees colours.
        """
        self.spec = arena
        self.stages = stages_of(spec.curriculum, arena)
        self._name, self._vehicle_width_m = Path(spec.arena).stem, vehicle_width_m
        self._arena_seed = arena_seed
        self.present: list[Arena | None] = [None] * n
        """None where no episode has begun."""
        self.seeds = np.zeros(n, np.int64)
        """(n,) of the episodes."""
        self.zones = np.full(n, -1, np.int64)
        """(n,) zones, or stages, that bound the goals; -1: the whole arena."""
        self.begun = np.zeros(n, np.bool_)
        """(n,) whether an episode has begun."""
        self.batch = batch_of([])
        """What the kernels look at; replaced where an arena is larger than all before."""
        self.looks = Looks(n) if looks else None
        """How they look; None: nobody asks."""
        self.meshes = MeshesSeen(n)
        """Those that cameras see."""
        self._ahead: dict[tuple[int, int | None], Arena] = {}
        """Arenas that were made ahead, by seed and zone."""

    def check_zone(self, zone: int | None) -> None:
        """Raise UsageError if there is no such zone or stage."""
        check_stage(self.stages, self.spec, zone)

    def begin(self, i: int, seed: int, zone: int | None) -> None:
        """Put slot i into the arena of an episode. Raises UsageError when none can be made."""
        arena = self._ahead.pop((seed, zone), None) or self._made(seed, zone)
        self.present[i], self.begun[i] = arena, True
        self.seeds[i], self.zones[i] = seed, -1 if zone is None else zone
        self.meshes.put(i, arena)
        if self.looks is not None:
            self.looks.put(i, arena)
        if len(self.batch.bounds) == 0:
            # The others stay in the first one's until their own begin.
            self.batch = batch_of([arena] * len(self.present))
        try:
            put_arena(self.batch, i, arena)
        except ValueError:
            # It is larger than all before.
            self.batch = with_room(self.batch, arena)
            put_arena(self.batch, i, arena)

    def prepare(self, seeds: Sequence[int], zone: int | None) -> None:
        """Make the arenas of episodes that are likely to begin soon, of no others from now on.

        It changes nothing but the time that `begin` takes. One after the other they take half as
        long as one at a time between two steps, each of which empties the processor's caches.
        """
        self._ahead.clear()
        for seed in seeds:
            # One that cannot be made is an error where its episode begins.
            with suppress(UsageError):
                self._ahead[seed, zone] = self._made(seed, zone)

    def prepared(self, seeds: Sequence[int], zone: int | None) -> bool:
        """Return whether all of these arenas have been made ahead."""
        return all((seed, zone) in self._ahead for seed in seeds)

    def restore(self) -> None:
        """Make all arenas again, from `seeds`, `zones` and `begun`."""
        self.present[:] = [
            self._made(int(seed), None if zone < 0 else int(zone)) if begun else None
            for seed, zone, begun in zip(self.seeds, self.zones, self.begun, strict=True)
        ]
        spare = next((arena for arena in self.present if arena is not None), None)
        room = [spare if arena is None else arena for arena in self.present]
        self.batch = batch_of([arena for arena in room if arena is not None])
        self.meshes.restore(self.present)
        if self.looks is not None:
            self.looks.restore(self.present)

    def _made(self, seed: int, zone: int | None) -> Arena:
        stage = None if zone is None else self.stages[zone]
        return generate(
            self.spec if stage is None else stage.arena,
            seed if self._arena_seed is None else self._arena_seed,
            name=self._name,
            vehicle_width_m=self._vehicle_width_m,
            zone=None if stage is None else stage.zone,
        )

"""The paper's curriculum: the next zone opens when enough of the last episodes were successes.

With obstacles that grow more, faster and denser, a zone is a stage: an easier arena, and one of the
arena's zones that bounds the goal.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from airl_mav.arena.zones import zone_radius_m
from airl_mav.core.errors import UsageError
from airl_mav.envs.spec import Curriculum
from airl_mav.profiles.arena import ArenaSpec

SLOWEST_M_S = 0.1
"""Least speed of a moving obstacle that an arena may have [m/s]."""

WIDEST_M = 50.0
"""Greatest gap between obstacles that an arena may ask for [m]."""


class Stage(NamedTuple):
    """Where the episodes of a stage are flown."""

    arena: ArenaSpec
    zone: int
    """Of the arena: it bounds the goal."""


def stages_of(settings: Curriculum | None, arena: ArenaSpec) -> list[Stage]:
    """Return the stages of a curriculum, the easiest first; without one, the arena's zones."""
    zones = len(arena.zones_m)
    settings = settings or Curriculum()
    count = settings.stages or zones
    return [
        Stage(
            _eased(settings, arena, k / (count - 1) if count > 1 else 1.0),
            round(k * (zones - 1) / (count - 1)) if count > 1 else zones - 1,
        )
        for k in range(count)
    ]


def check_stage(stages: list[Stage], arena: ArenaSpec, stage: int | None) -> None:
    """Raise UsageError when there is no such stage."""
    if stage is None or 0 <= stage < len(stages):
        return
    if len(stages) == len(arena.zones_m):
        zone_radius_m(arena, stage)
    raise UsageError(f"zone = {stage}: accepted: 0 <= value <= {len(stages) - 1}, the stages")


def _eased(settings: Curriculum, arena: ArenaSpec, gone: float) -> ArenaSpec:
    """Return an arena on the way from the first stage (gone = 0) to the last one (1)."""
    if gone >= 1.0:
        return arena
    count = settings.count + (1.0 - settings.count) * gone
    speed = settings.speed + (1.0 - settings.speed) * gone
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
    """The open zone, and the outcomes that will open the next one.

    The window is a rolling one and must be full; it starts empty in every zone.
    """

    def __init__(self, settings: Curriculum, zones: int) -> None:
        """Start in the smallest of `zones` zones."""
        self.zone = 0
        self._settings = settings
        self._zones = zones
        self._outcomes: deque[bool] = deque(maxlen=settings.window)

    def record(self, zone: int, *, success: bool) -> None:
        """Take an episode's outcome; one that was begun in an earlier zone no longer counts."""
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

"""The paper's curriculum: the next zone opens when enough of the last episodes were successes."""

from __future__ import annotations

from collections import deque

from airl_mav.envs.spec import Curriculum


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

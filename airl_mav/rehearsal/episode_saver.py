"""Saves episodes in batches, in a thread of its own.

Episodes of the levels gym and lockstep end faster than single ones can be saved. Who flies or
hands out flights must not wait for the disk. The files and what they promise are those of
`RunFolder.save_episodes`.
"""

from __future__ import annotations

import threading

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder

INTERVAL_S = 2.0
"""Time between two saves while the run is small [wall s]."""

INTERVAL_PER_SAVE = 9.0
"""Least time between two saves, in multiples of how long the last one took. Adding to an archive
copies it. Without this, saving would take most of the time of a run of ten thousand flights."""

MAX_WAITING = 1000
"""Most episodes that wait to be saved."""


class EpisodeSaver:
    """Saves episodes as they come. A context manager: at its end all of them are on the disk."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._changed = threading.Condition()
        self._waiting: list[FlownEpisode] = []
        self._ending = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="episode saver")

    def __enter__(self) -> EpisodeSaver:
        """Start."""
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Save the rest. Raises the error of a save that failed, unless one is under way."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        if error is None:
            self._raise_error()

    def add(self, episode: FlownEpisode) -> None:
        """Take an episode; blocks while too many wait. Raises the error of a save that failed."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._waiting) < MAX_WAITING or self._error)
            self._raise_error()
            self._waiting.append(episode)
            self._changed.notify_all()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    # --- the thread

    def _run(self) -> None:
        interval_s, ending = INTERVAL_S, False
        try:
            while not ending:
                ending, episodes = self._collect(interval_s)
                interval_s = max(INTERVAL_S, INTERVAL_PER_SAVE * self._save(episodes))
        except BaseException as error:  # Raised again where the episodes come from.
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _collect(self, interval_s: float) -> tuple[bool, list[FlownEpisode]]:
        """Wait for the next save; return whether it is the last one, and its episodes."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._ending or len(self._waiting) >= MAX_WAITING, interval_s
            )
            episodes, self._waiting = self._waiting, []
            self._changed.notify_all()
            return self._ending, episodes

    def _save(self, episodes: list[FlownEpisode]) -> float:
        """Save; return how long that took [wall s]."""
        clock = WallClock()
        if episodes:
            self._folder.save_episodes(episodes)
        return clock.time_us() / US_PER_S

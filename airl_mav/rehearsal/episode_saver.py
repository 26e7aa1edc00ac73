"""Saves episodes in batches, in a separate thread.

Episodes of the levels gym and lockstep end faster than single ones can be saved. The flying process
must not wait for the disk. Files and guarantees match `RunFolder.save_episodes`.
"""

from __future__ import annotations

import threading

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder

INTERVAL_S = 2.0
"""Interval between two saves of a small run [wall s]."""

INTERVAL_PER_SAVE = 9.0
"""Minimum interval between two saves, in multiples of the last save's duration. Each save copies
the archive; without this minimum, saving would dominate a run of ten thousand flights."""

MAX_WAITING = 1000
"""Maximum number of episodes that wait to be saved."""


class EpisodeSaver:
    """Saves episodes as they end. As a context manager, all are on disk at exit."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._changed = threading.Condition()
        self._waiting: list[FlownEpisode] = []
        self._ending = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="episode saver")

    def __enter__(self) -> EpisodeSaver:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Save the rest. Raises a failed save's error unless another exception is active."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        if error is None:
            self._raise_error()

    def add(self, episode: FlownEpisode) -> None:
        """Add an episode; blocks while the queue is full. Raises the error of a failed save."""
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
        except BaseException as error:  # Raised again in the caller's thread.
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _collect(self, interval_s: float) -> tuple[bool, list[FlownEpisode]]:
        """Wait for the next save; return True if it is the last one, and its episodes."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._ending or len(self._waiting) >= MAX_WAITING, interval_s
            )
            episodes, self._waiting = self._waiting, []
            self._changed.notify_all()
            return self._ending, episodes

    def _save(self, episodes: list[FlownEpisode]) -> float:
        """Save the episodes; return the duration [wall s]."""
        clock = WallClock()
        if episodes:
            self._folder.save_episodes(episodes)
        return clock.time_us() / US_PER_S

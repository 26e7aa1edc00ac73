"""Episodes saved some at a time: they end faster than single ones can be saved.

The same files and the same promise as `RunFolder.save_episodes`, by a thread of its own: who flies,
or hands out flights, must not wait for the disk.
"""

from __future__ import annotations

import threading
from types import TracebackType

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder

EVERY_S = 2.0
"""An episode waits no longer until it is saved, while the run is small [wall s]."""

PAUSE = 9.0
"""The pause after a save is at least so many times as long as the save took. Adding to an archive
copies it, so that in a run of ten thousand flights saving would otherwise take all the time."""

MOST = 1000
"""No more episodes wait to be saved."""


class Saver:
    """Saves episodes as they come. Use as a context manager: at its end all are on the disk."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._changed = threading.Condition()
        self._waiting: list[FlownEpisode] = []
        self._ending = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="saver")

    def __enter__(self) -> Saver:
        """Start."""
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Save what is left, and raise what went wrong with saving."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        if error is None:
            self._raise_what_broke()

    def add(self, episode: FlownEpisode) -> None:
        """Take an episode; waits when too many are waiting. Raises what went wrong with saving."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._waiting) < MOST or self._error is not None)
            self._raise_what_broke()
            self._waiting.append(episode)
            self._changed.notify_all()

    def _raise_what_broke(self) -> None:
        if self._error is not None:
            raise self._error

    # --- the thread

    def _run(self) -> None:
        pause_s, ending = EVERY_S, False
        try:
            while not ending:
                ending, episodes = self._collect(pause_s)
                pause_s = max(EVERY_S, PAUSE * self._save(episodes))
        except BaseException as error:  # raised where the episodes come from
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _collect(self, pause_s: float) -> tuple[bool, list[FlownEpisode]]:
        """Wait for the end of a pause; return whether no more will come, and what has come."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or len(self._waiting) >= MOST, pause_s)
            episodes, self._waiting = self._waiting, []
            self._changed.notify_all()
            return self._ending, episodes

    def _save(self, episodes: list[FlownEpisode]) -> float:
        """Save; return how long that took [wall s]."""
        clock = WallClock()
        if episodes:
            self._folder.save_episodes(episodes)
        return clock.time_us() / US_PER_S

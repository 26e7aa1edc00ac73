"""What a person sees while a rehearsal flies."""

from __future__ import annotations

import math
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.channel import State, Text

_WARNING = 4
"""MAV_SEVERITY_WARNING: this grave or graver is shown."""

_STYLE = {
    Outcome.SUCCESS: "green",
    Outcome.COLLISION: "red",
    Outcome.TIMEOUT: "yellow",
    Outcome.BATTERY: "magenta",
    Outcome.ABORTED: "red",
}


class RichObserver:
    """A progress bar over the episodes, a live line of the vehicle's state, a line per episode."""

    def __init__(self, console: Console, episodes: int, done: int = 0) -> None:
        """Take where to draw, the number of all episodes, and of those that are there already."""
        self._console = console
        self._episodes, self._done = episodes, done
        self.finished_episodes = 0
        """Number of those that have ended while it looked on."""
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[state]}"),
            console=console,
            transient=True,
        )
        self._task: TaskID | None = None
        self._goal = (0.0, 0.0)
        self._phase = ""

    def __enter__(self) -> RichObserver:
        """Start drawing."""
        self._progress.start()
        self._task = self._progress.add_task(
            "episodes", total=self._episodes, completed=self._done, state=""
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop drawing."""
        self._progress.stop()

    def waiting(self, what: str) -> None:
        """Show what is being waited for."""
        self._show(what)

    def episode(self, index: int, seed: int, goal: tuple[float, float]) -> None:
        """Show that an episode begins."""
        self._goal = goal
        self._phase = "booting"
        self._show(f"flight {index:03d}, seed {seed}")

    def phase(self, phase: str, time_us: int) -> None:
        """Show the phase in the live line."""
        self._phase = phase
        self._show(f"{phase} at {time_us / US_PER_S:.1f} s")

    def state(self, state: State, started_us: int) -> None:
        """Draw the live line."""
        away = math.hypot(self._goal[0] - state.position[0], self._goal[1] - state.position[1])
        self._show(
            f"{self._phase:<12} {(state.time_us - started_us) / US_PER_S:5.1f} s  "
            f"{away:5.1f} m to goal  {state.speed_m_s:4.1f} m/s  "
            f"{-state.position[2]:4.1f} m high  {100 * state.battery:3.0f} %"
        )

    def text(self, text: Text) -> None:
        """Print what the autopilot says, if it is a warning or worse."""
        if text.severity <= _WARNING:
            self._say(f"  autopilot: {text.text}")

    def finished(self, record: EpisodeRecord) -> None:
        """Print an episode's line and advance the bar."""
        self.finished_episodes += 1
        quality = record.quality
        figures = ""
        if quality is not None:
            figures = (
                f"{quality.flight_time_s:6.1f} s {quality.distance_m:6.1f} m "
                f"{quality.energy_j / 1e3:6.2f} kJ  "
            )
        self._console.print(
            f"  flight {record.index:03d}  seed {record.seed:<5} "
            f"{record.outcome.value:<10}{figures}{record.reason}",
            style=_STYLE[record.outcome],
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
        for note in record.notes:
            self._say(f"    {note}")
        if record.sha256 is not None:
            self._console.print(
                f"    sha256 {record.sha256['flight']}",
                style="dim",
                highlight=False,
                soft_wrap=True,
            )
        # Into a file or a pipe, lines must not wait for the end of the run.
        self._console.file.flush()
        if self._task is not None:
            self._progress.advance(self._task)

    def lost(self, what: str) -> None:
        """Print what happened to an episode that begins again."""
        self._say(f"  {what}")

    def _say(self, text: str) -> None:
        self._console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)

    def _show(self, text: str) -> None:
        if self._task is not None:
            self._progress.update(self._task, state=text)

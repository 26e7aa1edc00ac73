"""Output of a command: text, only the result, or JSON lines for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field
from rich.console import Console

from airl_mav import __version__
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel
from airl_mav.core.progress import Event, JsonProgress, Progress, RichProgress, new_console

if TYPE_CHECKING:
    from airl_mav.rehearsal.run_folder import LoadedRun
    from airl_mav.report.run_verdict import OverallVerdict

SCHEMA = 1
"""Version of the JSON lines; docs/reference/json-lines.md describes them."""


class Telling(ProfileModel):
    """Output mode of a command."""

    quiet: bool = Field(
        default=False,
        description="print nothing but the result: the verdict and the path of the report or run"
        " folder; errors go to standard error",
    )
    json_lines: bool = Field(
        default=False,
        description="print lines of JSON for programs, and nothing else, on standard output"
        " (docs/reference/json-lines.md)",
    )


@dataclass(frozen=True)
class Started(Event):
    """Start of the command, after reading its input."""

    event: ClassVar[str] = "started"
    schema: int
    """Version of these lines: 1."""
    command: str
    version: str
    """Version of airl-mav."""
    time_utc: str
    """Time in ISO 8601."""


@dataclass(frozen=True)
class ToldRun:
    """Statistics of a run."""

    name: str
    """Name in the comparison; for a single run, the name of the folder."""
    path: str
    """Run folder."""
    planned: int
    """Planned number of flights."""
    flights: int
    """Number of finished flights."""
    quality: dict[str, Any]
    """Each statistic of `airl_mav.flight.statistics.Aggregate`: `value`, `low` and `high` of its 95
    % interval, `n`; `outcomes` counts the flights by outcome."""
    sha256: str | None
    """Digest of all flights in lockstep; None at other levels and for incomplete runs."""


@dataclass(frozen=True)
class Finished(Event):
    """End of the command: always the last line, unless the input is invalid."""

    event: ClassVar[str] = "finished"
    exit_status: int
    ended: str
    """State: `complete`, `interrupted` or `broken off`."""
    path: str
    """Folder of the results."""
    page: str | None = None
    """Report page; None = no report."""
    status: str | None = None
    """`met`, `not met`, `undecided`, `invalid` or `nothing required`; None = no verdict."""
    sentences: tuple[str, ...] = ()
    """Text of the verdict, as printed."""
    runs: tuple[ToldRun, ...] = ()
    """Statistics of the runs with flights."""


class Voice:
    """Output of a command. Use as a context manager to draw progress bars."""

    def __init__(self, options: Telling, command: str, console: Console | None = None) -> None:
        """Prepare the output of a command; raise FieldError if both kinds are requested."""
        if options.quiet and options.json_lines:
            raise FieldError("quiet", True, problem="accepted: without --json")
        self._out = console or new_console()
        self._json = JsonProgress(self._out.file) if options.json_lines else None
        self._quiet = options.quiet
        self._command = command
        silent = options.quiet or options.json_lines
        self.console = new_console(quiet=True) if silent else self._out
        """Console for text that only people read: remarks and tables."""
        self._drawn = None if silent else RichProgress(self._out)
        self.progress: Progress = self._drawn or self._json or _Errors()
        """Receiver of progress reports."""

    def __enter__(self) -> Voice:
        """Start drawing bars, or write the `started` event."""
        if self._drawn is not None:
            self._drawn.__enter__()
        if self._json is not None:
            now = utc_now().isoformat(timespec="seconds")
            self._json.tell(Started(SCHEMA, self._command, __version__, now))
        return self

    def __exit__(self, *raised: Any) -> None:
        """Remove the bars."""
        if self._drawn is not None:
            self._drawn.__exit__(*raised)

    def finish(
        self,
        exit_status: int,
        ended: str,
        path: Path,
        *,
        verdict: OverallVerdict | None = None,
        page: Path | None = None,
        runs: Mapping[str, LoadedRun] | None = None,
        more: Sequence[str] = (),
    ) -> None:
        """Write the result of a command; `ended` is "complete", "interrupted" or "broken off"."""
        lines = () if verdict is None else verdict.lines
        if self._json is not None:
            told = tuple(_told(name, run) for name, run in (runs or {}).items())
            status = None if verdict is None else verdict.status
            shown = None if page is None else str(page)
            self._json.tell(Finished(exit_status, ended, str(path), shown, status, lines, told))
        if not self._quiet:
            return
        for line in (*lines, *more):
            self._out.print(line, highlight=False, soft_wrap=True)
        last = f"report  {page}" if page is not None else f"folder  {path}"
        if ended != "complete":
            last = f"{ended}: {path}"
        self._out.print(last, highlight=False, soft_wrap=True)


def _told(name: str, run: LoadedRun) -> ToldRun:
    # Imported here: flights do not need statistics.
    from airl_mav.flight.episode_record import run_sha256
    from airl_mav.flight.statistics import aggregate

    quality = asdict(aggregate(run.episodes))
    outcomes = {outcome.value: number for outcome, number in quality.pop("outcomes").items()}
    return ToldRun(
        name=name,
        path=str(run.path),
        planned=len(run.info.seeds),
        flights=len(run.episodes),
        quality={**quality, "outcomes": outcomes},
        sha256=run_sha256(run.episodes) if len(run.episodes) == len(run.info.seeds) else None,
    )


class _Errors(Progress):
    """Progress that prints only errors."""

    def note(self, text: str, style: str | None = None) -> None:
        """Print an error on standard error."""
        if style == "red":
            new_console(stderr=True, soft_wrap=True).print(text, style=style)

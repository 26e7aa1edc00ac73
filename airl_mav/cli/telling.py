"""What a command prints: for a person, nothing but the result, or lines of JSON for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field
from rich.console import Console

from airl_mav import __version__
from airl_mav.core.clock import utc_now
from airl_mav.core.console import new_console
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel
from airl_mav.core.json_progress import JsonProgress
from airl_mav.core.progress import Event, Progress, RichProgress

if TYPE_CHECKING:
    from airl_mav.rehearsal.run_folder import LoadedRun
    from airl_mav.report.verdict import OverallVerdict

SCHEMA = 1
"""Version of the lines; docs/reference/json-lines.md describes them."""


class Telling(ProfileModel):
    """For whom a command prints."""

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
    """The command has read its input and begins."""

    event: ClassVar[str] = "started"
    schema: int
    """Version of these lines: 1."""
    command: str
    version: str
    """Of airl-mav."""
    time_utc: str
    """ISO 8601."""


@dataclass(frozen=True)
class ToldRun:
    """A run in figures."""

    name: str
    """What the comparison calls it; that of its folder for a single run."""
    path: str
    """Its folder."""
    planned: int
    """Number of flights in all."""
    flights: int
    """Number of those that are there."""
    quality: dict[str, Any]
    """Each figure of `airl_mav.flight.statistics.Aggregate`: `value`, `low` and `high` of its 95 %
    interval, `n`; `outcomes` counts the flights by outcome."""
    sha256: str | None
    """Fingerprint of all its flights in lockstep; None elsewhere."""


@dataclass(frozen=True)
class Finished(Event):
    """The command ends: always the last line, unless the input could not be used."""

    event: ClassVar[str] = "finished"
    exit_status: int
    ended: str
    """`complete`, `interrupted` or `broken off`."""
    path: str
    """The folder of what was made."""
    page: str | None = None
    """Its report; None: there is none."""
    status: str | None = None
    """`met`, `not met`, `undecided`, `invalid` or `nothing required`; None: there is no verdict."""
    sentences: tuple[str, ...] = ()
    """The verdict as it is printed."""
    runs: tuple[ToldRun, ...] = ()
    """The runs that have flights, in figures."""


class Voice:
    """How a command speaks. Use as a context manager: bars are drawn in it."""

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
        """Takes what only a person reads: remarks and tables."""
        self._drawn = None if silent else RichProgress(self._out)
        self.progress: Progress = self._drawn or self._json or _Errors()
        """Is told how far the work is."""

    def __enter__(self) -> Voice:
        """Begin: draw bars, or tell that the command has started."""
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
        """Write the result of a command, which has "complete", is "interrupted" or "broken off"."""
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
    # Imported here: no flight waits for statistics.
    from airl_mav.flight.record import run_sha256
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
    """Passes everything over but what went wrong."""

    def note(self, text: str, style: str | None = None) -> None:
        """Print an error on standard error."""
        if style == "red":
            new_console(stderr=True, soft_wrap=True).print(text, style=style)

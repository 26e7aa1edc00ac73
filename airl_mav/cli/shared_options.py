"""Options shared by commands: requirements, live view, recordings as runs, output mode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field
from rich.console import Console

from airl_mav import __version__
from airl_mav.black_box.messages import SUFFIX
from airl_mav.cli.options import REPEATED, check_installed, scenario_of
from airl_mav.core import addons, clock, errors, fields, progress
from airl_mav.rehearsal.live_view import ViewRequest
from airl_mav.scenario import aircraft, model

if TYPE_CHECKING:
    from airl_mav.experiments.experiment import Experiment, ExperimentRun
    from airl_mav.flight.requirements import Requirement
    from airl_mav.rehearsal.run_folder import LoadedRun
    from airl_mav.report.run_verdict import OverallVerdict

TrustArenas = Annotated[
    bool,
    Field(
        description="run the arena generators named by the runs: code by the author of the folder"
    ),
]


class Gate(fields.ProfileModel):
    """Requirements, and files for the verdict."""

    GROUP: ClassVar[str] = "requirements"
    require: Annotated[tuple[str, ...], REPEATED, fields.COMMON] = Field(
        default=(),
        description="requirement, decided on the 95 % interval, as 'success >= 95 %'; may be"
        " repeated. Exit status 3: not met, 5: too few flights to decide",
    )
    junit: Path | None = Field(
        default=None, description="write the verdict as JUnit XML into this file"
    )
    badge: Path | None = Field(
        default=None, description="write the verdict as a badge, an SVG picture, into this file"
    )


def requirements_of(gate: Gate, *, reference: bool = True) -> tuple[Requirement, ...]:
    """Return the requirements; FieldError for a gap without a `reference`."""
    if not gate.require:
        return ()
    # Imported here and below: flights do not need statistics and figures.
    from airl_mav.flight.requirements import ACCEPTED, parse_requirement

    requirements = tuple(parse_requirement(text) for text in gate.require)
    for requirement in requirements:
        if requirement.gap and not reference:
            raise errors.FieldError(
                "require",
                str(requirement),
                f"a gap only with a reference, as in airl hardware-gap; {ACCEPTED}",
            )
    return requirements


def leave(gate: Gate, verdict: OverallVerdict, suite: str) -> None:
    """Write the requested files of the verdict; `suite` is the command."""
    from airl_mav.report.run_verdict import write_badge, write_junit

    if gate.junit is not None:
        write_junit(verdict, gate.junit, suite)
    if gate.badge is not None:
        write_badge(verdict, gate.badge)


class Viewing(fields.ProfileModel):
    """Live view of flights."""

    GROUP: ClassVar[str] = "output"
    view: Annotated[bool, fields.COMMON] = Field(
        default=False,
        description="show the flights in a browser while they fly, at an address that is printed"
        " (docs/how-to/view-and-export.md); in lockstep they fly in real time, or at --speed",
    )
    view_port: int | None = fields.quantity(
        "TCP port of that page on the loopback address; by default a free one",
        "1",
        ge=1,
        le=aircraft.GREATEST_PORT,
        default=None,
    )


def view_of(options: Viewing) -> ViewRequest | None:
    """Return the requested live view or None; UsageError for missing packages."""
    if not options.view:
        if options.view_port is not None:
            raise errors.FieldError(
                "view_port", options.view_port, problem="accepted: together with --view"
            )
        return None
    if not addons.entries("airl_mav", "VIEW"):
        raise errors.UsageError("--view: needs the add-on view (airl_mav/addons/view)")
    check_installed("view")
    return ViewRequest(options.view_port)


def folder_of(path: Path, ulg: Path | None = None) -> Path:
    """Return a run's folder, created from a black box and log if necessary, or UsageError."""
    if path.suffix != SUFFIX or path.is_dir():
        return path
    check_installed("black-box" if ulg is None else "identify")
    converter = addons.entries("airl_mav", "RECORDINGS").get(path.suffix)
    if converter is None:
        raise errors.UsageError(f"{path}: needs the add-on recordings (airl_mav/addons/recordings)")
    return Path(addons.load(converter)(path, ulg))


SCHEMA = 1
"""Version of the JSON lines; docs/reference/json-lines.md describes them."""


class Telling(fields.ProfileModel):
    """Output mode of a command."""

    GROUP: ClassVar[str] = "output"
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
class Started(progress.Event):
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
    % interval, `n`; `outcomes` counts the valid flights by outcome."""
    sha256: str | None
    """Digest of all flights in lockstep; None at other levels and for incomplete runs."""


@dataclass(frozen=True)
class Finished(progress.Event):
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
            raise errors.FieldError("quiet", True, problem="accepted: without --json")
        self._out = console or progress.new_console()
        self._json = progress.JsonProgress(self._out.file) if options.json_lines else None
        self._quiet = options.quiet
        self._command = command
        silent = options.quiet or options.json_lines
        self.console = progress.new_console(quiet=True) if silent else self._out
        """Console for text that only people read: remarks and tables."""
        self._drawn = None if silent else progress.RichProgress(self._out)
        self.progress: progress.Progress = self._drawn or self._json or _Errors()
        """Receiver of progress reports."""

    def __enter__(self) -> Voice:
        """Start drawing bars, or write the `started` event."""
        if self._drawn is not None:
            self._drawn.__enter__()
        if self._json is not None:
            now = clock.utc_now().isoformat(timespec="seconds")
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


class _Errors(progress.Progress):
    """Progress that prints only errors."""

    def note(self, text: str, style: str | None = None) -> None:
        """Print an error on standard error."""
        if style == "red":
            progress.new_console(stderr=True, soft_wrap=True).print(text, style=style)


NOTHING_REQUIRED = Gate()
FOR_PEOPLE = Telling()

COMMANDS = {"matrix": "airl evaluate"}
"""Kinds of comparisons whose command has another name."""


def episodes(description: str, default: int, least: int = 1) -> Any:
    """Return a field for a number of episodes."""
    return fields.quantity(description, "1", ge=least, le=model.GREATEST_EPISODES, default=default)


class ExperimentOptions(Telling, model.Flights, model.Lateness, model.Decisions, aircraft.Aircraft):
    """Options of all experiments; the default level is the fastest."""

    level: model.LevelName = Field(
        default="gym", description=model.Flights.model_fields["level"].description
    )


class OnboardOptions(Gate, ExperimentOptions):
    """Options for a policy on an onboard computer, compared with a reference."""

    GROUP: ClassVar[str] = "latency"
    computer: str = Field(
        default="",
        description="onboard computer: a shipped profile, or a path to a .toml; by default"
        f" {model.ONBOARD_COMPUTER}, or none with --latency: without mass and power",
    )
    reference: Annotated[str, fields.COMMON] = Field(
        default=model.REFERENCE_COMPUTER,
        description="computer that the onboard computer is compared with: a shipped profile, or a"
        " path",
    )
    reference_workload: str | None = Field(
        default=None,
        description="workload of the reference; default: the target's if the reference has it, else"
        " the one measured there with this policy, else 1 ms (gym, lockstep) or the time on this"
        " machine (sitl)",
    )

    @property
    def scenario(self) -> model.Scenario:
        """Scenario of the options; a latency without a named computer has no mass and power."""
        default = model.ONBOARD_COMPUTER if self.latency is None else self.reference
        return scenario_of(self, computer=self.computer or default)


def fly_and_show(
    experiment: Experiment,
    out: Path | None,
    console: Console | None,
    gate: Gate = NOTHING_REQUIRED,
    telling: Telling = FOR_PEOPLE,
) -> tuple[int, ExperimentRun]:
    """Fly the rest of an experiment and show it; return 0, 1, 3 to 5 or 130, and its runs."""
    # Imported here and below: options need no simulator, and flights need no figures.
    from airl_mav.experiments.experiment import run_experiment
    from airl_mav.experiments.live import EXIT_CODES

    voice = Voice(telling, COMMANDS.get(experiment.kind, f"airl {experiment.kind}"), console)
    requirements = requirements_of(gate)
    with voice:
        flown = run_experiment(experiment, out, voice.progress)
        code = EXIT_CODES[flown.ended]
        if len(flown.cells) < 2 and flown.ended != "complete":
            voice.finish(code, flown.ended, flown.path)
            return code, flown
        from airl_mav.report.comparison.show import judge_comparison, show_comparison

        comparison, loaded = flown.compare()
        verdict = judge_comparison(comparison, loaded, requirements)
        if flown.ended == "complete":
            leave(gate, verdict, f"airl {experiment.kind}")
            code = verdict.exit_code
        page = show_comparison(
            comparison, loaded, flown.path, voice.console, verdict, voice.progress
        )
        voice.finish(code, flown.ended, flown.path, verdict=verdict, page=page, runs=loaded)
    return code, flown

"""What all studies share: configuration, command line, campaign, and how it ends."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import tyro
from pydantic import Field
from rich.console import Console

from airl_mav.cli.cells import Cell, FlownCell, check_root, fly_cells
from airl_mav.cli.common import run_command
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import ProfileModel, quantity, validated
from airl_mav.core.files import read_json
from airl_mav.flight.statistics import Aggregate, aggregate
from airl_mav.latency.percentiles import Summary, summarize
from airl_mav.latency.stages import pool, stage_samples
from airl_mav.profiles.loading import load_profile
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report.document import print_document
from airl_mav.studies.findings import DATA_FILE, Findings, write_findings


class StudyConfig(ProfileModel):
    """What every study can be told."""

    description: str = Field(description="one line for people")
    episodes: int = quantity("episodes of a cell", "1", ge=1, le=100_000, default=1000)
    seed: int = quantity("first seed; episode i uses seed + i", "1", ge=0, le=2**31, default=1)
    level: Literal["gym", "lockstep", "sitl"] = Field(default="gym", description="fidelity")
    vehicle: str = Field(default="quad", description="vehicle profile")

    def command(self, policy: str, arena: str, **options: Any) -> EvaluateCommand:
        """Return the evaluation of a policy in an arena, by the study's rules unless given."""
        own: dict[str, Any] = {
            "episodes": self.episodes,
            "seed": self.seed,
            "level": self.level,
            "vehicle": self.vehicle,
        }
        return EvaluateCommand((policy,), arena=(arena,), **(own | options))


class FanConfig(ProfileModel):
    """Many flights to one goal in one arena: what differs is chance and latency alone."""

    arena_seed: int = quantity("seed of arena and goal", "1", ge=0, le=2**31)
    flights: int = quantity("flights of a panel", "1", ge=1, le=10_000, default=100)


Config = TypeVar("Config", bound=StudyConfig)


@dataclass(frozen=True)
class StudyCommand:
    """Fly what is left of a study and show what it found. The same --out goes on."""

    config: Path | None = None
    """Configuration. None: the .toml of the same name beside the script."""

    quick: bool = False
    """The smallest that is real: few episodes. A first look, and for tests."""

    episodes: int | None = None
    """Episodes of a cell, >= 1. None: as the configuration says."""

    out: Path | None = None
    """Folder of the study: a run folder for each cell, study.json, study.md, study.html and
    pictures. None: runs/studies/<name>, with --quick <name>-quick."""


@dataclass(frozen=True)
class Flown:
    """A cell with its run."""

    cell: Cell
    held: FlownCell
    run: LoadedRun

    @cached_property
    def quality(self) -> Aggregate:
        """The run in figures: worked out once, its intervals take a while."""
        return aggregate(self.run.episodes)

    @cached_property
    def t2(self) -> Summary:
        """The latencies t2 of its decisions [µs]."""
        return summarize(pool(stage_samples(a) for a in self.run.latency.values())["t2"])


@dataclass(frozen=True)
class Study(Generic[Config]):
    """A study: what it flies, and what it makes of it."""

    key: str
    model: type[Config]
    cells: Callable[[Config, Path], Sequence[Cell]]
    """The cells, given the study's folder."""
    findings: Callable[[Config, Mapping[str, Flown]], Findings]
    """What was found, given all cells by their key."""
    quick: Mapping[str, Any] = field(default_factory=dict)
    """What `--quick` changes in the configuration."""
    prepare: Callable[[Config, Path, Console], int] | None = None
    """What comes before the flights: returns an exit status, 0 to go on."""


def load_config(study: Study[Config], path: Path, changes: Mapping[str, Any]) -> Config:
    """Load a configuration with values put over it. Raises UsageError."""
    config = load_profile("studies", str(path), study.model)
    merged = _overlaid(config.model_dump(exclude_unset=True), changes)
    return validated(study.model, merged, path)


def _overlaid(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return one table put over another, table by table."""
    merged = dict(below)
    for key, value in above.items():
        under = merged.get(key)
        both = isinstance(under, Mapping) and isinstance(value, Mapping)
        merged[key] = _overlaid(under, value) if both else value  # type: ignore[arg-type]
    return merged


def run_study(
    study: Study[Config], command: StudyCommand, default: Path, console: Console | None = None
) -> int:
    """Fly what is left of a study and show what it found.

    Args:
        study: Which one.
        command: What was asked for.
        default: Its configuration where none is given.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 all is flown and shown, 1 a process died, 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console()
    changes: dict[str, Any] = dict(study.quick) if command.quick else {}
    if command.episodes is not None:
        changes["episodes"] = command.episodes
    config = load_config(study, command.config or default, changes)
    name = f"{study.key}-quick" if command.quick else study.key
    root = command.out or Path("runs") / "studies" / name
    check_root(root)
    _check_same_study(root, study.key)
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {root}: {error.strerror}") from None
    if study.prepare is not None and (code := study.prepare(config, root, console)):
        return code
    held, code = fly_cells(root, study.cells(config, root), console, reports=False)
    if code:
        return code
    runs: dict[str, LoadedRun] = {}
    for cell in held:
        if cell.folder not in runs:
            runs[cell.folder] = load(root / cell.folder)
    flown = {cell.cell.key: Flown(cell.cell, cell, runs[cell.folder]) for cell in held}
    findings = study.findings(config, flown)
    page = write_findings(findings, root, shlex.join(["python", *sys.argv]))
    print_document(findings.document, console, page)
    return 0


def _check_same_study(root: Path, key: str) -> None:
    """Raise UsageError for a folder that holds another study."""
    file = root / DATA_FILE
    held = read_json(file, None, "study").get("study") if file.exists() else key
    if held != key:
        raise UsageError(f"--out {root}: holds the study {held!r}; accepted: another folder")


def main(study: Study[Config], script: str) -> None:
    """Entry point of a study's script.

    Args:
        study: Which one.
        script: Path of the script: its configuration lies beside it.
    """
    command = tyro.cli(StudyCommand, description=sys.modules["__main__"].__doc__)
    run_command(lambda: run_study(study, command, Path(script).with_suffix(".toml")))

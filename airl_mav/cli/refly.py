"""`airl refly`: a recorded flight, rehearsed, and the two beside each other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core.clock import utc_now
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.report.comparison.runs import compare_folders
from airl_mav.report.comparison.show import show_comparison
from airl_mav.scenario.model import GREATEST_SEED


class ReflyOptions(ProfileModel):
    """Rehearse a flight that `airl-companion --black-box` has recorded, and compare the two.

    The same policy flies to the same goal in lockstep, with the decision latencies of the flight.
    Where the flight is none like its rehearsals, the aircraft is not the vehicle profile, or the
    world not the arena.

    Examples:
        airl refly flights/20261123T172437.230467Z.mcap
        airl refly flights/20261123T172437.230467Z.mcap --arena yard.toml
    """

    flight: Annotated[Path, POSITIONAL] = Field(description="black box of a flight (.mcap)")
    arena: str | None = Field(
        default=None,
        description="arena profile with what stood where it flew: a shipped name, or a path to a"
        " .toml; by default an empty plain",
    )
    arena_seed: int | None = quantity(
        "seed of the arena; by default that of the flight",
        "1",
        ge=0,
        le=GREATEST_SEED,
        default=None,
    )
    episodes: int = quantity(
        "rehearsals, each with the noise of other sensors", "1", ge=1, le=1000, default=20
    )
    policy: str | None = Field(
        default=None,
        description="policy to rehearse: a name, or a path; by default the one that flew, where it"
        " lay then",
    )
    trust: bool = Field(default=False, description="run code that the policy or the arena names")
    out: Path | None = Field(
        default=None,
        description="folder of the comparison, with both runs in it; by default"
        " runs/<UTC time>-refly",
    )


OPTIONS = ReflyOptions


def run(options: ReflyOptions, console: Console | None = None) -> int:
    """Rehearse the flight. Returns exit status 0; raises UsageError as `refly` does."""
    console = console or Console()
    check_installed("black-box", "sim")
    # Imported here: MCAP is an extra.
    from airl_mav.experiments.refly import FLOWN, REHEARSED, refly

    out = options.out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-refly"
    found = refly(
        options.flight,
        out,
        arena=options.arena,
        arena_seed=options.arena_seed,
        episodes=options.episodes,
        policy=options.policy,
        trust=options.trust,
        progress=True,
    )
    comparison, runs = compare_folders([out / REHEARSED, out / FLOWN], (REHEARSED, FLOWN))
    show_comparison(comparison, runs, out, console)
    console.print()
    for sentence in found.sentences:
        console.print(sentence, markup=False)
    return 0

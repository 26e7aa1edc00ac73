"""Rehearsals beside busy processes: disturbed flights must be neither counted nor dropped.

    python scripts/validity_under_load.py --runs 20 --episodes 5 --busy 8 --speed 4

Flies runs of `airl-sitl`, each on separate seeds, while other processes keep all cores busy;
additional options are passed on. A run keeps the rule if it exits with 0 and all its flights are
present and valid, or exits with another status and reports the reason: 4 names every flight that
stayed invalid, 1 the loss. Prints a line for each run; exit status 0 if all keep the rule. The busy
processes always end with this one.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from lockstep_reruns import busy
from rich.table import Table

from airl_mav import load_run
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INVALID
from airl_mav.core.progress import new_console
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import Estimate
from airl_mav.rehearsal.run_folder import RUN_FILE


@dataclass(frozen=True)
class UnderLoad:
    """Rehearse beside busy processes, and check that no disturbed flight is counted or dropped."""

    runs: int = 20
    """Runs of airl-sitl, one after the other."""

    episodes: int = 5
    """Flights of each."""

    busy: int = 8
    """Number of parallel busy processes."""

    speed: float = 4.0
    """Simulated seconds per wall second."""

    out: Path = Path("runs/validity-under-load")
    """Folder of the run folders; a new one."""


def main() -> int:
    asked, more = tyro.cli(UnderLoad, return_unknown_args=True)
    if asked.out.exists():
        sys.exit(f"--out {asked.out}: accepted: a new folder")
    table = Table(
        *("run", "exit", "valid", "flown again", "aborted", "invalid, and why", "breaks the rule"),
        show_lines=True,
    )
    broken = 0
    with busy(asked.busy):
        for number in range(asked.runs):
            row, wrong = rehearse(asked, number, more)
            table.add_row(f"{number}", *row, wrong)
            broken += bool(wrong)
    console = new_console()
    console.print(table)
    console.print(f"{asked.runs - broken} of {asked.runs} runs keep the rule", highlight=False)
    return 1 if broken else 0


def rehearse(asked: UnderLoad, number: int, more: Sequence[str]) -> tuple[list[str], str]:
    """Fly a run; return its table row, and its violation of the rule."""
    out, seed = asked.out / f"{number:02d}", 1 + number * asked.episodes
    words = [sys.executable, "-m", "airl_mav.cli.sitl_command", f"--episodes={asked.episodes}"]
    words += [f"--seed={seed}", f"--speed={asked.speed}", f"--out={out}", *more]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    if not (out / RUN_FILE).exists():
        return [f"{done.returncode}", "", "", "", said.strip()], "nothing was flown"
    run = load_run(out)
    flown = run.episodes
    again = sum(note.startswith("flown again") for each in flown for note in each.notes)
    aborted = sum(each.outcome is Outcome.ABORTED for each in flown)
    faults = [f"{each.index}: {'; '.join(each.invalid)}" for each in flown if each.invalid]
    valid = len(flown) - len(faults)
    row = [f"{done.returncode}", f"{valid}", f"{again}", f"{aborted}", "\n".join(faults)]
    return row, problem(done.returncode, said, flown, asked.episodes, run.quality.success_rate)


def problem(
    code: int, said: str, flown: Sequence[EpisodeRecord], episodes: int, rate: Estimate
) -> str:
    """Return the violation of the rule; empty: none."""
    invalid = [each for each in flown if each.invalid]
    # The terminal's lines are wrapped.
    said = " ".join(said.split())
    if rate.n != len(flown) - len(invalid):
        return f"{rate.n} flights are counted, {len(flown) - len(invalid)} are valid"
    if code == EXIT_BROKEN:
        return "" if "broken off:" in said else "it does not say what was lost"
    if [each.index for each in flown] != list(range(episodes)):
        return f"{len(flown)} of {episodes} flights are there"
    if code not in (0, EXIT_INVALID):
        return f"exit status {code}"
    if (code == EXIT_INVALID) != bool(invalid):
        return f"exit status {code} with {len(invalid)} invalid flights"
    unsaid = [each.index for each in invalid if f"INVALID: flight {each.index:03d}" not in said]
    return f"flights {unsaid} are not said to be invalid" if unsaid else ""


if __name__ == "__main__":
    sys.exit(main())

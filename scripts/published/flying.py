"""Repetition of outdated results. A killed run resumes: each command has a separate folder."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from airl_mav.core.errors import EXIT_INTERRUPTED, EXIT_NOT_MET, EXIT_USAGE, UsageError
from published.behaviour import Difference, differences, fly_behaviour, read_behaviour
from published.collect import collect
from published.declared import Declared
from published.record import (
    RESULTS,
    ROOT,
    behaviour_today,
    file_of,
    out_of_date,
    read_record,
    write_record,
)

RUNS = ROOT / "runs" / "results"
"""Root of output folders, separate for every fingerprint, so that no run mixes two codes."""


def why_out_of_date(declared: Declared, folder: Path = RESULTS) -> str:
    """Return the reason to repeat a result; empty: up to date. Raises UsageError."""
    if not file_of(declared.name, folder).exists():
        return "Not flown yet."
    record = read_record(declared.name, folder)
    if record.made.command != declared.command:
        return f"Flown by another command: {record.made.command}"
    return out_of_date(record)


def behaviour_differs(path: Path) -> tuple[Difference, ...]:
    """Fly the flights of the fingerprint and return the differences from the stored ones."""
    return differences(read_behaviour(path), fly_behaviour())


def fly_result(declared: Declared, *, quick: bool) -> Path:
    """Fly a result and write its file; return the path.

    A quick one has few flights, is written beside its runs, and is never published.

    Raises:
        UsageError: Its command failed, or wrote other output.
        KeyboardInterrupt: Ctrl-C; finished flights are kept.
    """
    out = RUNS / f"{declared.name}-{behaviour_today()}{'-quick' if quick else ''}"
    words = [*_program(declared.command), *(shlex.split(declared.quick) if quick else ())]
    # Use the checkout's package instead of an installed version.
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*words, "--out", str(out)], cwd=ROOT, env=environment, check=False
    ).returncode
    if done == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    # Flights with undocumented results are also a result: the table marks them.
    if done and not (declared.kind == "faults" and done == EXIT_NOT_MET):
        hint = f"; {out} may hold other code's flights" if done == EXIT_USAGE else ""
        raise UsageError(f"{declared.name}: {declared.command}: exit status {done}{hint}")
    if quick:
        return write_record(collect(declared, out, behaviour_today()), RUNS / "quick")
    return take_result(declared, out, behaviour_today())


def take_result(declared: Declared, out: Path, behaviour: str | None, root: Path = ROOT) -> Path:
    """Write the file of a result from a folder, and its pictures; return the file.

    Args:
        declared: Declaration of the result.
        out: Output folder of its command.
        behaviour: Behaviour fingerprint of the code that flew it.
        root: Checkout with the results and pages.

    Raises:
        UsageError: The folder does not contain it, or lacks flights.
    """
    record = collect(declared, out, behaviour)
    for picture in declared.pictures:
        if not (out / picture).is_file():
            raise UsageError(f"{declared.name}: pictures: {picture}: accepted: a file of {out}")
    for picture, page in declared.pictures.items():
        shutil.copyfile(out / picture, root / page)
    return write_record(record, root / RESULTS.relative_to(ROOT))


def _program(command: str) -> Sequence[str]:
    """Return a command for this interpreter. Raises UsageError for another program."""
    program, *rest = shlex.split(command)
    if program == "airl":
        return sys.executable, "-m", "airl_mav.cli.main", *rest
    if program == "python":
        return sys.executable, *rest
    raise UsageError(f"command: {command}: accepted: airl ..., python scripts/...")

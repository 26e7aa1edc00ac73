"""Flying again what is out of date. A killed run goes on: each command has a folder of its own."""

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
"""Where commands fly; every fingerprint has folders of its own, so that no run mixes two codes."""


def why_out_of_date(declared: Declared, folder: Path = RESULTS) -> str:
    """Return why a result must be flown again; empty: it need not be. Raises UsageError."""
    if not file_of(declared.name, folder).exists():
        return "Not flown yet."
    record = read_record(declared.name, folder)
    if record.made.command != declared.command:
        return f"Flown by another command: {record.made.command}"
    return out_of_date(record)


def behaviour_differs(path: Path) -> tuple[Difference, ...]:
    """Fly the flights of the fingerprint and return those that are not as written down."""
    return differences(read_behaviour(path), fly_behaviour())


def fly_result(declared: Declared, *, quick: bool) -> Path:
    """Fly a result and write its file; return it.

    A quick one has few flights, is written beside its runs, and is never published.

    Raises:
        UsageError: Its command failed, or left something else.
        KeyboardInterrupt: Ctrl-C; what was flown is kept.
    """
    out = RUNS / f"{declared.name}-{behaviour_today()}{'-quick' if quick else ''}"
    words = [*_program(declared.command), *(shlex.split(declared.quick) if quick else ())]
    # The checkout's own package, whatever is installed.
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*words, "--out", str(out)], cwd=ROOT, env=environment, check=False
    ).returncode
    if done == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    # Flights that end otherwise than documented are a result, too: the table marks them.
    if done and not (declared.kind == "faults" and done == EXIT_NOT_MET):
        hint = f"; {out} may hold other code's flights" if done == EXIT_USAGE else ""
        raise UsageError(f"{declared.name}: {declared.command}: exit status {done}{hint}")
    if quick:
        return write_record(collect(declared, out, behaviour_today()), RUNS / "quick")
    return take_result(declared, out, behaviour_today())


def take_result(declared: Declared, out: Path, behaviour: str | None, root: Path = ROOT) -> Path:
    """Write the file of a result that lies in a folder, and its pictures; return the file.

    Args:
        declared: What it is.
        out: Where its command has flown.
        behaviour: Fingerprint of the flight behaviour of the code that flew it.
        root: Checkout whose results and pages these are.

    Raises:
        UsageError: The folder does not hold it, or its flights are not all there.
    """
    record = collect(declared, out, behaviour)
    for picture in declared.pictures:
        if not (out / picture).is_file():
            raise UsageError(f"{declared.name}: pictures: {picture}: accepted: a file of {out}")
    for picture, page in declared.pictures.items():
        shutil.copyfile(out / picture, root / page)
    return write_record(record, root / RESULTS.relative_to(ROOT))


def _program(command: str) -> Sequence[str]:
    """Return a command as this interpreter runs it. Raises UsageError for another program."""
    program, *rest = shlex.split(command)
    if program == "airl":
        return sys.executable, "-m", "airl_mav.cli.main", *rest
    if program == "python":
        return sys.executable, *rest
    raise UsageError(f"command: {command}: accepted: airl ..., python scripts/...")

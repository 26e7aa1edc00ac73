"""What `airl report` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class ReportCommand:
    """Print the tables of a run or a ladder and write its page and pictures again; or compare runs.

    Two or more are compared: what differs in what was flown, quality of flight with intervals,
    paired differences on shared seeds, latencies, paths, energy. The first is the reference.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, as airl-sitl or airl evaluate left it, or folder of a ladder or of a table of
    policies x arenas."""

    others: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[RUN ...]")
    ] = ()
    """Runs to compare with the first."""

    names: tuple[str, ...] = ()
    """What compared runs are called, in their order. None given: what tells them apart."""

    out: Path | None = None
    """Folder of a comparison: compare.html, compare.json and pictures. None: runs/<UTC
    time>-compare. A report goes into its run's own folder."""

"""Campaign folders: resumable evaluations or trainings that belong together.

    campaign.json   the declaration: cells, comparisons, settings
    <cell>/         run folder of an evaluation, or training folder of a trial

The declaration is written first and atomically. Progress is derived from the cells' folders.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_typed, write_json
from airl_mav.core.machine import provenance
from airl_mav.rehearsal.run_folder import CAMPAIGN_FILE, another_config, check_folder, locked

SCHEMA = 1


@dataclass(frozen=True)
class DeclaredCell:
    """One evaluation or one training trial."""

    title: str
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the flights or the training, which identify the cell."""
    folder: str | None = None
    """Cell with the same flights, whose folder is shared; None = a separate folder."""
    role: str = ""
    """Role in the comparison: `reference`, `target`, a latency, a level."""
    group: str = ""
    """Group of cells that are compared with each other."""


@dataclass(frozen=True)
class Declaration:
    """Contents of a campaign."""

    kind: str
    """Kind of experiment: gap, ladder, sweep, ..."""
    settings: dict[str, Any]
    cells: dict[str, DeclaredCell]
    """Cells by name, which is the name of the cell's folder."""

    def __post_init__(self) -> None:
        """Raise ValueError for a cell name that is not a valid folder name."""
        for name in self.cells:
            if Path(name).name != name or name in ("", "..", CAMPAIGN_FILE):
                raise ValueError(f"cell {name!r}: accepted: the name of a folder")


@dataclass(frozen=True)
class Campaign:
    """Content of `campaign.json`."""

    declaration: Declaration
    made: dict[str, Any]
    """Provenance at creation: `created_utc`, `command`, `versions`, `machine`, `git`."""
    schema: int = SCHEMA


_CAMPAIGN = TypeAdapter(Campaign)


def load_campaign(path: Path) -> Campaign:
    """Read the declaration of the campaign in a folder. Raises UsageError."""
    return read_typed(path / CAMPAIGN_FILE, _CAMPAIGN, SCHEMA, "campaign")


@dataclass(frozen=True)
class CampaignStore:
    """Campaign on disk. Sent to other processes by pickle."""

    path: Path
    campaign: Campaign

    def cell_path(self, name: str) -> Path:
        """Return the folder of a cell."""
        return self.path / name


@contextmanager
def open_campaign(
    path: Path,
    declaration: Declaration,
    *,
    command: str,
    free: Collection[str] = (),
    growing: Collection[str] = (),
    say: Callable[[str], None] = lambda _: None,
) -> Iterator[CampaignStore]:
    """Open and lock a campaign's folder, new or to resume; cells may be added or left for later.

    Settings in `free`, or in tables named there, may differ on resumption. Numeric cell settings in
    `growing` may grow. `say` is called when another process has locked the folder. Raises
    UsageError for other content or changed settings.
    """
    path = path.absolute()
    with locked(path, say):
        yield CampaignStore(path, _declare(path, declaration, command, free, growing))


def _declare(
    path: Path,
    declaration: Declaration,
    command: str,
    free: Collection[str],
    growing: Collection[str],
) -> Campaign:
    """Write the declaration; raise UsageError if it contradicts an existing one."""
    check_folder(path, CAMPAIGN_FILE)
    if not (path / CAMPAIGN_FILE).exists():
        campaign = Campaign(declaration, provenance(command))
    else:
        held = load_campaign(path)
        if difference := _difference(held.declaration, declaration, free, growing):
            raise UsageError(
                f"--out {path}: holds a campaign with {difference}; accepted: another folder, or "
                "the same settings to go on"
            )
        campaign = Campaign(declaration, held.made)
        if campaign == held:
            return held
    write_json(path / CAMPAIGN_FILE, asdict(campaign))
    return campaign


def _difference(
    held: Declaration, asked: Declaration, free: Collection[str], growing: Collection[str]
) -> str | None:
    """Return a description of the first difference, or None."""
    if held.kind != asked.kind:
        return f"kind = {held.kind!r}, not {asked.kind!r}"
    if difference := another_config(held.settings, asked.settings, free):
        return difference
    for name, cell in asked.cells.items():
        if (theirs := held.cells.get(name)) is None:
            continue
        old, new = theirs.settings, cell.settings
        grown = {each for each in growing if old.get(each, 0) < new.get(each, 0)}
        if difference := another_config(old, new, {*free, *grown}):
            return f"another cell {name}: {difference}"
    return None

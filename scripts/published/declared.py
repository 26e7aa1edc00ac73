"""Declarations of published results: `results/results.toml`, one entry for each."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Literal

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from pydantic import Field, model_validator

from airl_mav.core.errors import UsageError
from airl_mav.core.fields import ProfileModel, validated
from airl_mav.training.config import check_seeds
from published.record import RESULTS

DECLARED_FILE = RESULTS / "results.toml"

Kind = Literal[
    "hardware-gap",
    "matrix",
    "compare-levels",
    "latency-sweep",
    "compare",
    "run",
    "faults",
    "roofline",
    "sweep",
    "table",
]


class Declared(ProfileModel):
    """Declaration of a result: its command, and the location of its figures in the output."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", description="of results/<name>.json")
    what: str = Field(description="one line for people")
    command: str = Field(description="as a person types it; --out is added")
    quick: str = Field(
        default="--episodes 20", description="arguments that --quick adds to the command"
    )
    kind: Kind = Field(
        description="file of the comparison; run: the folder is a single run; the others: a table"
    )
    within: tuple[str, ...] = Field(default=(".",), description="folders of comparisons, in --out")
    pictures: dict[str, str] = Field(
        default={}, description="pictures of the pages, path from the root by file in --out"
    )
    cards: bool = Field(default=False, description="its runs go onto the cards of their policies")
    minutes: float = Field(gt=0, description="on two cores, about")

    @model_validator(mode="after")
    def _seeds_are_not_held_out(self) -> Declared:
        # Checked before the flights, which take hours. The runs of a result are checked again.
        for option, seed in re.findall(r"--((?:arena-)?seed)[ ='\"]+([\d_]+)", self.command):
            check_seeds(int(seed), field=f"{self.name}: --{option}")
        return self


def read_declared(path: Path = DECLARED_FILE) -> dict[str, Declared]:
    """Return the declared results, by name, in order. Raises UsageError."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"{path}: {error}") from None
    entries = [validated(Declared, entry, path) for entry in data.get("result", ())]
    names = [entry.name for entry in entries]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"{path}: result {name}: accepted: each name once")
    return {entry.name: entry for entry in entries}

"""`airl export`: turn a Stable-Baselines3 model into a policy that flies."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL
from airl_mav.policy.card import CARD_FILE, ONNX_FILE
from airl_mav.training.export_request import ExportRequest


class ExportOptions(ExportRequest):
    """Export a Stable-Baselines3 .zip to ONNX with a policy card.

    The model must take a Dict of `depth` (uint8), `velocity` and `goal`, as `--layout` and
    `--image` say, and give the actions of `--actions`. What a VecNormalize around the training
    environment did is not in the .zip: such models do not fly right. A .zip holds pickled Python
    objects: export only those of people you trust.

    Examples:
        airl export model.zip --algorithm PPO --out policies/mine --image 32x24 --actions arc-25
    """

    model: Annotated[Path, POSITIONAL] = Field(
        description=ExportRequest.model_fields["model"].description
    )


OPTIONS = ExportOptions
RENAMED_OPTIONS = {
    "--fov": ("--horizontal-fov-deg",),
    "--range": ("--range-m",),
    "--max-speed": ("--max-speed-m-s",),
    "--hold": ("--hold-s",),
    "--goal-radius": ("--goal-radius-m",),
    "--altitude": ("--altitude-m",),
    "--hover-after": ("--hover-after-s",),
}
EXTRAS = ("train",)


def run(options: ExportOptions, console: Console | None = None) -> int:
    """Export, and print what was written. Raises UsageError as `airl_mav.training.export.export`.

    Nothing was written then.
    """
    console = console or Console()
    facts = options.facts(shlex.join(["airl", *sys.argv[1:]]))
    # Imported late: torch takes seconds, and a wrong option is found without it.
    from airl_mav.training.export import export

    card = export(
        options.model, options.algorithm, facts, options.out, with_torch=options.with_torch
    )
    for line in (
        f"{options.out / ONNX_FILE}  {card.network}",
        f"{options.out / CARD_FILE}  {card.parameters:,} parameters, "
        f"{card.macs:,} multiply-accumulates, SHA-256 {card.sha256[:12]}...",
    ):
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    return 0

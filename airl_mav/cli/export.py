"""`airl export`: turn a trained model into a policy that flies."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL
from airl_mav.core.errors import FieldError
from airl_mav.experiments.quantisation import export_int8
from airl_mav.policy.card import CARD_FILE, ONNX_FILE, PolicyCard
from airl_mav.policy.registry import find_policy
from airl_mav.training.export_request import ExportRequest


class ExportOptions(ExportRequest):
    """Export a stable-baselines3 .zip, or a torch module of your own, to ONNX with a policy card.

    The model must take a Dict of `depth` (uint8), `velocity` and `goal`, as `--layout` and
    `--image` say, and give the actions of `--actions`; a module of your own may take the three as
    arguments. What a VecNormalize around the training environment did is not in a .zip: such models
    do not fly right. A .zip holds pickled Python objects, and a module is code: export only those
    of people you trust.

    Examples:
        airl export model.zip --algorithm PPO --out policies/mine
        airl export mypackage.nets:make_net --weights net.pt --like my.toml --out policies/mine
        airl export static-obstacles --int8 --out policies/static-obstacles-int8
    """

    model: Annotated[str, POSITIONAL] = Field(
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
    card = _export_int8(options) if options.int8 else _export(options)
    for line in (
        f"{options.out / ONNX_FILE}  {card.network}",
        f"{options.out / CARD_FILE}  {card.parameters:,} parameters, "
        f"{card.macs:,} multiply-accumulates, SHA-256 {card.sha256[:12]}...",
    ):
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    if (made := card.quantisation) is not None:
        same = "" if made.agreement is None else f"{100.0 * made.agreement:.1f} % of actions same, "
        console.print(
            f"8-bit integers: {same}outputs off by {100.0 * made.error:.1f} % of their spread, on "
            f"{made.checked} frames; airl evaluate and airl profile say what that does in flight",
            soft_wrap=True,
            highlight=False,
        )
    return 0


def _export(options: ExportOptions) -> PolicyCard:
    """Export a model in floats."""
    command = shlex.join(["airl", *sys.argv[1:]])
    options.facts(command)
    # Imported late: torch takes seconds, and a wrong option is found without it.
    from airl_mav.training.export import export

    return export(options, command)


def _export_int8(options: ExportOptions) -> PolicyCard:
    """Export a model, or take a policy that is there, and write it in 8-bit integers."""
    if options.with_torch:
        raise FieldError("with_torch", problem="not with --int8: policy.pt2 would be in floats")
    name = options.policy_name
    if options.own_module or Path(options.model).is_file():
        with TemporaryDirectory(prefix="airl-export-") as scratch:
            folder = Path(scratch) / name
            _export(options.model_copy(update={"out": folder}))
            return export_int8(folder, options.out, name=name)
    found = find_policy(options.model)
    if found.folder is None:
        raise FieldError("model", options.model, f"a learned policy; {found.name} has no network")
    return export_int8(found.folder, options.out, name=name)

"""`airl export`: convert a trained model to a policy."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL
from airl_mav.core.addons import load_entry
from airl_mav.core.errors import FieldError
from airl_mav.core.files import scratch_folder
from airl_mav.core.progress import new_console
from airl_mav.policy import card_writing, registry
from airl_mav.policy.card import CARD_FILE, ONNX_FILE, PolicyCard
from airl_mav.training.export_request import FLOWN, ExportRequest


class ExportOptions(ExportRequest):
    """Export a stable-baselines3 .zip or a custom torch module to ONNX with a policy card.

    The model must take a Dict of the image (`depth`, `rgb` or `grey`, uint8), `velocity` and
    `goal`, as set by `--layout`, `--image` and `--kind`, and return the actions of `--actions`. A
    custom module may take the three as arguments. A .zip does not contain the statistics of a
    VecNormalize wrapper. Pass its file with --vec-normalize, or the exported policy gets wrong
    inputs. Both files contain pickled Python objects, which can run any code: they require
    --trust. A module is code, too.

    Examples:
        airl export model.zip --trust --algorithm PPO --out policies/mine
        airl export mypackage.nets:make_net --weights net.pt --like my.toml --out policies/mine
        airl export static-obstacles --int8 --out policies/static-obstacles-int8
        airl export crowded --decisions pipelined --out policies/crowded-pipelined
    """

    model: Annotated[str, POSITIONAL] = Field(
        description=ExportRequest.model_fields["model"].description
    )


OPTIONS = ExportOptions
EXTRAS = ("train",)

CHANGED = ("description", "decisions", *FLOWN)
"""Settings that may change when an existing policy is copied."""


def run(options: ExportOptions, console: Console | None = None) -> int:
    """Export a policy and print its files; raises as `airl_mav.training.export.export`."""
    console = console or new_console()
    if options.int8:
        card = _export_int8(options)
    elif (
        options.own_module
        or options.algorithm is not None
        or options.model.endswith(".zip")
        or Path(options.model).is_file()
    ):
        card = _export(options)
    else:
        card = _copy(options)
    for line in (
        f"{options.out / ONNX_FILE}  {card.network}",
        f"{options.out / CARD_FILE}  {card.parameters:,} parameters, "
        f"{card.macs:,} multiply-accumulates, SHA-256 {card.sha256[:12]}...",
    ):
        console.print(line, soft_wrap=True, highlight=False)
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
    command = shlex.join(["airl", *sys.argv[1:]])
    options.facts(command)
    # Imported late: torch takes seconds, and option errors are found without it.
    from airl_mav.training.export import export

    return export(options, command)


def _copy(options: ExportOptions) -> PolicyCard:
    given = options.model_dump(exclude_defaults=True)
    changes = {name: given[name] for name in CHANGED if name in given}
    if other := sorted(given.keys() - {"model", "out", "name", "trust", *CHANGED}):
        accepted = ", ".join(CHANGED)
        raise FieldError(other[0], given[other[0]], f"of a policy that is there: {accepted}")
    return card_writing.copy_policy(
        _policy_folder(options),
        options.out,
        changes | {"name": options.policy_name},
        trust=options.trust,
    )


def _policy_folder(options: ExportOptions) -> Path:
    """Return the folder of the learned policy given as the model. Raises UsageError."""
    found = registry.find_policy(options.model, trust=options.trust)
    if found.folder is None:
        raise FieldError("model", options.model, f"a learned policy; {found.name} has no network")
    return found.folder


def _export_int8(options: ExportOptions) -> PolicyCard:
    """Export a model or use an existing policy, and write the policy in 8-bit integers."""
    if options.with_torch:
        raise FieldError("with_torch", problem="not with --int8: policy.pt2 would be in floats")
    name = options.policy_name
    write: Callable[..., PolicyCard] = load_entry(
        "airl_mav", "EXPORTS", "int8", ("int8", True), "int8"
    )
    if options.own_module or Path(options.model).is_file():
        with scratch_folder("airl-export-") as scratch:
            folder = scratch / name
            _export(options.model_copy(update={"out": folder}))
            return write(folder, options.out, name=name)
    return write(_policy_folder(options), options.out, name=name)

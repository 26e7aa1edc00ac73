"""`airl export`: turn a Stable-Baselines3 model into a policy that flies."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import validated
from airl_mav.core.provenance import package_versions
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.policy.action_sets import PAPER_SPEED_M_S, ActionSetName, ActionSpec
from airl_mav.policy.card import CARD_FILE, ONNX_FILE, PolicyFacts, Training
from airl_mav.policy.layouts import LayoutName, ObservationSpec
from airl_mav.scenario.model import PilotSettings


class ExportOptions(BaseModel):
    """Export a Stable-Baselines3 .zip to ONNX with a policy card.

    The model must take a Dict of `depth` (uint8), `velocity` and `goal`, as `--layout` and
    `--image` say, and give the actions of `--actions`. What a VecNormalize around the training
    environment did is not in the .zip: such models do not fly right. A .zip holds pickled Python
    objects: export only those of people you trust.

    Examples:
        airl export model.zip --algorithm PPO --out policies/mine --image 32x24 --actions arc-25
    """

    model: Annotated[Path, POSITIONAL] = Field(description="the .zip that the model's `save` wrote")
    algorithm: str = Field(
        description="class that wrote it, of stable-baselines3 or sb3-contrib: DQN, PPO, A2C, ..."
    )
    out: Path = Field(description="folder to write policy.onnx and card.json to")
    name: str | None = Field(
        default=None, description="short name of the policy; by default that of the folder"
    )
    description: str = Field(default="", description="one line about the policy")
    layout: LayoutName = Field(
        default="body", description="observation layout that the model was trained with"
    )
    image: str = Field(
        default="32x24",
        description="width x height of the image that the network sees, px; `paper`: with its"
        " strip",
    )
    horizontal_fov_deg: float = Field(
        default=90.0, description="horizontal field of view of the camera, deg"
    )
    range_m: float = Field(default=20.0, description="depth from which on everything looks far, m")
    actions: ActionSetName = Field(
        default="arc-25", description="action set that the model was trained with"
    )
    max_speed_m_s: float = Field(default=PAPER_SPEED_M_S, description="fastest action, m/s")
    hold_s: float = Field(
        default=PilotSettings.hold_s,
        description="t3: how long an action is held before the next observation, s",
    )
    goal_radius_m: float = Field(default=GOAL_RADIUS_M, description="radius of the goal, m")
    altitude_m: float = Field(
        default=PilotSettings.altitude_m, description="height above the start that is flown, m"
    )
    hover_after_s: float | None = Field(
        default=None,
        description="age of a command at which the vehicle hovered in training, s; by default the"
        " last one flew on",
    )
    epsilon: float = Field(
        default=0.0,
        description="share of random actions in flight, 0 to 1; discrete action sets only",
    )
    with_torch: bool = Field(
        default=False, description="also write policy.pt2, for the torch runtime"
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
    facts = _facts(options)
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


def _facts(options: ExportOptions) -> PolicyFacts:
    """Return what the options say about the policy. Raises UsageError."""
    size = re.fullmatch(r"(\d{1,4})x(\d{1,4})", options.image)
    if size is None:
        raise FieldError("image", options.image, "WIDTHxHEIGHT in px, as 32x24")
    image = {"layout": options.layout, "width_px": int(size[1]), "height_px": int(size[2])}
    camera = options.model_dump(include={"horizontal_fov_deg", "range_m"})
    speed = {"set": options.actions, "max_speed_m_s": options.max_speed_m_s}
    facts = options.model_dump(
        include={"description", "hold_s", "goal_radius_m", "altitude_m", "hover_after_s"}
        | {"algorithm", "epsilon"}
    ) | {
        "name": options.name if options.name is not None else options.out.resolve().name,
        "observation": _observation(options.image, image | camera),
        "actions": validated(ActionSpec, speed),
        "training": Training(
            command=shlex.join(["airl", *sys.argv[1:]]),
            versions=package_versions(),
            date_utc=utc_now().isoformat(timespec="seconds"),
        ),
    }
    return validated(PolicyFacts, facts)


def _observation(image: str, data: dict[str, object]) -> ObservationSpec:
    """Return what the network sees. Raises FieldError that names the options."""
    try:
        return validated(ObservationSpec, data)
    except FieldError as error:
        if error.field in ("width_px", "height_px"):
            raise FieldError("image", image, problem=error.line()) from None
        raise

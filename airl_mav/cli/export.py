"""`airl export`: turn a Stable-Baselines3 model into a policy that flies."""

from __future__ import annotations

import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from pydantic import BaseModel, ValidationError
from rich.console import Console

from airl_mav.cli.common import check_train_installed
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.core.provenance import package_versions
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.policy.action_sets import PAPER_SPEED_M_S, ActionSetName, ActionSpec
from airl_mav.policy.card import CARD_FILE, ONNX_FILE, PolicyFacts, Training
from airl_mav.policy.layouts import LayoutName, ObservationSpec
from airl_mav.profiles.loading import explain
from companion.pilot import PilotSettings

M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True)
class Export:
    """Export a Stable-Baselines3 .zip to ONNX with a policy card.

    The model must take a Dict of `depth` (uint8), `velocity` and `goal`, as `--layout` and
    `--image` say, and give the actions of `--actions`. What a VecNormalize around the training
    environment did is not in the .zip: such models do not fly right. A .zip holds pickled Python
    objects: export only those of people you trust.

    Examples:
      airl export model.zip --algorithm PPO --out policies/mine --image 32x24 --actions arc-25
    """

    model: tyro.conf.Positional[Path]
    """The .zip that the model's `save` wrote."""

    algorithm: str
    """Class that wrote it, of stable-baselines3 or sb3-contrib: DQN, PPO, A2C, SAC, TD3, ..."""

    out: Path
    """Folder to write policy.onnx and card.json to."""

    name: str | None = None
    """Short name of the policy. None: that of the folder."""

    description: str = ""
    """One line about the policy."""

    layout: LayoutName = "body"
    """Observation layout that the model was trained with."""

    image: str = "32x24"
    """Width x height of the image that the network sees, px; `paper`: with its strip."""

    fov: float = 90.0
    """Horizontal field of view of the camera, deg."""

    range_m: Annotated[float, tyro.conf.arg(name="range")] = 20.0
    """Depth from which on everything looks far, m."""

    actions: ActionSetName = "arc-25"
    """Action set that the model was trained with."""

    max_speed: float = PAPER_SPEED_M_S
    """Fastest action, m/s."""

    hold: float = PilotSettings.hold_s
    """t3: how long an action is held before the next observation, s."""

    goal_radius: float = GOAL_RADIUS_M
    """Radius of the goal, m."""

    altitude: float = PilotSettings.altitude_m
    """Height above the start that is flown, m."""

    hover_after: float | None = None
    """Age of a command at which the vehicle hovered in training, s. None: the last one flew on."""

    epsilon: float = 0.0
    """Share of random actions in flight, 0 to 1; discrete action sets only."""

    with_torch: bool = False
    """Also write policy.pt2, for the torch runtime."""


def run(command: Export, console: Console | None = None) -> int:
    """Export, and print what was written. Raises UsageError as `airl_mav.training.export.export`.

    Nothing was written then.
    """
    console = console or Console()
    check_train_installed()
    facts = _facts(command)
    # Imported late: torch takes seconds, and a wrong option is found without it.
    from airl_mav.training.export import export

    card = export(
        command.model, command.algorithm, facts, command.out, with_torch=command.with_torch
    )
    for line in (
        f"{command.out / ONNX_FILE}  {card.network}",
        f"{command.out / CARD_FILE}  {card.parameters:,} parameters, "
        f"{card.macs:,} multiply-accumulates, SHA-256 {card.sha256[:12]}...",
    ):
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    return 0


def _facts(command: Export) -> PolicyFacts:
    """Return what the options say about the policy. Raises UsageError."""
    size = re.fullmatch(r"(\d{1,4})x(\d{1,4})", command.image)
    if size is None:
        raise UsageError(f"--image {command.image!r}: accepted: WIDTHxHEIGHT in px, as 32x24")
    observation = _validated(
        ObservationSpec,
        layout=command.layout,
        width_px=int(size[1]),
        height_px=int(size[2]),
        horizontal_fov_deg=command.fov,
        range_m=command.range_m,
    )
    return _validated(
        PolicyFacts,
        name=command.name if command.name is not None else command.out.resolve().name,
        description=command.description,
        observation=observation,
        actions=_validated(ActionSpec, set=command.actions, max_speed_m_s=command.max_speed),
        hold_s=command.hold,
        goal_radius_m=command.goal_radius,
        altitude_m=command.altitude,
        hover_after_s=command.hover_after,
        algorithm=command.algorithm,
        epsilon=command.epsilon,
        training=Training(
            command=shlex.join(["airl", *sys.argv[1:]]),
            versions=package_versions(),
            date_utc=utc_now().isoformat(timespec="seconds"),
        ),
    )


def _validated(model: type[M], **values: Any) -> M:
    """Return a model of these values. Raises UsageError."""
    try:
        return model(**values)
    except ValidationError as error:
        raise UsageError(explain(error, model)) from None

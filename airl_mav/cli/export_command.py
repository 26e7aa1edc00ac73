"""What `airl export` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.policy.action_sets import PAPER_SPEED_M_S, ActionSetName
from airl_mav.policy.layouts import LayoutName
from airl_mav.scenario.model import PilotSettings


@dataclass(frozen=True)
class ExportCommand:
    """Export a Stable-Baselines3 .zip to ONNX with a policy card.

    The model must take a Dict of `depth` (uint8), `velocity` and `goal`, as `--layout` and
    `--image` say, and give the actions of `--actions`. What a VecNormalize around the training
    environment did is not in the .zip: such models do not fly right. A .zip holds pickled Python
    objects: export only those of people you trust.
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

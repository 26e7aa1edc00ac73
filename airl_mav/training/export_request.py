"""What an export is asked for: the model of another trainer, and what its card says of it."""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import BaseModel, Field

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import validated
from airl_mav.core.provenance import package_versions
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.policy.action_sets import PAPER_SPEED_M_S, ActionSetName, ActionSpec
from airl_mav.policy.card import PolicyFacts, Training
from airl_mav.policy.layouts import LayoutName, ObservationSpec
from airl_mav.scenario.model import PilotSettings


class ExportRequest(BaseModel):
    """A model, and what cannot be read from it."""

    model: Path = Field(
        description="the .zip that the model's `save` wrote; with --int8 also a policy, by its"
        " name or folder"
    )
    algorithm: str | None = Field(
        default=None,
        description="class that wrote it, of stable-baselines3 or sb3-contrib: DQN, PPO, A2C, ...;"
        " not for a policy",
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
    int8: bool = Field(
        default=False,
        description="write a network in 8-bit integers, calibrated with frames of its own flights",
    )

    @property
    def policy_name(self) -> str:
        """Short name of the policy that is written."""
        return self.name if self.name is not None else self.out.resolve().name

    def facts(self, command: str) -> PolicyFacts:
        """Return what is said about the policy; `command` made it. Raises UsageError."""
        size = re.fullmatch(r"(\d{1,4})x(\d{1,4})", self.image)
        if size is None:
            raise FieldError("image", self.image, "WIDTHxHEIGHT in px, as 32x24")
        image = {"layout": self.layout, "width_px": int(size[1]), "height_px": int(size[2])}
        camera = self.model_dump(include={"horizontal_fov_deg", "range_m"})
        speed = {"set": self.actions, "max_speed_m_s": self.max_speed_m_s}
        facts = self.model_dump(
            include={"description", "hold_s", "goal_radius_m", "altitude_m", "hover_after_s"}
            | {"algorithm", "epsilon"}
        ) | {
            "name": self.policy_name,
            "observation": _observation(self.image, image | camera),
            "actions": validated(ActionSpec, speed),
            "training": Training(
                command=command,
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

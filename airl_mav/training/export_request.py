"""Options of `airl export`: the model of another trainer, and the fields of its card."""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import BaseModel, Field
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import COMMON, optional, switch, validated
from airl_mav.core.machine import package_versions
from airl_mav.core.plugins import names_code
from airl_mav.envs.observations import LENS, further_seen
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.flight.judge import GOAL_RADIUS_M
from airl_mav.policy.actions import (
    MAX_RATE_DEG_S,
    PAPER_SPEED_M_S,
    ActionSetName,
    ActionSpec,
    DecisionTiming,
)
from airl_mav.policy.card import PolicyFacts, Training, first_line
from airl_mav.policy.observation_spec import LayoutName, ObservationSpec
from airl_mav.profiles import loading, projections
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import PilotSettings

FIELD = "vec_normalize"


class Normalised(nn.Module):
    """Normalisation of observations as in VecNormalize, before a network with Dict inputs."""

    def __init__(self, inner: nn.Module, learned: VecNormalize) -> None:
        """Copy the statistics."""
        super().__init__()
        self.inner = inner
        self.keys = normalised_keys(learned)
        self.most = float(learned.clip_obs)
        for key in self.keys:
            found = learned.obs_rms[key]
            for name, values in (("mean", found.mean), ("var", found.var + learned.epsilon)):
                self.register_buffer(f"{name}_{key}", torch.from_numpy(np.asarray(values)).float())

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the inner network's output for the normalised observations."""
        seen = dict(seen)
        for key in self.keys:
            away = seen[key].float() - self.get_buffer(f"mean_{key}")
            scaled = away / self.get_buffer(f"var_{key}").sqrt()
            seen[key] = scaled.clamp(-self.most, self.most)
        found: torch.Tensor = self.inner(seen)
        return found


def normalised_keys(learned: VecNormalize | None) -> tuple[str, ...]:
    """Return the keys of the normalised observations; empty if only rewards are normalised."""
    if learned is None or not learned.norm_obs:
        return ()
    return tuple(learned.norm_obs_keys or ())


def load_normalisation(path: Path) -> VecNormalize:
    """Load a saved VecNormalize of Dict observations, or raise FieldError.

    The file contains pickled Python objects: load only files from trusted sources.
    """
    if not path.is_file():
        raise FieldError(FIELD, path, problem="no such file")
    try:
        with path.open("rb") as file:
            found = pickle.load(file)  # noqa: S301 (see the docstring)
    except Exception as error:  # Unpickling raises arbitrary exceptions.
        raise FieldError(FIELD, path, problem=f"no VecNormalize: {first_line(error)}") from None
    if not isinstance(found, VecNormalize) or (
        found.norm_obs and not isinstance(found.obs_rms, dict)
    ):
        raise FieldError(FIELD, path, "what a VecNormalize of Dict observations has saved")
    return found


FLOWN = ("hold_s", "goal_radius_m", "altitude_m", "hover_after_s", "decision_timeout_s")
"""Flight settings: fields of the request, of a card and of an environment's episodes."""

SEEN = (
    *("layout", "frames", "kind", "projection", "horizontal_fov_deg", "distortion", "range_m"),
    *("in_flight", "goal_height", "cameras"),
)
"""Observation settings except the image's size: fields of the request and of a card."""

DEFAULTS: dict[str, Any] = {
    "layout": "body",
    "image": "32x24",
    "frames": 1,
    "kind": "depth",
    "projection": "pinhole",
    "horizontal_fov_deg": 90.0,
    "distortion": projections.UNDISTORTED,
    "range_m": 20.0,
    "in_flight": (),
    "goal_height": False,
    "cameras": {},
    "actions": "arc-25",
    "max_speed_m_s": PAPER_SPEED_M_S,
    "max_rate_deg_s": MAX_RATE_DEG_S,
    "hold_s": PilotSettings.hold_s,
    "goal_radius_m": GOAL_RADIUS_M,
    "altitude_m": PilotSettings.altitude_m,
    "hover_after_s": None,
    "decision_timeout_s": None,
    "decisions": PilotSettings.decisions,
    "compensate": PilotSettings.compensate,
}
"""Default model metadata."""


class ModelProperties(NamedTuple):
    """Properties read from a model: its images, and its action set."""

    image: str | None = None
    frames: int | None = None
    actions: ActionSetName | None = None
    kind: projections.CameraKind | None = None
    goal_height: bool | None = None


class ExportRequest(BaseModel):
    """A model, and metadata that the model does not contain."""

    model: str = Field(
        description="the .zip that the model's `save` wrote, or a torch.nn.Module of your own, or a"
        " function that makes one, as MODULE:NAME or FILE.py:NAME; or a policy, by its name or"
        " folder, to be written in integers, or to fly otherwise"
    )
    algorithm: Annotated[str | None, COMMON] = optional(
        "class that wrote a .zip, of stable-baselines3 or sb3-contrib: DQN, PPO, A2C,"
        " ...; of a module of your own only a note on the card"
    )
    weights: Annotated[Path | None, COMMON] = optional(
        "state_dict of a module of your own, as torch.save wrote it"
    )
    vec_normalize: Annotated[Path | None, COMMON] = optional(
        "what the `save` of the VecNormalize around the training environment wrote, for"
        " a .zip: its statistics become part of the network"
    )
    like: Annotated[str | None, COMMON] = optional(
        "training configuration whose environment the model was made for, a shipped"
        " name or a path to a .toml: says all that follows and is left out"
    )
    out: Annotated[Path, COMMON] = Field(description="folder to write policy.onnx and card.json to")
    name: Annotated[str | None, COMMON] = optional(
        "short name of the policy; by default that of the folder"
    )
    description: str = Field(default="", description="one line about the policy")
    layout: Annotated[LayoutName | None, COMMON] = optional(
        "observation layout that the model was trained with; by default body"
    )
    image: Annotated[str | None, COMMON] = optional(
        "width x height of the image that the network sees, px; `paper`: with its"
        " strip; by default as the .zip says, or 32x24"
    )
    frames: int | None = optional(
        "images that the network sees, of this decision and those before it; by default"
        " as the .zip says, or 1"
    )
    kind: projections.CameraKind | None = optional(
        "what the camera gives: depth, rgb or grey; by default as the .zip says, or depth"
    )
    projection: projections.Projection | None = optional(
        "the camera's: pinhole, cylindrical or fisheye; by default pinhole"
    )
    horizontal_fov_deg: float | None = optional(
        "horizontal field of view of the camera, deg; by default 90"
    )
    range_m: float | None = optional("depth from which on everything looks far, m; by default 20")
    goal_height: bool | None = optional(
        "whether the model is told how far the goal lies below the vehicle; by default"
        " as the .zip says, or not"
    )
    actions: Annotated[ActionSetName | None, COMMON] = optional(
        "action set that the model was trained with: arc-25, paper-25, velocity,"
        " velocity-fixed-yaw, velocity3d-yaw-rate, arc3d-75, velocity3d,"
        " velocity3d-fixed-yaw, body-rates, or your own as MODULE:NAME or FILE.py:NAME; by default"
        " arc-25, or velocity where a .zip has continuous actions, velocity3d where they are three,"
        " body-rates where they are four"
    )
    max_speed_m_s: float | None = optional(f"fastest action, m/s; by default {PAPER_SPEED_M_S:g}")
    max_rate_deg_s: float | None = optional(
        f"greatest body rate of body-rates, deg/s; by default {MAX_RATE_DEG_S:g}"
    )
    hold_s: float | None = optional(
        "t3: how long an action is held before the next observation, s; by default"
        f" {PilotSettings.hold_s:g}"
    )
    goal_radius_m: float | None = optional(f"radius of the goal, m; by default {GOAL_RADIUS_M:g}")
    altitude_m: float | None = optional(
        f"height above the start that is flown, m; by default {PilotSettings.altitude_m:g}"
    )
    hover_after_s: float | None = optional(
        "age of a command at which the vehicle hovered in training, s; by default the"
        " last one flew on"
    )
    decision_timeout_s: float | None = optional(
        "time since the last action after which a decision was overdue in training, s;"
        " by default as the companion has it"
    )
    decisions: Annotated[DecisionTiming | None, COMMON] = optional(
        "when a decision begins: sequential, after the hold of the one before, or"
        " pipelined, with the newest frame; by default sequential"
    )
    epsilon: float = Field(
        default=0.0,
        description="share of random actions in flight, 0 to 1; discrete action sets only",
    )
    with_torch: bool = switch("also write policy.pt2, for the torch runtime")
    trust: Annotated[bool, COMMON] = switch(
        "unpickle a .zip and its VecNormalize, or run code that a policy's card names: all execute"
        " code of their author"
    )
    int8: Annotated[bool, COMMON] = switch(
        "write a network in 8-bit integers, calibrated with frames of its own flights"
    )

    @property
    def policy_name(self) -> str:
        """Short name of the exported policy."""
        return self.name if self.name is not None else self.out.resolve().name

    @property
    def own_module(self) -> bool:
        """True for a custom module."""
        return names_code(self.model)

    def check_trust(self) -> None:
        """Raise UsageError for a model of pickled objects, unless its author is trusted."""
        if not (self.own_module or self.trust):
            raise UsageError(
                f"{self.model}: unpickling it can run any code on this machine; accepted: with"
                " --trust, if you trust its maker"
            )

    def facts(self, command: str, taken: ModelProperties | None = None) -> PolicyFacts:
        """Return the card data, `taken` from the loaded model; UsageError for a wrong field."""
        if self.algorithm is None and not self.own_module:
            raise FieldError("algorithm", accepted="the class that wrote the .zip: DQN, PPO, ...")
        if self.weights is not None and not self.own_module:
            raise FieldError("weights", self.weights, "with a module of your own")
        if self.vec_normalize is not None and self.own_module:
            raise FieldError("vec_normalize", self.vec_normalize, "with a .zip")
        self.check_trust()
        known: dict[str, Any] = {
            **DEFAULTS,
            **{k: v for k, v in (taken._asdict() if taken else {}).items() if v},
        }
        environment = None if self.like is None else _environment(self.like)
        if environment is not None:
            known |= _known_of(environment)
        known |= {n: value for n in known if (value := getattr(self, n, None)) is not None}
        image: str = known["image"]
        size = re.fullmatch(r"(\d{1,4})x(\d{1,4})", image)
        if size is None:
            raise FieldError("image", image, "WIDTHxHEIGHT in px, as 32x24")
        seen = {name: known[name] for name in SEEN}
        seen |= {"width_px": int(size[1]), "height_px": int(size[2])}
        limits = {name: known[name] for name in ("max_speed_m_s", "max_rate_deg_s")}
        facts = {name: known[name] for name in (*FLOWN, "decisions", "compensate")} | {
            "name": self.policy_name,
            "description": self.description,
            "algorithm": self.algorithm or "",
            "epsilon": self.epsilon,
            "observation": _observation(image, seen),
            "actions": validated(ActionSpec, {"set": known["actions"], **limits}),
            "training": Training(
                arena=None if environment is None else environment.arena,
                command=command,
                versions=package_versions(),
                date_utc=utc_now().isoformat(timespec="seconds"),
            ),
        }
        return validated(PolicyFacts, facts)


def _environment(name: str) -> EnvironmentSpec:
    """Return the environment of a training configuration, with its speed limit if configured."""
    # Imported here: few exports need them.
    from airl_mav.training.config import TrainingConfig

    environment = loading.load_profile("training", name, TrainingConfig).environment
    if environment.safe_velocity is None:
        return environment
    from airl_mav.envs.stopping import bounded

    return bounded(environment)


def _known_of(spec: EnvironmentSpec) -> dict[str, Any]:
    """Return the metadata that an environment defines for its policies."""
    vehicle = load_vehicle(spec.vehicle)
    camera = spec.camera.of(vehicle.camera)
    shared = [name for name in DEFAULTS if name != "cameras" and name in type(spec).model_fields]
    return {
        "image": f"{spec.image_width_px}x{spec.image_height_px}",
        "cameras": further_seen(spec, vehicle),
        **{name: getattr(spec, name) for name in shared},
        **{name: getattr(camera, name) for name in LENS},
        **{name: getattr(spec.episode, name) for name in FLOWN},
    }


def _observation(image: str, data: dict[str, object]) -> ObservationSpec:
    """Return the observation of the network. Raises FieldError that names the options."""
    try:
        return validated(ObservationSpec, data)
    except FieldError as error:
        if error.field in ("width_px", "height_px"):
            raise FieldError("image", image, problem=error.line()) from None
        raise

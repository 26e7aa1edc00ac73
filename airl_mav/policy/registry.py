"""Registry of policies: built-in, shipped with a card, any folder with one, or a Python class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from airl_mav.core.constants import CommandKind
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.plugins import POLICIES as DOOR
from airl_mav.core.plugins import announced, digest_of, load_part, names_code, reference
from airl_mav.policy.actions import Policy, command_kind
from airl_mav.policy.card import CARD_FILE, ONNX_FILE, PolicyCard, load_card, vehicle_mismatch
from airl_mav.policy.greedy import GreedyPolicy, GreedySettings
from airl_mav.policy.learned import load_learned
from airl_mav.policy.runtime import RuntimeName
from airl_mav.profiles.loading import profiles_dir
from airl_mav.profiles.vehicle import VehicleProfile

POLICIES: dict[str, tuple[str, Callable[[float], Policy]]] = {
    "greedy": (
        "classical depth-reactive baseline: turn to the goal, steer from near returns, slow down",
        lambda hold_s: GreedyPolicy(GreedySettings(period_s=hold_s)),
    ),
}
"""Built-in policies: name -> description and factory from the hold time [s]."""


@dataclass(frozen=True)
class PolicyInfo:
    """Description of a policy before it is loaded."""

    name: str
    """Short name, also for folders."""
    description: str
    card: PolicyCard | None = None
    """Policy card; None = not a learned policy."""
    folder: Path | None = None
    """Folder of a learned policy."""
    program: str | None = None
    """FILE.py:CLASS or MODULE:CLASS of a Python policy."""
    asked: CommandKind | None = None
    """Command kind of a policy that another program runs."""

    @property
    def sha256(self) -> str | None:
        """Digest of the policy's file; None for a built-in policy."""
        if self.program is not None:
            return digest_of(self.program)
        return None if self.card is None else self.card.sha256

    @property
    def commands(self) -> CommandKind:
        """Command kind. Raises FieldError if a custom class declares an unknown kind."""
        if self.asked is not None:
            return self.asked
        if self.program is not None:
            return command_kind(_policy_class(self.program))
        return "velocity" if self.card is None else self.card.actions.commands

    @property
    def macs(self) -> int | None:
        """Multiply-accumulates of one inference."""
        return None if self.card is None else self.card.macs


def camera_refused(policy: PolicyInfo, vehicle: VehicleProfile) -> str | None:
    """Return why a vehicle's cameras cannot serve a policy, or None if they can, or it is unknown.

    The requirements of Python policies and of other programs are unknown.
    """
    camera = vehicle.camera
    if policy.asked is not None:
        return None
    if policy.card is not None:
        return vehicle_mismatch(policy.card, camera, vehicle.cameras)
    if policy.program is None and camera.kind != "depth":
        return f"{camera.kind} camera; accepted: depth"
    if policy.program is None and camera.yaw_deg != 0.0:
        return f"camera with yaw_deg = {camera.yaw_deg:g}; accepted: 0, one that looks ahead"
    return None


def policy_names() -> list[str]:
    """Return the names of all policies that need no path."""
    return [*POLICIES, *(name for name in _shipped() if name not in POLICIES)]


def find_policy(name: str, *, trust: bool = False) -> PolicyInfo:
    """Return the description of a policy by name, folder path or Python class.

    `trust` permits the folder's author to run code on this machine. Raises UsageError if there is
    no such policy (lists the existing ones), its card does not match, or names untrusted code.
    """
    if names_code(name):
        return PolicyInfo(name.rpartition(":")[2], _summary(name), program=name)
    if name in POLICIES:
        return PolicyInfo(name, POLICIES[name][0])
    folder = _folder(name)
    if folder is None:
        return PolicyInfo(name, _summary(name), program=announced(DOOR)[name])
    card = load_card(folder, trust=trust)
    return PolicyInfo(card.name, card.description, card, folder)


def load_policy(
    policy: PolicyInfo | str,
    hold_s: float,
    *,
    runtime: RuntimeName = "onnx",
    threads: int = 1,
    rng: np.random.Generator | None = None,
    ablate: str | None = None,
    trust: bool = False,
) -> Policy:
    """Return a policy, ready to decide, by description, name or folder.

    `hold_s` is the hold time of each action [s]. The keywords are as in `learned.load_learned`;
    only a learned policy takes another runtime or an ablation. Raises UsageError if there is no
    such policy (lists the existing ones), its card does not match, or an option is unsupported.
    """
    known = find_policy(policy, trust=trust) if isinstance(policy, str) else policy
    if known.folder is not None and known.card is not None:
        return load_learned(
            known.folder,
            known.card,
            runtime=runtime,
            threads=threads,
            rng=rng,
            ablate=ablate,
            trust=trust,
        )
    for field, value in (("runtime", None if runtime == "onnx" else runtime), ("ablate", ablate)):
        if value is not None:
            raise FieldError(field, value, f"for a learned policy; {known.name} is none")
    if known.program is not None:
        made: Policy = _policy_class(known.program)()
        return made
    return POLICIES[known.name][1](hold_s)


def _shipped() -> list[str]:
    """Return the names of the shipped policies, sorted."""
    return sorted(path.parent.name for path in (profiles_dir() / "policies").glob(f"*/{CARD_FILE}"))


def _folder(name: str) -> Path | None:
    """Return the folder of a policy; None for an installed package's. Raises UsageError."""
    if name in _shipped():
        return profiles_dir() / "policies" / name
    path = Path(name)
    if path.is_dir():
        return path
    if reference(DOOR, name) is not None:
        return None
    known = ", ".join([*policy_names(), *announced(DOOR)])
    raise UsageError(
        f"--policy {name!r}: no such policy; known: {known}"
        f" (or a path to a folder with {ONNX_FILE} and {CARD_FILE}, FILE.py:CLASS or MODULE:CLASS)"
    )


def _policy_class(name: str) -> Any:
    """Return a policy's class by FILE.py:CLASS, MODULE:CLASS or entry-point name."""
    return load_part(DOOR, name, lambda made: callable(getattr(made, "act", None)))


def _summary(name: str) -> str:
    """Return the first line of a policy class's docstring."""
    return (_policy_class(name).__doc__ or "").strip().partition("\n")[0]

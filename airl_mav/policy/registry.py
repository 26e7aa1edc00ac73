"""Registry of policies: built-in, shipped with a card, any folder with one, or a Python class.

The built-in policy is `GreedyPolicy`, a vector-field histogram over the depth image (after
Borenstein and Koren, IEEE Trans. Robotics and Automation 7(3), 1991): it computes the free distance
of a strip as wide as the vehicle for each heading in view. The free heading nearest to the goal
wins. No memory, no map, no learning.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import CommandKind
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.plugins import POLICIES as DOOR
from airl_mav.core.plugins import announced, digest_of, load_part, names_code, reference
from airl_mav.policy.actions import Action, Policy, command_kind
from airl_mav.policy.card import (
    CARD_FILE,
    ONNX_FILE,
    PolicyCard,
    RuntimeName,
    load_card,
    vehicle_mismatch,
)
from airl_mav.policy.learned import load_learned
from airl_mav.policy.observation import Observation
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


@dataclass(frozen=True)
class GreedySettings:
    """Settings of the baseline."""

    max_speed_m_s: float = 4.0
    max_yaw_rate_rad_s: float = math.radians(90.0)
    brake_m_s2: float = 2.5
    """Deceleration assumed by the speed limit."""
    half_width_m: float = 0.7
    """Half the vehicle's width plus a margin."""
    band_m: float = 0.6
    """Returns within this height above or below the vehicle are obstacles."""
    stop_distance_m: float = 1.3
    """Minimum distance to returns."""
    free_distance_m: float = 10.0
    """Free distance at which headings count as equally free."""
    period_s: float = 0.5
    """Decision period assumed by the speed limit."""
    turn_gain_1_s: float = 1.2
    """Yaw rate per angle error. Gain times the actual decision period must stay well below 2, or
    the heading oscillates: this gain is stable with decisions 1 s apart."""
    headings: int = 37
    """Number of headings tried across the field of view."""


class GreedyPolicy:
    """Depth-reactive steering towards the goal. Implements `actions.Policy`."""

    def __init__(self, settings: GreedySettings | None = None) -> None:
        self._settings = settings or GreedySettings()
        self.side = 1.0
        """Turn direction if all headings are blocked, 1 = right; kept to avoid oscillation."""

    def act(self, observation: Observation) -> Action:
        """Return the velocity for an observation."""
        s, bearing = self._settings, observation.goal_bearing
        half_fov = 0.5 * observation.intrinsics.horizontal_fov_rad
        if abs(bearing) > half_fov:
            # The goal is out of view: turn towards it on the spot.
            self.side = math.copysign(1.0, bearing)
            return Action(0.0, 0.0, self._turn(bearing))
        points = near_points(observation, s.band_m)
        margin = half_fov / s.headings
        headings = np.linspace(-half_fov + margin, half_fov - margin, s.headings)
        clear = np.array([clearance(points, h, s.half_width_m) for h in headings])
        distance = observation.goal_distance
        # Obstacles behind the goal do not matter.
        needed = min(s.free_distance_m, max(distance, s.stop_distance_m))
        lack = np.maximum(0.0, needed - clear) / needed
        cost = np.abs(headings - bearing) + 4.0 * lack
        best = int(np.argmin(cost))
        if clear[best] <= s.stop_distance_m:
            return Action(0.0, 0.0, self.side * s.max_yaw_rate_rad_s * 0.5)
        heading = float(headings[best])
        if abs(heading) > math.radians(3.0):
            self.side = math.copysign(1.0, heading)
        speed = self._speed(float(clear[best]), distance)
        turn = self._turn(heading)
        # The velocity turns with the nose during the hold: aim so that the mean course is right.
        course = heading - 0.5 * turn * s.period_s
        return Action(speed * math.cos(course), speed * math.sin(course), turn)

    def _turn(self, angle: float) -> float:
        limit = self._settings.max_yaw_rate_rad_s
        return max(-limit, min(limit, self._settings.turn_gain_1_s * angle))

    def _speed(self, free_m: float, goal_m: float) -> float:
        """Return the maximum speed from which the vehicle can stop after another period."""
        s = self._settings
        room = max(0.0, free_m - s.stop_distance_m)
        # v T + v²/2a = room, solved for v
        t, a = s.period_s, s.brake_m_s2
        v = a * (math.sqrt(t * t + 2.0 * room / a) - t)
        return min(s.max_speed_m_s, v, max(0.5, goal_m / (2.0 * t)))


def near_points(observation: Observation, band_m: float) -> NDArray[np.float64]:
    """Return the returns at flight height as points (n, 2), forward and right of the vehicle [m].

    The image is levelled by the vehicle's roll and pitch, so that neither the floor nor the tilt of
    acceleration looks like an obstacle. The camera is assumed at the vehicle's centre, along the
    nose.
    """
    k, depth = observation.intrinsics, observation.depth_m
    seen = depth > 0.0
    v, u = np.nonzero(seen)
    z = depth[seen].astype(np.float64)
    right, down = (u - k.cx) / k.focal * z, (v - k.cy) / k.focal * z
    ahead = z
    if k.model.cylindrical:
        angle = (u - k.cx) / k.focal
        ahead, right = np.cos(angle) * z, np.sin(angle) * z
    elif k.model.tabled:
        ahead, right, down = k.rays[:, v, u] * z
    # Heading frame from body: R_y(pitch) R_x(roll).
    cr, sr = math.cos(observation.roll), math.sin(observation.roll)
    cp, sp = math.cos(observation.pitch), math.sin(observation.pitch)
    level_right = cr * right - sr * down
    tilted_down = sr * right + cr * down
    forward = cp * ahead + sp * tilted_down
    level_down = -sp * ahead + cp * tilted_down
    inside = np.abs(level_down) < band_m
    return np.stack([forward[inside], level_right[inside]], axis=1)


def clearance(points: NDArray[np.float64], heading: float, half_width_m: float) -> float:
    """Return the free distance [m] of a strip of +- half_width_m along a heading [rad]."""
    c, s = math.cos(heading), math.sin(heading)
    along = c * points[:, 0] + s * points[:, 1]
    across = -s * points[:, 0] + c * points[:, 1]
    hit = (np.abs(across) < half_width_m) & (along > 0.0)
    return float(along[hit].min()) if hit.any() else math.inf

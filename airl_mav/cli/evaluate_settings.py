"""What the levels of `airl evaluate` share: how a run is written down."""

from __future__ import annotations

import hashlib
from typing import Any

from pydantic import BaseModel

from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.flight.setup import Part
from airl_mav.policy.registry import PolicyInfo


def settings(
    command: EvaluateCommand, policy: PolicyInfo, path: str, **profiles: BaseModel
) -> dict[str, Any]:
    """Return the settings that a run has at every level.

    Args:
        command: What was asked for.
        policy: What is known of the policy.
        path: Its name or path, as asked for.
        profiles: By kind; their values count, not their names.
    """
    return {
        "command": "airl evaluate",
        "level": command.level,
        "policy": policy.name,
        "policy_path": path,
        "policy_sha256": policy.sha256,
        "ablate": command.ablate,
        "episodes": command.episodes,
        "seed": command.seed,
        "latency": command.latency,
        "latency_seed": command.latency_seed,
        "arena_seed": command.arena_seed,
        "profiles_sha256": {kind: fingerprint(profile) for kind, profile in profiles.items()},
    }


def seeds(command: EvaluateCommand) -> tuple[int, ...]:
    """Return the seed of each episode."""
    return tuple(range(command.seed, command.seed + command.episodes))


def policy_part(command: EvaluateCommand, policy: PolicyInfo) -> Part:
    """Return the policy as the head of a report shows it."""
    without = f" (its input {command.ablate!r} made zero)" if command.ablate else ""
    return Part(policy.name, f"{policy.description}{without}")


def fingerprint(profile: BaseModel) -> str:
    """Return a digest of a profile's values: the name alone does not tell a changed one."""
    return hashlib.sha256(profile.model_dump_json().encode()).hexdigest()

"""Policies that a test trains, and their observations in flight."""

from __future__ import annotations

from pathlib import Path

from airl_mav.policy.actions import AnyAction
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import LearnedPolicy
from tests.support.command_line import airl


class Watching:
    """Learned policy that stores its observations."""

    def __init__(self, policy: LearnedPolicy, seen: list[Observation]) -> None:
        self._policy, self._seen = policy, seen

    def act(self, observation: Observation) -> AnyAction:
        self._seen.append(observation)
        return self._policy.act(observation)


def trained(folder: Path, name: str, training: str) -> Path:
    """Train what the file of a training says, of this name; return the folder of its policy."""
    file = folder / f"{name}.toml"
    file.write_text(training, encoding="utf-8")
    code, text = airl("train", str(file), "--out", str(folder / "run"))
    assert code == 0, text
    return folder / "run" / "policy"

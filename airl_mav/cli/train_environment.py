"""From what `airl train` was asked for to the environment that it trains in."""

from __future__ import annotations

from typing import Any

from airl_mav.cli.train_command import TrainCommand
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.profiles.computer import load_computer


def environment_of(command: TrainCommand, configured: EnvironmentSpec) -> EnvironmentSpec:
    """Return a configuration's environment with the command line's latency and bound on the speed.

    Raises:
        UsageError: Names the option, its value and what is accepted.
    """
    delay: dict[str, Any] = {}
    if command.computer is not None:
        if command.workload is None:
            known = ", ".join(load_computer(command.computer).workloads)
            raise UsageError(f"--computer {command.computer}: takes --workload: {known}")
        delay = {"computer": command.computer, "workload": command.workload}
    elif command.workload is not None:
        raise UsageError(f"--workload {command.workload}: accepted: with --computer")
    if command.latency:
        if delay:
            raise UsageError("--latency with --computer: accepted: one of them")
        delay = {"latency": command.latency}
    safe: dict[str, Any] = {}
    if command.sensing_distance is not None:
        safe["sensing_distance_m"] = command.sensing_distance
        if command.max_acceleration is not None:
            safe["max_acceleration_m_s2"] = command.max_acceleration
    elif command.max_acceleration is not None:
        raise UsageError("--max-acceleration: accepted: with --sensing-distance")
    values = configured.model_dump(exclude_unset=True)
    if delay:
        others = values.get("delay", {})
        for key in ("computer", "workload", "latency"):
            others.pop(key, None)
        values["delay"] = others | delay
    if safe:
        values["safe_velocity"] = safe
    return validated(EnvironmentSpec, values)

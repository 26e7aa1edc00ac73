"""Write what was measured into a computer profile; what it holds of other workloads stays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tomli_w

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.profiles.computer import ComputerProfile, Workload
from airl_mav.profiles.loading import load_profile


def existing_profile(path: Path, cpu: str) -> ComputerProfile | None:
    """Return the profile that a file holds, None when there is none.

    Args:
        path: The file, with the suffix .toml.
        cpu: Processor of this machine.

    Raises:
        UsageError: The file is no computer profile, or that of another processor.
    """
    if not path.exists():
        return None
    profile = load_profile("computers", str(path), ComputerProfile)
    if profile.cpu != cpu:
        raise UsageError(
            f"{path}: cpu = {profile.cpu!r}, this is {cpu!r}; accepted: another --on or --out"
        )
    return profile


def write_samples(path: Path, samples_ms: Sequence[float], remarks: Sequence[str]) -> None:
    """Write measured latencies in their order, one a line in ms, with remarks above them."""
    lines = [f"# {remark}" for remark in remarks] + [f"{value:.3f}" for value in samples_ms]
    replace_file(path, "".join(f"{line}\n" for line in lines).encode())


def write_profile(path: Path, profile: ComputerProfile) -> None:
    """Write a profile as TOML; the old file stays until the new one is whole."""
    plain = profile.model_dump(mode="json", exclude_none=True)
    replace_file(path, tomli_w.dumps(plain, multiline_strings=False).encode())


def with_workload(profile: ComputerProfile, name: str, workload: Workload) -> ComputerProfile:
    """Return the profile with a workload added, in place of one of the same name."""
    return profile.model_copy(update={"workloads": {**profile.workloads, name: workload}})

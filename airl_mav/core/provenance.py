"""Provenance of a run: package versions, machine, commit."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from airl_mav import __version__
from airl_mav.core.clock import utc_now

PACKAGES = (
    "filterpy",
    "gymnasium",
    "matplotlib",
    "mavsdk",
    "numba",
    "numpy",
    "onnxruntime",
    "pybullet",
    "pydantic",
    "pymavlink",
    "pyzmq",
    "scipy",
    "stable-baselines3",
    "torch",
)
GIT_TIMEOUT_S = 10.0


def package_versions() -> dict[str, str]:
    """Return the installed versions of all packages that can change a result."""
    found = {"airl-mav": __version__}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def provenance(command: str) -> dict[str, Any]:
    """Return versions, machine and commit for the results of a command, as plain values."""
    return {
        "created_utc": utc_now().isoformat(timespec="seconds"),
        "command": command,
        "versions": package_versions(),
        "machine": describe_machine(),
        "git": git_state(),
    }


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, memory, operating system and Python. No names, no addresses."""
    # Imported here: reading a run does not need it.
    import psutil

    return {
        "cpu": _cpu_model(),
        "architecture": platform.machine(),
        "cores": os.cpu_count() or 1,
        "cores_usable": usable_cores(),
        "memory_bytes": psutil.virtual_memory().total,
        "os": f"{platform.system()} {platform.release()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
    }


def usable_cores() -> int:
    """Return the number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cpu_model() -> str:
    """Return the processor's name: Linux lists it as `model name`, Arm boards as `Model`."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    fields = {
        key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)
    }
    return fields.get("model name") or fields.get("Model") or platform.machine()


def git_state(checkout: Path | None = None) -> dict[str, Any] | None:
    """Return `commit` and `changed` of a checkout, by default this package's; None without git."""
    root = checkout or Path(__file__).resolve().parents[2]
    git = shutil.which("git")
    if git is None or not (root / ".git").exists():
        return None

    def ask(*words: str) -> str | None:
        done = subprocess.run(  # noqa: S603 - fixed words, no shell
            [git, "-C", str(root), *words],
            capture_output=True,
            text=True,
            timeout=GIT_TIMEOUT_S,
            check=False,
        )
        return done.stdout.strip() if done.returncode == 0 else None

    try:
        commit = ask("rev-parse", "HEAD")
        changes = ask("status", "--porcelain")
    except (OSError, subprocess.TimeoutExpired):
        return None
    if commit is None:
        return None
    return {"commit": commit, "changed": bool(changes)}

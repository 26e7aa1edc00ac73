"""Python API to rehearse learned drone policies through MAVLink.

>>> from airl_mav import Scenario, rehearse
>>> run = rehearse(Scenario(level="lockstep", episodes=2))
>>> run.quality.success_rate.value, run.latency["t2"].mean()

All names are imported on first use, so a companion computer does not load the simulator.
`gymnasium.make("airl_mav:airl/Navigation-v0")` finds the environment after this import.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from airl_mav.core.addons import after_import as _after_import

__version__ = "0.3.0"

_EXPORTS = {
    "ExperimentResult": "airl_mav.experiments.experiment",
    "Run": "airl_mav.experiments.experiment",
    "Scenario": "airl_mav.scenario.model",
    "latency_sweep": "airl_mav.experiments.evaluate",
    "evaluate": "airl_mav.experiments.evaluate",
    "hardware_gap": "airl_mav.experiments.hardware_gap",
    "compare_levels": "airl_mav.experiments.evaluate",
    "load_run": "airl_mav.experiments.experiment",
    "rehearse": "airl_mav.experiments.experiment",
}
"""Public names, and the modules that define them."""

if TYPE_CHECKING:
    from airl_mav.experiments.evaluate import compare_levels, evaluate, latency_sweep
    from airl_mav.experiments.experiment import ExperimentResult, Run, load_run, rehearse
    from airl_mav.experiments.hardware_gap import hardware_gap
    from airl_mav.scenario.model import Scenario

__all__ = [
    "ExperimentResult",
    "Run",
    "Scenario",
    "compare_levels",
    "evaluate",
    "hardware_gap",
    "latency_sweep",
    "load_run",
    "rehearse",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*globals(), *_EXPORTS])


# Imported on demand: gymnasium is slow to import, and a light installation does not have it.
_after_import("gymnasium", "airl_mav.envs.registration")

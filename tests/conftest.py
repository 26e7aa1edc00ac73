"""Settings of all tests."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from tests.support.ports import reserved_instance

if TYPE_CHECKING:
    from airl_mav.experiments.executors import Executor
    from airl_mav.scenario.model import Workers

if find_spec("pybullet") is None:  # as on Python 3.12 and newer
    collect_ignore = [
        "firmware/test_kernel_body.py",
        "firmware/test_world.py",
        "learning/test_conditions.py",
        "learning/test_fleet.py",
        "unit/test_raycast.py",
        "unit/test_vehicle.py",
    ]
    """They compare with pybullet."""

RENDER_MESHES = {
    "tests/firmware/test_ground_contacts.py",
    "tests/learning/test_fleet_glass.py",
    "tests/learning/test_fleet_meshes.py",
    "tests/learning/test_fleet_terrain.py",
    "tests/unit/test_meshes_seen.py",
    "tests/unit/test_terrain.py",
}
"""Modules for one worker: they need the same kernels, which no command compiles ahead."""

# The first call of a kernel on a fresh machine compiles it: seconds, not a slow example.
settings.register_profile("kernels", deadline=None)
settings.register_profile("thorough", deadline=None, max_examples=3000)
settings.load_profile("kernels")


# What is imported and collected stays to the end: the collector of garbage would go through it, a
# million objects, again and again, for a third of the time of collecting the tests.
gc.disable()


def pytest_collection_finish() -> None:
    """Let garbage be collected of what the tests make, more seldom: most of it has no cycles."""
    gc.freeze()
    gc.set_threshold(5_000, 10, 10)
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep the tests of a module on one worker: what they share is made once.

    Tests that name a group of their own fly in real time, the longest of all: they begin.
    A machine that stands still for a second alters such a flight, so that what fails among them
    and among the slow ones is run once more; the summary lists it (RERUN).
    """
    named = [item.get_closest_marker("xdist_group") is not None for item in items]
    for item, group in zip(items, named, strict=True):
        if group or item.get_closest_marker("slow") is not None:
            item.add_marker(pytest.mark.flaky(reruns=1))
        if not group:
            module = item.nodeid.partition("::")[0]
            name = "meshes" if module in RENDER_MESHES else module
            item.add_marker(pytest.mark.xdist_group(name))
    order = sorted(range(len(items)), key=lambda index: not named[index])
    items[:] = [items[index] for index in order]


@pytest.fixture(scope="session", autouse=True)
def _operators_are_read_once() -> Iterator[None]:
    """Keep torch's table of operators: each export reads it anew from onnxscript's sources.

    That is half of the time of exporting a small network. Nobody who has not loaded torch by now
    exports any in this process.
    """
    if "torch" not in sys.modules:
        yield
        return
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            ONNXRegistry, "from_torchlib", staticmethod(cache(ONNXRegistry.from_torchlib))
        )
        yield


@pytest.fixture(scope="session", autouse=True)
def _one_worker_unless_asked() -> Iterator[None]:
    """Let experiments in this process have one worker, itself, where a test asks for no number.

    Another one is a process that imports all and loads the kernels, for seconds; the tests keep the
    cores busy without them. That the flights are the same is the subject of
    test_evaluate_lockstep.py.
    """
    from airl_mav.experiments import experiment, fly
    from airl_mav.experiments.process_executor import open_executor

    def here(settings: Workers, *, in_process: bool = False) -> AbstractContextManager[Executor]:
        return open_executor(settings, in_process=in_process or settings.workers is None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("airl_mav.experiments.process_executor.usable_cores", lambda: 1)
        for module in (experiment, fly):
            patch.setattr(module, "open_executor", here)
        yield


@pytest.fixture
def px4_instance() -> Iterator[int]:
    """Give an instance number of PX4's that no other test uses meanwhile."""
    with reserved_instance() as instance:
        yield instance

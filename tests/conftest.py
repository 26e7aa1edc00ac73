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


# Imported and collected objects live until exit. Without this, the garbage collector scans a
# million of them repeatedly, a third of the collection time.
gc.disable()


def pytest_collection_finish() -> None:
    """Collect the tests' garbage again, at higher thresholds: most garbage has no cycles."""
    gc.freeze()
    gc.set_threshold(5_000, 10, 10)
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep the tests of a module on one worker: module fixtures are created once.

    Tests with a custom group fly in real time and take longest: they run first. A machine that
    stalls for a second alters such a flight. Failures of these tests and of slow tests are
    therefore retried once; the summary lists the retry (RERUN).
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
    """Cache torch's operator table: each export parses onnxscript's sources again.

    Parsing takes half of the time of exporting a small network. A process that has not loaded torch
    by now exports no network.
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
    """Run experiments in this process with one worker unless a test requests a number.

    Another worker is a process that imports all modules and loads the kernels, for seconds. Tests
    keep the cores busy without workers. test_evaluate_lockstep.py tests that workers do not change
    flights.
    """
    from airl_mav.experiments import experiment
    from airl_mav.experiments.executors import open_executor

    def here(settings: Workers, *, in_process: bool = False) -> AbstractContextManager[Executor]:
        return open_executor(settings, in_process=in_process or settings.workers is None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("airl_mav.experiments.executors.usable_cores", lambda: 1)
        patch.setattr(experiment, "open_executor", here)
        yield


@pytest.fixture
def px4_instance() -> Iterator[int]:
    """Yield a PX4 instance number that is reserved for this test."""
    with reserved_instance() as instance:
        yield instance

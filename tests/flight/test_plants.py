"""The kernel plant flies as pybullet's: whole flights in lockstep, and without pybullet."""

from __future__ import annotations

import subprocess
import sys
from typing import get_args

import numpy as np
import pytest
from plants_compared import compared, flown, until_judged

from airl_mav.core.errors import FieldError
from airl_mav.flight.judge import Outcome
from airl_mav.scenario import checks
from airl_mav.scenario.aircraft import HAS_PYBULLET, PlantName
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.lockstep_kit import SEED

pytestmark = pytest.mark.slow
compared_with_pybullet = pytest.mark.skipif(not HAS_PYBULLET, reason="pybullet is not installed")


@compared_with_pybullet
@pytest.mark.parametrize(
    ("arena", "seed"),
    [("static-obstacles", SEED), pytest.param("crowded", 3, marks=pytest.mark.nightly)],
)
def test_both_plants_fly_the_same_flight(arena: str, seed: int) -> None:
    """Flights decided from depth images differ by rounding only, required below 1 mm."""
    pair = compared(arena, arena, seed)
    assert pair.outcomes == ("success", "success")
    assert pair.samples[0] == pair.samples[1] > 500
    assert pair.apart_mm < 1e-3
    if arena == "static-obstacles":  # among movers something may touch what lands
        assert pair.landed_mm < 0.1


@compared_with_pybullet
@pytest.mark.parametrize(
    ("arena", "policy", "seed", "hit"),
    [
        # A policy that knows no obstacles, among many; and one into a wire of 2 cm.
        ("dense-obstacles", "no-obstacles", 2, "hit static-"),
        ("park", "static-obstacles-fast", 12, "hit static-wire-"),
    ],
)
def test_a_collision_is_the_same_on_both_plants(
    arena: str, policy: str, seed: int, hit: str
) -> None:
    one, other = (flown(arena, policy, seed, plant) for plant in get_args(PlantName))
    assert one.record.reason.startswith(hit)
    assert one.record.outcome is other.record.outcome is Outcome.COLLISION
    assert one.record.reason == other.record.reason
    assert one.record.ended_us == other.record.ended_us
    here, there = until_judged(one), until_judged(other)
    assert len(here) == len(there) > 300
    assert np.abs(here - there).max() < 1e-6


WITHOUT = """
import sys
sys.modules["pybullet"] = None  # as where it is not installed
from airl_mav.core.clock import SimClock
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.scenario.model import Scenario
from firmware_sim.simulation import EpisodeSetup, Simulation
assert Scenario().plant == "kernel"
simulation = Simulation(EpisodeSetup(load_vehicle("quad"), None, 1), start_us=0, clock=SimClock())
for _ in range(500):
    simulation.tick()
assert abs(simulation.plant.position[2]) < 0.06
"""


def test_without_pybullet_the_kernel_flies() -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT], capture_output=True, text=True, timeout=150, check=False
    )
    assert done.returncode == 0, done.stderr


def test_pybullet_is_asked_for_where_it_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "HAS_PYBULLET", False)
    with pytest.raises(FieldError, match=r"plant .*pybullet.*: accepted: kernel"):
        resolve(Scenario(level="lockstep", plant="pybullet"))
    assert resolve(Scenario(level="gym", plant="pybullet")).scenario.plant == "pybullet"


def test_a_report_says_which_plant_flew(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "plant kernel" in resolve(Scenario(level="lockstep", plant="kernel")).setup.conditions
    monkeypatch.setattr(checks, "HAS_PYBULLET", True)
    usual = resolve(Scenario(level="lockstep", plant="pybullet"))
    assert "plant" not in usual.setup.conditions
    assert usual.config["plant"] == "pybullet"

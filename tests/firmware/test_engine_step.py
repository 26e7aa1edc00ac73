"""Ticks of a short flight against recorded ones: idle, take-off, climb and a turn in gusts.

`python -m tests.firmware.test_engine_step` records the flight again, after a change on purpose.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.core.clock import SimClock
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.autopilot.autopilot_state import Setpoint
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.engine import ticks
from firmware_sim.plant import plant
from firmware_sim.simulation import EpisodeSetup, Simulation

RECORDED = Path(__file__).parents[1] / "support" / "engine_step.json"
STEP_US = 20_000
ARM, OFFBOARD, END = 110, 185, 210
"""Steps at which the vehicle takes off, gets setpoints, and the flight is over."""


def fly(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[float]]:
    """Return the mean of each field of all ticks, in blocks of 0.5 s, and the last tick.

    `ended` lists how each compiled run ended: Python finishes whatever it leaves, to the same bit.
    """
    ended: list[float] = []

    def noted(*arguments: Any) -> int:
        ended.append(plant_ticks(*arguments))
        return int(ended[-1])

    plant_ticks = ticks.stretch
    monkeypatch.setattr(plant, "stretch", noted)
    vehicle = load_vehicle("quad")
    spec = load_profile("arenas", "crowded", ArenaSpec)
    arena = generate(spec, 2, name="crowded", vehicle_width_m=vehicle.body.width_m)
    gusts = {"north_m_s": 1.0, "gust_m_s": 1.0}
    setup = EpisodeSetup(vehicle, arena, 2, Aircraft.model_validate({"wind": gusts}))
    simulation = Simulation(setup, start_us=0, clock=SimClock())
    autopilot = simulation.autopilot.internals
    assert autopilot is not None
    logs: list[Any] = []
    for step in range(END):
        if step == ARM:
            assert autopilot.arm(force=False) == 0
            autopilot.takeoff(2.5)
        if step >= OFFBOARD:
            velocity = np.array([1.5, 0.5, -0.3])
            setpoint = Setpoint(np.full(3, math.nan), velocity, math.nan, 0.4)
            autopilot.offer_setpoint(setpoint, simulation.time_us)
        if step == OFFBOARD:
            assert autopilot.set_mode(Mode.OFFBOARD) == 0
        while simulation.time_us < (step + 1) * STEP_US:
            simulation.advance((step + 1) * STEP_US)
            logs.append((simulation.truths.copy(), simulation.flown.copy()))
    found = {"ended": ended}
    for name, log in zip(
        ("truth", "flown"), map(np.concatenate, zip(*logs, strict=True)), strict=True
    ):
        for field in log.dtype.names or ():
            values = np.nan_to_num(log[field].reshape(len(log), -1).astype(np.float64))
            blocks = [block.mean(axis=0) for block in np.array_split(values, 8)]
            found[f"{name}.{field}"] = np.concatenate([*blocks, values[-1]]).tolist()
    simulation.close()
    return found


def test_a_flight_is_the_recorded_one(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pybullet")
    recorded, found = json.loads(RECORDED.read_text()), fly(monkeypatch)
    assert list(found) == list(recorded)
    for name, values in found.items():
        np.testing.assert_allclose(values, recorded[name], rtol=1e-5, atol=1e-7, err_msg=name)


if __name__ == "__main__":
    with pytest.MonkeyPatch.context() as patch:
        flown = fly(patch)
    RECORDED.write_text(json.dumps({k: [float(f"{x:.9g}") for x in v] for k, v in flown.items()}))

from __future__ import annotations

import numpy as np
import pytest

from airl_mav.core.constants import TICK_US
from airl_mav.flight.energy import add_up, split_energy
from airl_mav.flight.trajectory import Trajectory, measure_leg
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.power import PowerModel, flight_power_w, level_power_w
from tests.support.recording import TestRecorder, record_tick
from tests.support.solo import SOLO

QUAD = load_vehicle("quad")
BODY = QUAD.body.model_copy(update={"payload_kg": 0.2})
OLD = QUAD.model_copy(update={"power": SOLO, "body": BODY})
"""With the nine coefficients, and 200 g of its 1.5 kg carried."""

LEVEL = (1.0, 0.0, 0.0, 0.0)


def swinging_flight(
    vehicle: VehicleProfile, seconds: float = 12.0
) -> tuple[Trajectory, dict[str, float]]:
    """Fly a known velocity at 250 Hz; return the recording, and each part of the energy [J]."""
    recorder = TestRecorder()
    airframe, model = Airframe.from_profile(vehicle), PowerModel.from_profile(vehicle)
    dt = TICK_US / 1e6
    parts = dict.fromkeys(("hover", "motion", "manoeuvre"), 0.0)
    position, still = np.zeros(3), (0.0, 0.0, 0.0)
    hover = level_power_w(0.0, airframe, model)
    for k in range(round(seconds / dt) + 1):
        t = k * dt
        velocity = np.array([3.0 * np.sin(0.9 * t), 1.5 * np.cos(0.5 * t), 0.4 * np.sin(1.7 * t)])
        accel = np.array([2.7 * np.cos(0.9 * t), -0.75 * np.sin(0.5 * t), 0.68 * np.cos(1.7 * t)])
        thrust = vehicle.body.mass_kg * (9.80665 - float(accel[2]))
        v, a = tuple(velocity), tuple(accel)
        power = flight_power_w(thrust, v, LEVEL, still, a, airframe, model)
        record_tick(recorder, k * TICK_US, position, velocity, LEVEL, power)
        position = position + velocity * dt
        if k:
            steady = level_power_w(float(np.hypot(*velocity[:2])), airframe, model)
            parts["hover"] += dt * hover
            parts["motion"] += dt * (steady - hover)
            parts["manoeuvre"] += dt * (power - steady)
    return recorder.trajectory(), parts


@pytest.mark.parametrize("vehicle", [QUAD, OLD], ids=["momentum", "regression"])
def test_the_parts_are_those_of_the_power_model(vehicle: VehicleProfile) -> None:
    path, parts = swinging_flight(vehicle)
    split = split_energy(path, 0, 12_000_000, vehicle, 10.0)
    assert split.hover_j == pytest.approx(parts["hover"], rel=1e-9)
    assert split.motion_j == pytest.approx(parts["motion"], rel=0.01)
    assert split.manoeuvre_j == pytest.approx(parts["manoeuvre"], rel=0.01, abs=2.0)
    assert split.computer_j == pytest.approx(120.0)


def test_a_regression_hovers_on_its_constant_and_its_payload() -> None:
    path, _ = swinging_flight(OLD)
    split = split_energy(path, 0, 12_000_000, OLD, 0.0)
    assert split.hover_j == pytest.approx(12.0 * (433.9 + 0.220 * 200.0))
    level = np.hypot(path.velocity[:, 0], path.velocity[:, 1])
    assert split.motion_j == pytest.approx(-1.526 * 12.0 * float(level.mean()), rel=0.01)


def test_a_heavier_vehicle_hovers_on_more() -> None:
    path, _ = swinging_flight(QUAD)
    heavy = QUAD.model_copy(update={"body": QUAD.body.model_copy(update={"mass_kg": 2.0})})
    light_w, heavy_w = (
        split_energy(path, 0, 12_000_000, each, 0.0).hover_j / 12.0 - 5.0 for each in (QUAD, heavy)
    )
    assert heavy_w == pytest.approx(light_w * (2.0 / 1.5) ** 1.5)


def test_the_parts_add_up_to_the_energy_of_the_flight() -> None:
    path, _ = swinging_flight(QUAD)
    for start, end in ((0, 12_000_000), (1_234_000, 9_870_000)):
        split = split_energy(path, start, end, QUAD, 1.7)
        assert split.airframe_j == pytest.approx(measure_leg(path, start, end).energy_j, rel=1e-12)
    halves = [split_energy(path, a, a + 6_000_000, QUAD, 1.7) for a in (0, 6_000_000)]
    whole = split_energy(path, 0, 12_000_000, QUAD, 1.7)
    both = add_up(halves)
    assert both.airframe_j == pytest.approx(whole.airframe_j)
    assert both.computer_j == pytest.approx(whole.computer_j)
    assert both.time_s == 12.0


def test_a_flight_without_a_recording_has_its_computer_alone() -> None:
    path, _ = swinging_flight(QUAD, 1.0)
    split = split_energy(path, 5_000_000, 7_000_000, QUAD, 10.0)
    assert (split.airframe_j, split.computer_j) == (0.0, 20.0)

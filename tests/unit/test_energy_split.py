from __future__ import annotations

import numpy as np
import pytest

from airl_mav.core.constants import TICK_US
from airl_mav.flight.energy import add_up, split_energy
from airl_mav.flight.quality import measure_leg
from airl_mav.flight.trajectory import Trajectory, TrajectoryRecorder
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.vehicle.power import coefficients, power_w
from tests.support.recording import record_tick

POWER = load_vehicle("quad").power.model_copy(update={"payload_g": 200.0})
LEVEL = [1.0, 0.0, 0.0, 0.0]


def swinging_flight(seconds: float = 12.0) -> tuple[Trajectory, dict[str, float]]:
    """Fly a known velocity at 250 Hz; return the recording, and each term of the model [J]."""
    recorder = TrajectoryRecorder()
    b = coefficients(POWER)
    dt = TICK_US / 1e6
    terms = dict.fromkeys(("hover", "motion", "manoeuvre"), 0.0)
    position = np.zeros(3)
    for k in range(round(seconds / dt) + 1):
        t = k * dt
        velocity = np.array([3.0 * np.sin(0.9 * t), 1.5 * np.cos(0.5 * t), 0.4 * np.sin(1.7 * t)])
        accel = np.array([2.7 * np.cos(0.9 * t), -0.75 * np.sin(0.5 * t), 0.68 * np.cos(1.7 * t)])
        power = power_w(tuple(velocity), tuple(accel), (0.0, 0.0, 0.0), POWER.payload_g, b)
        record_tick(recorder, k * TICK_US, position, velocity, LEVEL, power)
        position = position + velocity * dt
        if k:
            vxy, axy = np.hypot(*velocity[:2]), np.hypot(*accel[:2])
            vz, az = abs(velocity[2]), abs(accel[2])
            terms["hover"] += dt * (b[6] * POWER.payload_g + b[8])
            terms["motion"] += dt * (b[0] * vxy + b[3] * vz)
            terms["manoeuvre"] += dt * (b[1] * axy + b[2] * vxy * axy + b[4] * az + b[5] * vz * az)
    return recorder.trajectory(), terms


def test_the_parts_are_the_terms_of_the_power_model() -> None:
    path, terms = swinging_flight()
    split = split_energy(path, 0, 12_000_000, POWER, 10.0)
    assert split.hover_j == pytest.approx(terms["hover"], rel=1e-9)
    assert split.motion_j == pytest.approx(terms["motion"], rel=0.01)
    assert split.manoeuvre_j == pytest.approx(terms["manoeuvre"], rel=0.01)
    assert split.computer_j == pytest.approx(120.0)


def test_the_parts_add_up_to_the_energy_of_the_flight() -> None:
    path, _ = swinging_flight()
    for start, end in ((0, 12_000_000), (1_234_000, 9_870_000)):
        split = split_energy(path, start, end, POWER, 1.7)
        assert split.airframe_j == pytest.approx(measure_leg(path, start, end).energy_j, rel=1e-12)
    halves = [split_energy(path, a, a + 6_000_000, POWER, 1.7) for a in (0, 6_000_000)]
    whole = split_energy(path, 0, 12_000_000, POWER, 1.7)
    both = add_up(halves)
    assert both.airframe_j == pytest.approx(whole.airframe_j)
    assert both.computer_j == pytest.approx(whole.computer_j)
    assert both.time_s == 12.0


def test_a_flight_without_a_recording_has_its_computer_alone() -> None:
    path, _ = swinging_flight(1.0)
    split = split_energy(path, 5_000_000, 7_000_000, POWER, 10.0)
    assert (split.airframe_j, split.computer_j) == (0.0, 20.0)

"""Airframe check: its figures against closed forms, and the warning of a wrong hover throttle."""

from pathlib import Path

import numpy as np
import pytest

from airl_mav.addons.airframe_check import airframe_check
from airl_mav.addons.airframe_check.airframe_check import check_airframe

LIGHT = """
base = "quad"
description = "a light quad with strong motors"
[body]
mass_kg = 0.4
[rotor]
thrust_max_n = 7.07
"""


@pytest.fixture(scope="module")
def quad() -> airframe_check.AirframeFigures:
    return check_airframe("quad")


def test_figures_of_the_quad_follow_from_its_profile(quad: airframe_check.AirframeFigures) -> None:
    weight_n, thrust_n = 1.5 * 9.80665, 4 * 7.07
    assert quad.hover_throttle == pytest.approx(weight_n / thrust_n)
    assert quad.thrust_to_weight == pytest.approx(thrust_n / weight_n)
    # Hover power by momentum theory: T^1.5 / sqrt(2 rho A) / FM / eta, plus 5 W of avionics.
    area_m2 = 4 * np.pi * 0.127**2
    ideal_w = weight_n**1.5 / np.sqrt(2 * 1.225 * area_m2)
    assert quad.hover_w == pytest.approx(ideal_w / 0.65 / 0.68 + 5.0, rel=1e-3)
    energy_j = 5.2 * 3600 * 4 * 3.85
    assert quad.endurance_min == pytest.approx(energy_j / quad.hover_w / 60.0)
    assert not [line for line in quad.warnings if "HOVER" in line]


def test_full_throttle_gives_full_thrust_at_the_current_of_the_pack(
    quad: airframe_check.AirframeFigures,
) -> None:
    full = quad.motors[-1]
    assert full.throttle == 1.0
    assert full.thrust_n == pytest.approx(7.07)
    volts = 4 * 4.2 - 0.02 * full.current_a
    assert volts * full.current_a == pytest.approx(full.power_w)


def test_step_responses_settle_and_stops_grow_with_speed(
    quad: airframe_check.AirframeFigures,
) -> None:
    for step in quad.steps.values():
        assert step.rise_s is not None and 0.05 < step.rise_s < 3.0
        assert step.settle_s is not None and step.overshoot_percent < 30.0
    metres = list(quad.stopping_m.values())
    assert metres == sorted(metres) and metres[0] > 0.0


def test_an_inherited_hover_throttle_is_reported(tmp_path: Path) -> None:
    profile = tmp_path / "light.toml"
    profile.write_text(LIGHT)
    found = check_airframe(str(profile))
    assert found.hover_throttle == pytest.approx(0.4 * 9.80665 / (4 * 7.07))
    tables = [line.split(".MPC_THR_HOVER")[0] for line in found.warnings if "HOVER" in line]
    assert tables == ["parameters", "px4.parameters"]

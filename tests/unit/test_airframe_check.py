"""Airframe check: figures against closed forms, warnings, and the fit to a bench table."""

from pathlib import Path

import numpy as np
import pytest

from airl_mav.addons.airframe_check import airframe_check
from airl_mav.addons.airframe_check.airframe_check import OPTIONS, check_airframe, run
from airl_mav.core.errors import UsageError
from airl_mav.core.progress import new_console
from airl_mav.profiles.vehicle import Regression
from tests.support.processes import ROOT

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


AIR2216 = ROOT / "examples" / "motor_air2216.csv"


def bench(*rows: str, header: str = "throttle_percent,thrust_n,current_a") -> bytes:
    return "\n".join((header, *rows)).encode()


@pytest.mark.parametrize(("curve", "volts"), [(0.0, 16.8), (0.35, 16.8), (1.0, 15.0)])
def test_the_models_own_table_is_recovered(tmp_path: Path, curve: float, volts: float) -> None:
    """12 N, drive efficiency 0.75, figure of merit 0.65, 10 inch; the pack of `quad` has 16.8 V."""
    rows = []
    for u in np.linspace(0.0, 1.0, 11):
        thrust_n = 12.0 * (curve * u * u + (1.0 - curve) * u)
        ideal_w = thrust_n**1.5 / np.sqrt(2 * 1.225 * np.pi * 0.127**2)
        cells = 100 * u, thrust_n / 9.80665e-3, ideal_w / 0.65 / 0.75 / volts
        rows.append(",".join(str(float(cell)) for cell in cells))
    header = "throttle_percent,thrust_g,current_a"
    if volts != 16.8:
        header, rows = f"{header},voltage_v", [f"{row},{volts}" for row in rows]
    table = tmp_path / "motor.csv"
    table.write_bytes(bench(*rows, header=header))
    found = check_airframe("quad", motor_data=table)
    fit = found.bench
    assert fit is not None
    got = fit.thrust_max_n, fit.thrust_curve, fit.drive_efficiency
    assert got == pytest.approx((12.0, curve, 0.75), abs=1e-9)
    np.testing.assert_allclose(fit.model, fit.measured, atol=1e-9)
    # All figures follow from the fit: hover throttle, and power without avionics.
    share = 1.5 * 9.80665 / 48.0
    assert found.hover_thrust_share == pytest.approx(share)
    u = found.hover_throttle
    assert curve * u * u + (1.0 - curve) * u == pytest.approx(share)
    assert found.motors[-1].thrust_n == pytest.approx(12.0)
    ideal_w = (1.5 * 9.80665) ** 1.5 / np.sqrt(2 * 1.225 * 4 * np.pi * 0.127**2)
    assert found.hover_w == pytest.approx(ideal_w / 0.65 / 0.75 + 5.0, rel=1e-3)


def test_a_manufacturers_table_is_fitted_and_printed(capsys: pytest.CaptureFixture[str]) -> None:
    console = new_console()
    assert run(OPTIONS(motor_data=AIR2216), console) == 0
    text = capsys.readouterr().out
    assert "[rotor]\nthrust_max_n = 13.72\nthrust_curve = 0.6613\n" in text
    assert "[power]\ndrive_efficiency = 0.7325\n" in text
    assert "figure_of_merit * drive_efficiency = 0.476" in text
    assert "Root-mean-square difference: 0.26 N, 0.77 A." in text
    (row,) = [line.split() for line in text.splitlines() if line.split()[:2] == ["45", "3.66"]]
    assert row == ["45", "3.66", "3.93", "0.27", "2.86", "2.90", "0.04"]


GOOD = ("30,2,1.5", "60,6,5.5", "90,11.5,14")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "line 1: '': accepted: throttle_percent, thrust_n or thrust_g, current_a, and"),
        (bench(*GOOD, header="throttle_percent,thrust_n"), "line 1: 'throttle_percent,thrust_n'"),
        (bench(*GOOD, header="throttle_percent,thrust_n,current_a,rpm"), "line 1: .*rpm'"),
        (bench(*GOOD, header="throttle_percent,thrust_n,current_a,thrust_g"), "line 1: "),
        (bench(*GOOD, header="throttle_percent,thrust_n,current_a,current_a"), "line 1: "),
        (bench(*GOOD[:2], "90,much,14"), "line 4: thrust_n = 'much': accepted: 0 to 1,000"),
        (bench(*GOOD[:2], "90,nan,14"), "line 4: thrust_n = 'nan': accepted: 0 to 1,000"),
        (bench("30,2,-1.5", *GOOD), "line 2: current_a = '-1.5': accepted: 0 to 1,000"),
        (bench(*GOOD, "101,12,16"), "line 5: throttle_percent = '101': accepted: 0 to 100"),
        (bench(*GOOD, "95,12"), "line 5: 2 values: accepted: 3"),
        (bench(*GOOD[:2]), "2 throttles with thrust and current: accepted: at least 3"),
        (bench(*GOOD[:2], "60,6,5.5"), "2 throttles with thrust and current"),
        (bench(), "0 throttles with thrust and current"),
        (b"\x7fELF\xff\xfe\x00", "not UTF-8 text"),
        (b"\x00\x01", r"line 1: '.x00.x01': accepted"),
        (b"1," * (1 << 20), "accepted: a table of at most 1,048,576 bytes"),
        (bench("30,3,0.1", "60,6,0.2", "90,9,0.3"), "drive_efficiency = .* 0.1 to 1; check"),
        (bench("30,1,0.6", "60,2,1.7", "90,3,3.1"), "body.mass_kg = 1.5: cannot hover"),
        (bench("0.3,2,1.5", "0.6,6,5.5", "0.9,11,14"), "rotor.thrust_max_n = .*accepted: 0.01 <"),
    ],
)
def test_bad_tables_are_one_line_errors(tmp_path: Path, data: bytes, message: str) -> None:
    table = tmp_path / "motor.csv"
    table.write_bytes(data)
    with pytest.raises(UsageError, match=message) as error:
        check_airframe("quad", motor_data=table)
    assert str(error.value).startswith(str(table))
    assert "\n" not in str(error.value)


def test_a_fit_needs_a_file_and_momentum_theory(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        check_airframe("quad", motor_data=tmp_path / "none.csv")
    profile = tmp_path / "regression.toml"
    terms = [f"{name} = 1.0" for name in Regression.model_fields if name != "model"]
    profile.write_text("\n".join(('base = "quad"', "[power]", 'model = "regression"', *terms)))
    with pytest.raises(UsageError, match="regression: accepted: momentum"):
        check_airframe(str(profile), motor_data=AIR2216)

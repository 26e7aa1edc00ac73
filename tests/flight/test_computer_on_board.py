"""The aircraft pays for its computer: whole flights in the twin and in lockstep."""

from __future__ import annotations

import pytest

from airl_mav import Scenario, rehearse
from airl_mav.flight.judge import Outcome
from airl_mav.rehearsal.run_folder import LoadedRun, load, vehicle_of
from airl_mav.report.measures import summarize_run
from airl_mav.report.run_tables import quality_table, setup_rows
from tests.support.flown_here import flown_here

FURNACE = """
description = "a furnace"
cpu = "none"
watts = 5000.0
mass_g = 100.0
price_usd = 1.0
source = "this test"
"""


@pytest.fixture(scope="module", params=["gym", "lockstep"])
def runs(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, LoadedRun]:
    """The same flight with a computer of 5000 W on board, and with it on the ground."""
    folder = tmp_path_factory.mktemp(request.param)
    runs = {}
    for name, more in (("aboard", ""), ("ground", "ground_equipment = true")):
        computer = folder / f"{name}.toml"
        computer.write_text(FURNACE + more)
        out = folder / name
        scenario = Scenario(
            policy="static-obstacles",
            level=request.param,
            episodes=1,
            workers=1,
            computer=str(computer),
            battery_charge=0.2,
        )
        with flown_here():
            rehearse(scenario, out=out)
        runs[name] = load(out)
    return runs


def test_it_empties_the_pack_on_board_and_not_from_the_ground(runs: dict[str, LoadedRun]) -> None:
    outcomes = {name: run.episodes[0].outcome for name, run in runs.items()}
    assert outcomes == {"aboard": Outcome.BATTERY, "ground": Outcome.SUCCESS}
    charge = runs["ground"].episodes[0].battery_remaining
    assert charge is not None
    assert 0.15 < charge < 0.2


def test_it_weighs_on_board_and_not_from_the_ground(runs: dict[str, LoadedRun]) -> None:
    masses = {name: vehicle_of(run.info).body.mass_kg for name, run in runs.items()}
    assert masses == pytest.approx({"aboard": 1.6, "ground": 1.5})


def test_the_page_charges_no_computer_on_the_ground(runs: dict[str, LoadedRun]) -> None:
    run = runs["ground"]
    quality = run.episodes[0].quality
    assert quality is not None
    assert quality.computer_energy_j == 0.0
    assert run.info.setup.computer_watts == 0.0
    assert dict(setup_rows(run))["computer"].endswith("a furnace, on the ground")
    assert dict(setup_rows(runs["aboard"]))["computer"].endswith("a furnace, 5000 W")
    rows = {row[0]: row[1] for row in quality_table(summarize_run(run)).rows}
    # A fifth of 5.2 Ah, at 14 V empty and 14.56 V at the start.
    pack_j = 0.2 * 5.2 * 3600 * 14.28
    assert quality.energy_j is not None
    lasts_s = pack_j * quality.flight_time_s / quality.energy_j
    assert quality.endurance_s == pytest.approx(lasts_s)
    assert rows["endurance"] == f"{lasts_s / 60.0:,.1f} min"
    assert rows["range"] == f"{lasts_s * quality.mean_speed_m_s / 1e3:,.2f} km"
    assert rows["missions per charge"] == f"{lasts_s / quality.flight_time_s:,.1f}"


def test_a_table_of_a_run_without_endurance_leaves_it_out(runs: dict[str, LoadedRun]) -> None:
    aboard = runs["aboard"]  # it never arrived: there is nothing to take a mean of
    rows = {row[0] for row in quality_table(summarize_run(aboard)).rows}
    assert "mean speed" in rows
    assert not rows & {"endurance", "range", "missions per charge"}

"""Vehicle payload: mass, centre of mass and inertia against point masses summed by numpy."""

from __future__ import annotations

import numpy as np
import pytest

from airl_mav.core.errors import FieldError
from airl_mav.profiles.computer import ComputerProfile, load_computer
from airl_mav.profiles.vehicle import Payload, load_vehicle, loaded
from airl_mav.rehearsal.channel import Begin
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

QUAD = load_vehicle("quad")
PI = load_computer("ras-pi-4")
NOTHING = Payload()


def computer(**changes: object) -> ComputerProfile:
    return PI.model_copy(update=changes)


def test_nothing_carried_is_the_vehicle_itself() -> None:
    assert loaded(QUAD, None, NOTHING) is QUAD
    assert loaded(QUAD, computer(mass_g=0.0), NOTHING) is QUAD
    assert loaded(QUAD, load_computer("workstation"), NOTHING) is QUAD
    heavy = computer(mass_g=9000.0, ground_equipment=True)
    assert loaded(QUAD, heavy, NOTHING) is QUAD


def test_mass_and_inertia_are_those_of_all_points_about_their_centre() -> None:
    payload = Payload(mass_g=300.0, forward_m=0.06, right_m=-0.04, down_m=0.09)
    body = loaded(QUAD, computer(mass_g=120.0), payload).body
    masses = np.array([1.5, 0.12, 0.3])
    places = np.array([[0, 0, 0], [0, 0, 0], [0.06, -0.04, 0.09]])
    center = masses @ places / masses.sum()
    inertia = np.diag([0.029125, 0.029125, 0.055225])
    for m, r in zip(masses, places - center, strict=True):
        inertia = inertia + m * (r @ r * np.eye(3) - np.outer(r, r))
    assert body.mass_kg == pytest.approx(1.92)
    assert (body.com_forward_m, body.com_right_m) == pytest.approx(tuple(center[:2]))
    found = (body.inertia_xx_kg_m2, body.inertia_yy_kg_m2, body.inertia_zz_kg_m2)
    assert found == pytest.approx(tuple(np.diag(inertia)))
    assert body.payload_kg == pytest.approx(0.42)


def test_loading_twice_is_loading_both() -> None:
    half = Payload(mass_g=150.0, forward_m=0.06)
    twice = loaded(loaded(QUAD, None, half), None, half).body
    once = loaded(QUAD, None, Payload(mass_g=300.0, forward_m=0.06)).body
    assert twice.com_forward_m == pytest.approx(once.com_forward_m)
    assert twice.inertia_yy_kg_m2 == pytest.approx(once.inertia_yy_kg_m2)


def test_what_the_rotors_do_not_carry_is_refused_with_the_numbers() -> None:
    with pytest.raises(FieldError) as error:
        resolve(Scenario(payload=Payload(mass_g=1000.0)))
    assert error.value.field == "payload.mass_g"
    assert error.value.line("--payload.mass-g") == (
        "--payload.mass-g 1000: cannot hover: needs 31.87 newton with 30 % margin, has 28.28 "
        "(4 x rotor.thrust_max_n 7.07)"
    )
    with pytest.raises(FieldError, match=r"needs 31\.87 newton") as error:
        loaded(QUAD, computer(mass_g=1000.0), NOTHING)
    assert error.value.field == "computer"


@pytest.mark.parametrize(
    ("payload", "field"),
    [
        (Payload(mass_g=300.0, forward_m=0.9), "payload.forward_m"),  # Outside the rotors.
        (Payload(mass_g=300.0, right_m=-0.9), "payload.right_m"),
        (Payload(mass_g=500.0, forward_m=0.25), "payload.forward_m"),  # Too much for the front.
    ],
)
def test_what_two_rotors_would_have_to_carry_alone_is_refused(payload: Payload, field: str) -> None:
    with pytest.raises(FieldError, match="cannot hover: the rotors would have to give") as error:
        loaded(QUAD, None, payload)
    assert error.value.field == field


def test_a_loaded_vehicle_travels_to_another_process_unchanged() -> None:
    payload = Payload(mass_g=200.0, forward_m=0.03)
    sent = resolve(Scenario(level="lockstep", computer="ras-pi-4", payload=payload))
    received = Begin.model_validate_json(Begin(scenario=sent).to_line()).scenario
    assert received.vehicle == sent.vehicle
    assert received.vehicle.body.mass_kg == pytest.approx(1.746)


def test_a_run_knows_what_was_carried() -> None:
    empty = resolve(Scenario(level="lockstep"))
    full = resolve(Scenario(level="lockstep", payload=Payload(mass_g=200.0)))
    assert empty.vehicle == QUAD
    assert full.vehicle.body.mass_kg == pytest.approx(1.7)
    assert full.config["vehicle_body"]["mass_kg"] == pytest.approx(1.7)
    digests = [each.config["profiles_sha256"]["vehicle"] for each in (empty, full)]
    assert digests[0] != digests[1]


def test_the_pack_holds_charge_times_mean_voltage() -> None:
    # 5.2 Ah, 16.8 V full and 14 V empty.
    whole = resolve(Scenario(level="gym"))
    assert whole.pack_j == pytest.approx(5.2 * 3600 * 15.4)
    half = resolve(Scenario(level="gym", battery_charge=0.5))
    assert half.pack_j == pytest.approx(2.6 * 3600 * 14.7)

"""Fingerprint of the flight behaviour: unchanged today, sensitive to changes of a flight."""

from __future__ import annotations

from pathlib import Path

import pytest

from airl_mav.core.errors import UsageError
from airl_mav.profiles.vehicle import Payload
from published import behaviour
from published.behaviour import (
    Behaviour,
    differences,
    fly_behaviour,
    read_behaviour,
    write_behaviour,
)
from tests.support.processes import ROOT

STORED = ROOT / "results" / "behaviour.json"
FLIGHT = "gym, static-obstacles, static-obstacles, native, seed 1"


@pytest.fixture(scope="module")
def stored() -> Behaviour:
    return read_behaviour(STORED)


def test_flights_are_those_of_the_published_results(stored: Behaviour) -> None:
    """Accept an intended change with scripts/results.py fingerprint --accept."""
    assert [str(each) for each in differences(stored, fly_behaviour())] == []


def test_a_small_change_of_the_aircraft_shows(
    stored: Behaviour, monkeypatch: pytest.MonkeyPatch
) -> None:
    heavier = [
        (name, scenario.model_copy(update={"payload": Payload(mass_g=5.0)}))
        for name, scenario in behaviour.scenarios()
        if name == FLIGHT
    ]
    monkeypatch.setattr(behaviour, "scenarios", lambda: iter(heavier))
    one = Behaviour(flights={FLIGHT: stored.flights[FLIGHT]})
    (found,) = differences(one, fly_behaviour())
    assert found.flight == FLIGHT


def changed(stored: Behaviour, **fields: object) -> Behaviour:
    flight = stored.flights[FLIGHT].model_copy(update=fields)
    return Behaviour(flights={**stored.flights, FLIGHT: flight})


def test_last_bits_are_no_difference_and_the_rest_is(stored: Behaviour) -> None:
    flight = stored.flights[FLIGHT]
    (north, east, down), *rest = flight.positions
    near = changed(
        stored,
        positions=((north + 0.009, east, down), *rest),
        time_s=flight.time_s + 0.02,
        energy_j=flight.energy_j * 1.0009,
    )
    assert differences(stored, near) == ()
    assert near.digest != stored.digest
    for other in (
        changed(stored, positions=((north + 0.011, east, down), *rest)),
        changed(stored, positions=(*flight.positions[:-1], (0.0, 0.0, 0.0))),
        changed(stored, time_s=flight.time_s + 0.04),
        changed(stored, energy_j=flight.energy_j * 1.002),
        changed(stored, outcome="collision"),
        Behaviour(flights={k: v for k, v in stored.flights.items() if k != FLIGHT}),
    ):
        assert [each.flight for each in differences(stored, other)] == [FLIGHT]


def test_a_file_that_was_edited_is_refused(stored: Behaviour, tmp_path: Path) -> None:
    path = tmp_path / "behaviour.json"
    write_behaviour(path, stored)
    assert read_behaviour(path) == stored
    path.write_text(path.read_text().replace(stored.digest, "0" * 16).replace('"crc32"', '"crc"'))
    with pytest.raises(UsageError, match=f"accepted: {stored.digest}"):
        read_behaviour(path)

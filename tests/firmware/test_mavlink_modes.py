"""Standard modes: AVAILABLE_MODES, CURRENT_MODE, DO_SET_STANDARD_MODE."""

from __future__ import annotations

from typing import Any

import pytest

from firmware_sim.addons.ground_station_services.information import AVAILABLE
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.mavlink.codec import dialect
from tests.support.mavlink_clients import Rig

REQUEST_MESSAGE, SET_STANDARD_MODE = 512, 262
ACCEPTED, REJECTED, DENIED, FAILED = 0, 1, 2, 4

ON_THE_WIRE = len({mode.spec.custom_mode for mode in Mode})
"""Number of modes that clients can distinguish: Descend is shown as Land."""


def modes(rig: Rig, number: int) -> tuple[int, list[Any]]:
    result, messages = rig.command(
        REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_AVAILABLE_MODES, number, 0, 0, 0, 0, 0
    )
    return result, [m for m in messages if m.get_type() == "AVAILABLE_MODES"]


def test_every_mode_that_exists_is_available() -> None:
    result, found = modes(Rig(), 0)
    assert result == ACCEPTED
    assert {m.custom_mode for m in found} == {mode.spec.custom_mode for mode in Mode}
    assert [m.mode_index for m in found] == list(range(1, ON_THE_WIRE + 1))
    assert {m.number_modes for m in found} == {ON_THE_WIRE}
    by_custom = {m.custom_mode: m for m in found}
    hold, land = by_custom[Mode.HOLD.spec.custom_mode], by_custom[Mode.LAND.spec.custom_mode]
    assert (hold.standard_mode, hold.mode_name) == (0, "Hold")
    assert (land.standard_mode, land.mode_name) == (dialect.MAV_STANDARD_MODE_LAND, "")


def test_one_mode_is_asked_for_by_its_number() -> None:
    rig = Rig()
    result, (one,) = modes(rig, 2)
    assert (result, one.mode_index) == (ACCEPTED, 2)
    assert modes(rig, ON_THE_WIRE + 1) == (DENIED, [])


def test_the_current_mode_is_streamed_and_is_one_of_the_available() -> None:
    rig = Rig()
    rig.bench.run(4.0)
    current = [m for m in rig.client.received() if m.get_type() == "CURRENT_MODE"]
    assert len(current) == 2
    assert {m.custom_mode for m in current} <= {mode.spec.custom_mode for mode in AVAILABLE}
    assert current[0].intended_custom_mode == Mode.HOLD.spec.custom_mode


@pytest.mark.parametrize("mode", [mode for mode in AVAILABLE if mode.spec.standard])
def test_a_standard_mode_that_exists_is_changed_to(mode: Mode) -> None:
    rig = Rig()
    rig.command(SET_STANDARD_MODE, mode.spec.standard)
    assert Mode[rig.autopilot.commands[-1].removeprefix("mode ")] is mode


def test_standard_modes_that_are_lacking_are_refused() -> None:
    rig = Rig()
    # Standard modes that no multicopter has: none, cruise, and invalid numbers.
    for number in (0, 3, 9, 99, float("nan")):
        assert rig.command(SET_STANDARD_MODE, number)[0] == FAILED

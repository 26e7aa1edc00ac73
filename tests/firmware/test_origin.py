"""SET_GPS_GLOBAL_ORIGIN: local NED begins elsewhere, and the vehicle stays where it is."""

from __future__ import annotations

import numpy as np
import pytest
from mavsdk.plugins.action import Action

from airl_mav.core.frames import Geodetic, geodetic_to_local, local_to_geodetic
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.mavlink.codec import dialect
from tests.support.flight_rig import Rig
from tests.support.kinematic_autopilot import ORIGIN
from tests.support.mavlink_clients import Rig as LinkRig
from tests.support.mavlink_clients import mavsdk_over_memory
from tests.support.processes import wait_until

ELSEWHERE = local_to_geodetic(np.array([-120.0, 45.0, -30.0]), ORIGIN)
WIRE = tuple(round(value * scale) for value, scale in zip(ELSEWHERE, (1e7, 1e7, 1e3), strict=True))


def place(rig: Rig) -> Geodetic:
    """Return where the vehicle believes to be on the globe."""
    state = rig.ap.state()
    assert state.origin is not None
    return local_to_geodetic(state.estimate.position, state.origin)


def test_the_vehicle_stays_where_it_is_and_flies_as_before() -> None:
    rig = Rig(seed=3)
    rig.run(1.0)
    rig.until(lambda: rig.ap.state().health.armable, 20.0)
    before, home = place(rig), rig.ap.state().home
    origin = rig.ap.state().origin
    assert origin is not None
    there = local_to_geodetic(np.array([200.0, -80.0, 25.0]), origin)
    assert rig.ap.set_origin(there) is Result.ACCEPTED
    state = rig.ap.state()
    assert (state.origin, state.home) == (there, home)
    assert state.estimate.position == pytest.approx([-200.0, 80.0, -25.0], abs=0.5)
    np.testing.assert_allclose(geodetic_to_local(place(rig), before), np.zeros(3), atol=0.1)
    # Sensors agree with it: neither barometer nor GPS pulls it back.
    rig.run(2.0)
    np.testing.assert_allclose(geodetic_to_local(place(rig), before), np.zeros(3), atol=0.5)
    assert rig.ap.arm(force=False) is Result.ACCEPTED
    assert rig.ap.takeoff(5.0) is Result.ACCEPTED
    rig.until(lambda: rig.mode is Mode.HOLD, 20.0)
    assert rig.ap.set_origin(origin) is Result.TEMPORARILY_REJECTED
    assert rig.ap.state().origin == there
    assert rig.ap.set_mode(Mode.RETURN) is Result.ACCEPTED
    rig.until(lambda: not rig.ap.state().motors[0], 90.0)
    assert np.hypot(*rig.truth.position[:2]) < 1.5  # home is where it was


def test_an_origin_that_is_set_before_the_first_fix_is_kept() -> None:
    rig = Rig(seed=3)
    there = local_to_geodetic(np.array([50.0, 0.0, 10.0]), ORIGIN)
    rig.tick()
    assert rig.ap.state().origin is None
    assert rig.ap.set_origin(there) is Result.ACCEPTED
    rig.until(lambda: rig.ap.state().health.armable, 20.0)
    state = rig.ap.state()
    assert state.origin == there
    assert state.home is not None
    np.testing.assert_allclose(
        state.estimate.position, geodetic_to_local(state.home, there), atol=0.5
    )


def test_the_answer_is_the_origin_whoever_was_meant() -> None:
    rig = LinkRig()
    (told,) = [
        m
        for m in rig.exchange(dialect.MAVLink_set_gps_global_origin_message(9, *WIRE))
        if m.get_type() == "GPS_GLOBAL_ORIGIN"
    ]
    assert told.latitude == round(ORIGIN.latitude_deg * 1e7)
    origins = [
        m
        for m in rig.exchange(dialect.MAVLink_set_gps_global_origin_message(1, *WIRE))
        if m.get_type() == "GPS_GLOBAL_ORIGIN"
    ]
    assert {(m.latitude, m.longitude, m.altitude) for m in origins} == {WIRE}
    rig.bench.tick()
    # All other clients receive it, too.
    (other,) = rig.station.received("GPS_GLOBAL_ORIGIN")
    assert (other.latitude, other.longitude, other.altitude) == WIRE


@pytest.mark.parametrize(
    "nowhere",
    [(910_000_000, 0, 0), (0, 1_810_000_000, 0), (0, 0, -13_000_000), (0, 0, 100_000_000)],
)
def test_a_place_that_is_not_on_the_globe_changes_nothing(nowhere: tuple[int, int, int]) -> None:
    rig = LinkRig()
    rig.exchange(dialect.MAVLink_set_gps_global_origin_message(1, *nowhere))
    assert rig.autopilot.origin == ORIGIN


def test_mavsdk_sets_it() -> None:
    with mavsdk_over_memory() as (companion, pacer):
        action = companion.plugin(Action)
        action.set_gps_global_origin(*ELSEWHERE)
        wait_until(lambda: pacer.bench.autopilot.origin != ORIGIN, "another origin", 60.0)
        origin = pacer.bench.autopilot.origin
        assert origin is not None
        np.testing.assert_allclose(geodetic_to_local(origin, ELSEWHERE), np.zeros(3), atol=0.05)

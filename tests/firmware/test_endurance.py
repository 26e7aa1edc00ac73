"""Remaining battery time against the duration of a return."""

from __future__ import annotations

import math

import pytest

from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.failsafes.detectors import AVERAGE_S, Endurance
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.return_to_launch import return_time_s
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.interfaces import BatterySample
from tests.support.flight_rig import flight

VALUE = Parameters({}).__getitem__


def battery(current_a: float, remaining: float) -> BatterySample:
    return BatterySample(15.0, current_a, 0.0, remaining)


def test_the_charge_over_the_mean_current() -> None:
    assert Endurance().update(0, battery(10.0, 0.5), -1.0, 15.0, armed=True) == math.inf
    endurance, later_us = Endurance(), round(AVERAGE_S * 1e6)
    left = battery(30.0, 0.5)
    assert endurance.update(0, left, 3000.0, 15.0, armed=True) == pytest.approx(360.0)
    standing = endurance.update(0, left, 3000.0, 15.0, armed=False)
    assert standing == pytest.approx(360.0)
    after = endurance.update(later_us, left, 3000.0, 15.0, armed=True)
    mean_a = 15.0 + (1.0 - math.exp(-1.0)) * 15.0
    assert after == pytest.approx(1.5 / mean_a * 3600.0)


def test_a_return_climbs_flies_home_and_lands() -> None:
    """3 m/s up, 5 m/s home, 1.5 m/s down. A PX4 1.16 SITL says 104 s in a hover 5.7 m over home."""
    flown_s = 20.0 / 3.0 + 100.0 / 5.0 + 30.0 / 1.5
    assert return_time_s(VALUE, 10.0, 100.0) == pytest.approx(1.1 * flown_s + 100.0)
    assert return_time_s(VALUE, 0.0, 0.0) == pytest.approx(100.0)
    assert int(return_time_s(VALUE, 5.7, 0.0)) == 104


@pytest.mark.parametrize(("capacity", "returns"), [(-1.0, False), (700.0, True)])
def test_a_vehicle_returns_while_the_battery_still_lasts(capacity: float, returns: bool) -> None:
    """700 mAh last 168 s at 15 A; half is too little. Without a capacity there is no estimate."""
    drop = ("battery drop 50% at 14s",)
    # Off by default since PX4 1.17.
    settings = {"BAT1_CAPACITY": capacity, "COM_FLTT_LOW_ACT": 3}
    with flight(1, parameters=settings, faults=drop) as rig:
        rig.take_off(5.0, settle_s=0.0)
        assert not rig.ap.supervisor.conditions.battery_low_remaining_time
        rig.run(10.0)
        assert rig.ap.supervisor.conditions.battery_low_remaining_time is returns
        assert (rig.ap.flight.mode is Mode.RETURN) is returns


def test_a_vehicle_that_could_not_return_is_not_armed() -> None:
    with flight(1, parameters={"BAT1_CAPACITY": 60.0}) as rig:
        rig.run(2.0)
        assert rig.ap.arm(force=False) is not Result.ACCEPTED
        assert any(text == "Remaining flight time low" for _, text in rig.texts)

"""The snapshot that the autopilot gives to MAVLink and the recorder, and its live parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.core.frames import quat_to_euler
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Arming, Landed
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.autopilot.snapshot import AutopilotState
from tests.support.flight_rig import Rig, flight, quad, velocity_setpoint

FIELDS = [name for name, kind in vars(AutopilotState).items() if isinstance(kind, property)]


def arrays(state: AutopilotState) -> list[np.ndarray]:
    """Return the arrays of a state."""
    told = [getattr(state, name) for name in FIELDS]
    parts = [*state.estimate, *state.setpoint, *told]
    return [part for part in parts if isinstance(part, np.ndarray)]


def hovering(rig: Rig) -> AutopilotState:
    rig.take_off(3.0, settle_s=1.0)
    return rig.ap.state()


def test_there_is_no_state_before_the_first_tick() -> None:
    autopilot = BuiltinAutopilot(Parameters(quad().parameters))
    assert autopilot.sample is None
    with pytest.raises(RuntimeError, match="no tick yet"):
        autopilot.state()


def test_a_state_is_that_of_a_tick_and_what_it_told_stays() -> None:
    with flight(2) as rig:
        first = hovering(rig)
        assert rig.ap.state() is first
        assert rig.ap.sample is not None
        assert first.accel is rig.ap.sample.accel
        time_us, told = first.time_us, arrays(first)
        assert len(told) > 15
        kept = np.concatenate(told)
        rig.run(0.2)
        np.testing.assert_array_equal(np.concatenate(told), kept)
        second = rig.ap.state()
        assert second is not first
        assert second.time_us == time_us + 200_000
        assert not np.array_equal(np.concatenate(arrays(second)), kept)


def test_a_state_shows_what_was_ordered_since_the_tick() -> None:
    with flight(2) as rig:
        before = hovering(rig)
        home = before.home
        assert home is not None
        assert (before.status.mode, before.status.landed) == (Mode.HOLD, Landed.IN_AIR)
        rig.ap.set_mode(Mode.LAND)
        after = rig.ap.state()
        assert (after.status.mode, after.status.landed) == (Mode.LAND, Landed.LANDING)
        assert after.time_us == before.time_us
        assert after.home == home
        rig.run(0.5)
        rig.ap.set_home(None)
        moved = rig.ap.state().home
        assert moved is not None
        assert moved.altitude_m > home.altitude_m + 2.0
        rig.ap.disarm(force=True)
        assert rig.ap.state().status.arming is Arming.STANDBY


def test_the_setpoint_is_what_the_controller_tracks() -> None:
    with flight(2) as rig:
        hovering(rig)
        rig.go_offboard(velocity_setpoint(1.0, -0.5, 0.2, yaw=0.3))
        rig.run(3.0)
        state = rig.ap.state()
        assert np.all(np.isnan(state.setpoint.position))
        np.testing.assert_allclose(state.setpoint.velocity, [1.0, -0.5, 0.2])
        assert state.setpoint.yaw == 0.3
        assert math.isnan(state.setpoint.yaw_rate)
        assert quat_to_euler(state.attitude_setpoint).yaw == pytest.approx(0.3, abs=0.05)
        assert state.thrust_setpoint == pytest.approx(np.mean(state.motors), abs=0.02)
        assert state.estimate.sigma.shape == (16,)
        assert state.estimate.innovation_ratio.shape == (4,)


def test_standing_it_tracks_the_place_where_it_stands() -> None:
    with flight(2) as rig:
        rig.boot()
        state = rig.ap.state()
        np.testing.assert_array_equal(state.setpoint.position, state.estimate.position)
        np.testing.assert_array_equal(state.setpoint.velocity, 0.0)
        assert math.isnan(state.setpoint.yaw)
        assert state.motors == (0.0, 0.0, 0.0, 0.0)
        assert state.thrust_setpoint == 0.0


def test_parameters_are_live_in_flight() -> None:
    with flight(2) as rig:
        hovering(rig)
        thrust = rig.ap.state().thrust_setpoint
        rig.ap.parameters.set("MPC_THR_HOVER", 0.8 * rig.ap.parameters["MPC_THR_HOVER"])
        rig.run(0.02)
        assert rig.ap.state().thrust_setpoint < 0.9 * thrust
        rig.ap.parameters.set("MPC_LAND_SPEED", 0.6)
        assert rig.ap.parameters.value("MPC_LAND_SPEED") == 0.6
        assert rig.ap.parameters["MPC_LAND_SPEED"] == 0.6


def test_a_value_is_stored_as_one_fact() -> None:
    parameters = Parameters(quad().parameters)
    for index in range(len(parameters)):
        stored = parameters.by_index(index)
        assert stored is not None
        assert parameters.value(stored.name) == parameters[stored.name] == stored.value
    assert parameters.set("MPC_XY_CRUISE", 1e9) == parameters.by_name("MPC_XY_CRUISE")
    stored = parameters.by_name("MPC_XY_CRUISE")
    assert stored is not None
    assert stored.value == 1e9
    assert parameters.value("MPC_XY_CRUISE") < 1e9  # value in flight
    before = parameters.value("MPC_XY_CRUISE")
    parameters.set("MPC_XY_CRUISE", math.nan)
    assert parameters.value("MPC_XY_CRUISE") == before
    with pytest.raises(KeyError):
        parameters.value("NO_SUCH")

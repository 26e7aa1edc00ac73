"""Any parameter at any end of its range and far beyond, set in flight: motors stay numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from airl_mav.profiles.px4_release import ParameterSpec, px4_release
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.interfaces import ActuatorControls, SensorSample
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.flight_rig import Rig, flight, velocity_setpoint

FAR = 1e9
"""Hardly any parameter has this in its range, and each type holds it."""

SMALL = (0.0, 5e-324, 1e-30)
"""Zero and tiny values: the smallest double, and a number that MAVLink can carry."""

FORWARD = velocity_setpoint(2.0, 1.0, -0.2, yaw=math.nan, yaw_rate=0.5)


def extremes(spec: ParameterSpec) -> list[float]:
    """Return both ends of the flown range, values beyond it, and zero and its neighbours."""
    return list(dict.fromkeys([spec.flown_low, spec.flown_high, -FAR, FAR, *SMALL]))


def fly_on(rig: Rig, seconds: float) -> None:
    """Fly on with MAVLink streaming; every motor command must be a number in 0..1."""
    step = rig.ap.step
    commands: list[ActuatorControls] = []

    def noted(sample: SensorSample) -> ActuatorControls:
        commands.append(step(sample))
        return commands[-1]

    rig.step_through(noted)
    server = MavlinkServer([onboard_link(MemoryEndpoint())], rig.ap, boot_unix_us=0)
    rig.run(seconds, lambda: server.send(rig.sim.time_us))
    rig.step_through(step)
    motors = np.array([c.motors for c in commands])
    assert np.isfinite(motors).all()
    assert motors.min() >= 0.0
    assert motors.max() <= 1.0


def fly_at(rig: Rig, spec: ParameterSpec, value: float) -> None:
    """Fly briefly with a parameter set to a value, at the start of a take-off or in flight."""
    usual = rig.ap.parameters[spec.name]
    rig.ap.parameters.set(spec.name, value)
    fly_on(rig, 0.3)
    rig.ap.parameters.set(spec.name, usual)


USED = [spec for spec in px4_release().specs if spec.is_used]
GROUPS = [USED[i : i + 8] for i in range(0, len(USED), 8)]
AT_ONCE = {"COM_SPOOLUP_TIME": 0.0, "MPC_TKO_RAMP_T": 0.0}


@pytest.mark.nightly
@pytest.mark.parametrize("group", GROUPS, ids=[f"{g[0].name}-{g[-1].name}" for g in GROUPS])
def test_each_parameter_at_the_ends_of_its_range(group: list[ParameterSpec]) -> None:
    with flight(parameters=AT_ONCE) as rig:
        rig.boot()
        cases = [(spec, value) for spec in group for value in extremes(spec)]
        for spec, value in cases:
            # From the ground: filters and integrators restart.
            rig.ap.arm(force=True)
            rig.ap.takeoff(2.0)
            fly_at(rig, spec, value)
            rig.ap.disarm(force=True)
            rig.tick()
        rig.run(1.0)
        rig.take_off(10.0, settle_s=0.0)
        rig.go_offboard(FORWARD)
        for spec, value in cases:
            fly_at(rig, spec, value)


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.LAND, Mode.RETURN, Mode.POSITION, Mode.TAKEOFF])
@pytest.mark.parametrize("end", ["flown_low", "flown_high"])
def test_all_parameters_at_one_end_in_every_mode(mode: Mode, end: str) -> None:
    with flight() as rig:
        rig.take_off(2.0, settle_s=0.0)
        for spec in USED:
            rig.ap.parameters.set(spec.name, getattr(spec, end))
        rig.ap.set_mode(mode)
        fly_on(rig, 3.0)


@settings(
    max_examples=5,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
@given(st.data())
def test_several_parameters_at_once_in_flight(data: st.DataObject) -> None:
    with flight() as rig:
        rig.take_off(2.0, settle_s=0.0)
        rig.go_offboard(FORWARD)
        for spec in data.draw(st.lists(st.sampled_from(USED), min_size=2, max_size=30)):
            rig.ap.parameters.set(spec.name, data.draw(st.sampled_from(extremes(spec))))
        fly_on(rig, 1.0)


def test_a_gyro_filter_made_much_faster_in_flight_does_not_disturb_it() -> None:
    with flight() as rig:
        rig.ap.parameters.set("IMU_GYRO_CUTOFF", 5.0)
        rig.take_off(3.0)
        rig.go_offboard(velocity_setpoint(0.0, 0.0, 0.0, yaw=math.nan, yaw_rate=0.5))
        rig.run(3.0)
        before = np.array(rig.ap.state().motors)
        rig.ap.parameters.set("IMU_GYRO_CUTOFF", 100.0)
        motors = []
        rig.run(0.1, lambda: motors.append(rig.ap.state().motors))
        assert np.abs(np.array(motors) - before).max() < 0.1, "delays of 5 Hz read as of 100 Hz"


@pytest.mark.parametrize("far_m", [1e-160, 5e-324])
def test_arms_without_any_length_on_one_axis_fly(far_m: float) -> None:
    """Set before the flight, as by a vehicle's profile: all four rotors in a line."""
    line = {f"CA_ROTOR{i}_PX": far_m for i in range(4)}
    line |= {f"CA_ROTOR{i}_PY": 100.0 for i in range(4)}
    with flight(parameters=line) as rig:
        rig.arm()
        rig.ap.takeoff(2.0)
        fly_on(rig, 5.0)

"""Payload, computer and pack in flight: plant and twin against closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from airl_mav.core.constants import TICK_S, TICK_US
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.fleet import Fleet, FlightStatus, Rules, hover, new_fleet, vehicle_of
from airl_mav.envs.fleet_step import advance
from airl_mav.profiles.vehicle import Payload, VehicleProfile, load_vehicle, loaded
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.power import PowerModel, flight_power_w
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.plant.plant import Plant
from tests.learning.test_fleet import OPEN

QUAD = load_vehicle("quad")
HEAVY = loaded(QUAD, None, Payload(mass_g=500.0))
AREA_M2 = 4 * math.pi * 0.254**2 / 4
ENDLESS = Rules(goal_radius=0.0, time_limit_us=10**12)
G = 9.80665

Measured = tuple[float, float, float]
"""Initial climb at full throttle [m/s²], power in a hover [W], time until the pack is empty [s]."""


def hover_w(mass_kg: float) -> float:
    return float((mass_kg * G) ** 1.5 / math.sqrt(2 * 1.225 * AREA_M2) / 0.65 / 0.68 + 5.0)


def twin(
    profile: VehicleProfile, computer_w: float = 0.0, charge: float = 1.0
) -> tuple[Fleet, Callable[[int], None]]:
    """Return a hovering vehicle of the simulator, and a function that advances it by ticks."""
    vehicle = vehicle_of(profile, Parameters(profile.parameters).__getitem__, computer_w)
    fleet, arenas = new_fleet(1), batch_of([OPEN])
    hover(fleet, 0, 50.0, vehicle, battery=charge)
    return fleet, lambda ticks: advance(fleet, arenas, np.array([ticks]), vehicle, ENDLESS, None)


def small(profile: VehicleProfile) -> VehicleProfile:
    """Return a vehicle with a pack that lasts about a minute."""
    pack = profile.battery.model_copy(update={"capacity_mah": 200.0, "resistance_ohm": 0.0})
    return profile.model_copy(update={"battery": pack})


def in_the_plant(profile: VehicleProfile) -> Measured:
    plant = Plant(small(profile), None, np.random.default_rng(0))
    full = ActuatorControls(0, (1.0,) * 4, True)
    for _ in range(75):  # ten time constants of the rotors
        plant.step(full)
    speed = plant.truth().velocity[2]
    for _ in range(10):
        plant.step(full)
    climb = (speed - plant.truth().velocity[2]) / (10 * TICK_S)
    # A hover is unstable without control: reset the pose each tick.
    share = profile.body.mass_kg * G / (4 * profile.rotor.thrust_max_n)
    hovering = ActuatorControls(0, (share,) * 4, True)

    def still() -> None:
        plant.put((0.0, 0.0, -50.0))
        plant.step(hovering)

    for _ in range(75):
        still()
    power, at_us, began = plant.power_w, plant.time_us, plant.battery_remaining
    while plant.battery_remaining > 0.5 * began:
        still()
    pack = small(profile).battery
    used_j = pack.energy_j(began) - pack.energy_j(plant.battery_remaining)
    lasts_s = pack.energy_j(1.0) / used_j * (plant.time_us - at_us) / 1e6
    plant.close()
    return climb, power, lasts_s


def in_the_twin(profile: VehicleProfile) -> Measured:
    fleet, fly = twin(small(profile))
    fleet.setpoint[0] = (0.0, 0.0, -3.0, 0.0)
    fleet.repeat_us[0] = 0
    speeds = []
    for _ in range(100):
        fly(1)
        speeds.append((fleet.rotor[0].mean(), fleet.velocity[0, 2]))
    # Its controller decides on the thrust: the acceleration is scaled to full throttle.
    share = float(np.mean([rotor**2 for rotor, _ in speeds[40:80]]))
    climb = -(speeds[79][1] - speeds[39][1]) / (40 * TICK_S)
    climb = (climb + G) / share - G
    fleet, fly = twin(small(profile))
    fly(2500)
    power = fleet.energy[0] / 10.0
    fly(100_000)
    assert fleet.verdict[0] == FlightStatus.BATTERY
    return climb, float(power), float(fleet.time_us[0]) / 1e6


@pytest.mark.parametrize("measure", [in_the_plant, in_the_twin])
def test_500_g_more_climb_slower_take_more_and_last_shorter(
    measure: Callable[[VehicleProfile], Measured],
) -> None:
    for profile, mass_kg in ((QUAD, 1.5), (HEAVY, 2.0)):
        climb, power, lasts_s = measure(profile)
        assert climb == pytest.approx(4 * 7.07 / mass_kg - G, rel=0.05)
        assert power == pytest.approx(hover_w(mass_kg), rel=0.05)
        assert lasts_s == pytest.approx(0.2 * 3600 * 15.4 / hover_w(mass_kg), rel=0.05)
    assert hover_w(2.0) > 1.5 * hover_w(1.5)  # (2 / 1.5)^1.5 = 1.54: it is no small difference


def test_a_computer_of_5000_w_empties_the_pack() -> None:
    fleet, fly = twin(QUAD, computer_w=5000.0)
    fly(20_000)
    assert fleet.verdict[0] == FlightStatus.BATTERY
    # More than the pack can give, E²/4R: the current is P over half the open-circuit voltage, whose
    # mean is 15.4 V.
    lasted_s = fleet.time_us[0] / 1e6
    power = 5000.0 + fleet.energy[0] / lasted_s
    assert lasted_s == pytest.approx(5.2 * 3600 * 15.4 / (2 * power), rel=0.01)
    spared, fly = twin(QUAD)
    fly(int(fleet.time_us[0]) // TICK_US)
    assert spared.verdict[0] == FlightStatus.FLYING
    assert fleet.energy[0] == pytest.approx(spared.energy[0], rel=1e-3)  # of the airframe alone


def test_the_plants_pack_feeds_the_computer() -> None:
    used = []
    for computer_w in (0.0, 100.0, 5000.0):
        plant = Plant(QUAD, None, np.random.default_rng(0), computer_w=computer_w)
        for _ in range(250):
            sample = plant.step(ActuatorControls(0, (0.0,) * 4, True))
        assert plant.power_w == 5.0
        assert sample.battery.voltage_v * sample.battery.current_a >= min(5.0 + computer_w, 3000.0)
        used.append(1.0 - plant.battery_remaining)
        plant.close()
    # One second of 5 and 105 W at 16.8 V, less the drop over the resistance.
    assert used[0] == pytest.approx(5.0 / 16.8 / (5.2 * 3600), rel=0.01)
    assert used[1] == pytest.approx(105.0 / 16.67 / (5.2 * 3600), rel=0.01)
    assert used[2] > 30.0 * used[1]


def test_a_flight_starts_with_the_charge_that_was_asked_for() -> None:
    plant = Plant(QUAD, None, np.random.default_rng(0), aircraft=Aircraft(battery_charge=0.4))
    assert plant.battery_remaining == 0.4
    # 4 cells: 14 V empty, 16.8 V full.
    assert plant.sense().battery.voltage_v == pytest.approx(14.0 + 0.4 * 2.8, abs=0.01)
    plant.close()
    fleet, _ = twin(QUAD, charge=0.4)
    assert fleet.battery[0] == 0.4


def test_a_mass_off_the_centre_turns_the_plant_by_its_weight() -> None:
    """Equal rotors under a mass m at r ahead: about the centre of mass the torque is m g r."""
    profile = loaded(QUAD, None, Payload(mass_g=200.0, forward_m=0.05, right_m=0.03))
    profile = profile.model_copy(
        update={"drag": profile.drag.model_copy(update={"angular_n_m_s": 0.0})}
    )
    plant = Plant(profile, None, np.random.default_rng(0))
    share = profile.body.mass_kg * G / (4 * profile.rotor.thrust_max_n)
    for _ in range(100):
        plant.put((0.0, 0.0, -50.0))
        plant.step(ActuatorControls(0, (share,) * 4, True))
    rates = plant.truth().angular_velocity
    inertia = profile.body.inertia_xx_kg_m2, profile.body.inertia_yy_kg_m2
    # Ahead and to the right: the nose falls, and the right side.
    assert rates[0] == pytest.approx(0.2 * G * 0.03 * TICK_S / inertia[0], rel=0.01)
    assert rates[1] == pytest.approx(-0.2 * G * 0.05 * TICK_S / inertia[1], rel=0.01)
    plant.close()


def test_the_twin_hovers_level_with_a_mass_off_the_centre() -> None:
    fleet, fly = twin(loaded(QUAD, None, Payload(mass_g=200.0, forward_m=0.06, right_m=0.04)))
    fleet.setpoint[0] = 0.0
    for _ in range(20):
        fly(25)
        assert np.abs(fleet.omega[0]).max() < 0.01
        assert np.abs(fleet.velocity[0]).max() < 0.02
    centred, fly = twin(loaded(QUAD, None, Payload(mass_g=200.0)))
    assert fleet.rotor[0].std() > 0.02 > centred.rotor[0].std()


@pytest.mark.nightly
def test_mean_power_does_not_depend_on_how_often_it_is_sampled() -> None:
    """A minute and a half of manoeuvres: 250 Hz against every 5th, 25th, 50th and 250th tick."""
    rng = np.random.default_rng(3)
    fleet, fly = twin(QUAD)
    airframe, model = Airframe.from_profile(QUAD), PowerModel.from_profile(QUAD)
    powers = []
    zero = (0.0, 0.0, 0.0)
    for k in range(90 * 250):
        if k % 371 == 0:  # in step with none of the rates
            fleet.setpoint[0] = rng.uniform([-3, -2, -1, -1.5], [5, 2, 1, 1.5])
            fleet.repeat_us[0] = fleet.time_us[0]
        velocity, q = tuple(fleet.velocity[0]), tuple(fleet.quaternion[0])
        fly(1)
        thrust = 7.07 * float(np.sum(fleet.rotor[0] ** 2))
        powers.append(flight_power_w(thrust, velocity, q, zero, zero, airframe, model))
    whole = float(np.mean(powers))
    assert fleet.energy[0] / 90.0 == pytest.approx(whole, rel=1e-9)
    for every in (5, 25, 50, 250):
        assert float(np.mean(powers[::every])) == pytest.approx(whole, rel=0.02)

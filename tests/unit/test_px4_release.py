"""PX4 releases of the built-in flight controller: data, parameters and options."""

from __future__ import annotations

import csv
import math
from typing import get_args

import pytest

from airl_mav.core.errors import FieldError, UsageError
from airl_mav.profiles.loading import list_profiles, profiles_dir
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName, px4_release
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.autopilot.parameter_store import Parameters
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import Rig

RELEASES: tuple[PX4ReleaseName, ...] = get_args(PX4ReleaseName)


@pytest.mark.parametrize(
    ("release", "roll_p", "dgyro_hz", "auto_yaw_deg_s", "version"),
    [
        # From PX4's parameter references.
        ("1.16", 6.5, 30.0, 45.0, 0x011000FF),
        ("1.17", 4.0, 20.0, 60.0, 0x011100FF),
        ("1.18", 4.0, 20.0, 60.0, 0x011200FF),
    ],
)
def test_a_release_has_its_gains_and_its_version(
    release: PX4ReleaseName, roll_p: float, dgyro_hz: float, auto_yaw_deg_s: float, version: int
) -> None:
    values = load_vehicle("quad", release).flown_parameters()
    assert values["MC_ROLL_P"] == values["MC_PITCH_P"] == roll_p
    assert values["IMU_DGYRO_CUTOFF"] == dgyro_hz
    assert values["MPC_YAWRAUTO_MAX"] == auto_yaw_deg_s
    assert px4_release(release).flight_sw_version == version


@pytest.mark.parametrize("release", RELEASES)
def test_used_parameters_have_finite_bounds_around_the_default(release: PX4ReleaseName) -> None:
    specs = px4_release(release).specs
    assert [spec.name for spec in specs] == sorted({spec.name for spec in specs})
    for spec in specs:
        assert spec.low <= spec.default <= spec.high, spec.name
        assert spec.flown(spec.default) == spec.default, spec.name
        if spec.is_used:
            assert math.isfinite(spec.flown_low + spec.flown_high), spec.name


def test_all_releases_fly_the_same_names() -> None:
    flown = {release: px4_release(release).flown_values({}).keys() for release in RELEASES}
    with (profiles_dir() / "px4" / "effects.csv").open(newline="", encoding="utf-8") as file:
        effects = {row["name"] for row in csv.DictReader(file)}
    for names in flown.values():
        assert effects <= names


def test_a_renamed_parameter_is_set_by_its_name_in_the_release() -> None:
    store = Parameters({}, release="1.16")
    assert store.by_name("MAN_DEADZONE") is None
    assert store.set("MPC_HOLD_DZ", 0.25) is not None
    assert store.value("MAN_DEADZONE") == 0.25
    store.set("MPC_HOLD_DZ", 2.0)
    assert [text.text for text in store.take_texts()] == ["MPC_HOLD_DZ 2 is flown as 0.9"]


def test_a_missing_parameter_is_not_served_but_flown_with_a_default() -> None:
    store = Parameters({}, release="1.17")
    assert store.by_name("MPC_XY_MAN_EXPO") is None
    assert store.set("MPC_XY_MAN_EXPO", 0.0) is None
    assert store.value("MPC_XY_MAN_EXPO") == 0.6


@pytest.mark.parametrize("release", RELEASES)
def test_shipped_vehicles_fly_every_release(release: PX4ReleaseName) -> None:
    for name in list_profiles("vehicles"):
        load_vehicle(name, release)


def test_the_release_of_a_scenario_is_recorded_and_shown() -> None:
    default = resolve(Scenario(level="gym"))
    assert default.vehicle.px4_release == default.config["px4_release"] == CURRENT
    other = resolve(Scenario(level="gym", px4_release="1.16"))
    assert other.config["px4_release"] == "1.16"
    assert other.setup.firmware == "built-in, as PX4 1.16"
    assert other.vehicle.flown_parameters()["MC_ROLL_P"] == 6.5


def test_an_unknown_release_is_one_line() -> None:
    with pytest.raises(FieldError, match=r"px4_release.*1\.15.*accepted.*1\.16.*1\.17.*1\.18"):
        Scenario.model_validate({"px4_release": "1.15"})


def test_a_release_of_real_firmware_is_rejected() -> None:
    asked = {"firmware": "px4", "px4_release": "1.17", "real": {"px4_connect": True}}
    with pytest.raises(FieldError, match=r"px4_release.*accepted: with firmware builtin"):
        resolve(Scenario.model_validate(asked))


def test_a_parameter_that_the_release_lacks_is_one_line() -> None:
    with pytest.raises(UsageError, match=r"MPC_XY_MAN_EXPO: no such parameter in PX4 1\.17"):
        px4_release("1.17").parameter_values({"MPC_XY_MAN_EXPO": 0.5})


@pytest.mark.parametrize(("release", "result"), [("1.17", 0), ("1.18", 3)])
def test_commands_that_a_release_lacks_are_unsupported(
    release: PX4ReleaseName, result: int
) -> None:
    autopilot = KinematicAutopilot()
    autopilot.parameters.release = px4_release(release)
    rig = Rig(autopilot)
    for number in (519, 520, 528):  # PROTOCOL_VERSION, AUTOPILOT_CAPABILITIES, FLIGHT_INFORMATION
        assert rig.command(number, 1)[0] == result
    _, messages = rig.command(512, 148)
    (version,) = [m for m in messages if m.get_type() == "AUTOPILOT_VERSION"]
    assert version.flight_sw_version == px4_release(release).flight_sw_version
    unknown_main_mode = 99
    assert rig.command(176, 1, unknown_main_mode)[0] == {"1.17": 0, "1.18": 1}[release]

"""Profile fields, loading and its errors, the quad's facts, and the parameter store."""

from __future__ import annotations

import math
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import UsageError, shown
from airl_mav.core.fields import ProfileModel, quantity, range_of, unit_of
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.loading import Kind, list_profiles, load_profile, profiles_dir
from airl_mav.profiles.px4_release import ParameterSpec, px4_release
from airl_mav.profiles.vehicle import Momentum, VehicleProfile, load_vehicle
from firmware_sim.autopilot.parameter_store import Parameters

ROOT = Path(__file__).resolve().parents[2]
QUAD_TOML = (ROOT / "profiles" / "vehicles" / "quad.toml").read_text(encoding="utf-8")
SPECS = px4_release().specs
QUAD = load_profile("vehicles", "quad", VehicleProfile)


def numbers(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Walk the numeric fields of a model and of the models inside it."""
    for name, field in model.model_fields.items():
        # Of the two power models the shipped quad has this one.
        kind = Momentum if name == "power" else field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from numbers(kind, f"{prefix}{name}.")
        elif kind in (int, float) or {int, float} & set(get_args(kind)):
            yield prefix + name, field


NUMBERS = dict(numbers(VehicleProfile))
REQUIRED = [path for path, field in NUMBERS.items() if field.is_required()]


def bounds(field: FieldInfo) -> tuple[float, float]:
    """Return the minimum and maximum, read from the constraints."""
    low, high = -math.inf, math.inf
    for bound in field.metadata:
        low = max([low, *(getattr(bound, n) for n in ("ge", "gt") if hasattr(bound, n))])
        high = min([high, *(getattr(bound, n) for n in ("le", "lt") if hasattr(bound, n))])
    return low, high


def edit(path: str, line: str | None) -> str:
    """Return quad.toml with the line of a field replaced; None removes it."""
    table, _, name = path.rpartition(".")
    head = f"[{table}]\n"
    start = QUAD_TOML.index(head) + len(head)
    before, after = QUAD_TOML[:start], QUAD_TOML[start:]
    new = "" if line is None else f"{line}\n"
    changed, count = re.subn(rf"\A((?:[^\[\n].*\n|\n)*?){name} = .*\n", rf"\g<1>{new}", after)
    assert count == 1, path
    return before + changed


def refusal(folder: Path, text: str | bytes) -> str:
    """Load a file that must be rejected; return the message after its name."""
    path = folder / "mine.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UsageError) as error:
        load_profile("vehicles", str(path), VehicleProfile)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


# --- declarations


def test_the_walk_finds_the_fields_of_every_table() -> None:
    assert len(NUMBERS) > 50
    tables = {path.rsplit(".", 1)[0] for path in NUMBERS}
    assert tables >= {"body", "rotor", "drag", "battery", "power", "camera", "sensors.gps"}


@pytest.mark.parametrize("path", NUMBERS)
def test_every_number_has_a_meaning_a_unit_and_a_range(path: str) -> None:
    field = NUMBERS[path]
    assert field.description
    unit = unit_of(field)
    assert unit
    low, high = bounds(field)
    assert math.isfinite(low)
    assert math.isfinite(high)
    assert low < high
    text = range_of(field)
    number = r"-?[\d.]+(?:e[+-]\d+)?"
    match = re.fullmatch(rf"({number}) <=? value <=? ({number})( .+)?", text)
    assert match, text
    assert (float(match[1]), float(match[2])) == (low, high)
    assert (match[3] or " 1") == f" {unit}"


@pytest.mark.parametrize("path", REQUIRED)
def test_the_quads_numbers_lie_inside(path: str) -> None:
    value: object = QUAD
    for part in path.split("."):
        value = getattr(value, part)
    low, high = bounds(NUMBERS[path])
    assert isinstance(value, int | float)
    assert low <= value <= high


def test_ranges_of_open_closed_and_missing_bounds() -> None:
    class Model(ProfileModel):
        both: float = quantity("x", "kg", gt=0, le=10)
        low: float = quantity("x", "m", ge=-2)
        high: float = quantity("x", "1", lt=3)
        none: float = quantity("x", "m")

    fields = Model.model_fields
    assert range_of(fields["both"]) == "0 < value <= 10 kg"
    assert range_of(fields["low"]) == "-2 <= value m"
    assert range_of(fields["high"]) == "value < 3"
    assert range_of(fields["none"]) == ""
    assert Model(both=1, low=0, high=0, none=0).model_config["frozen"]


# --- errors


@pytest.mark.parametrize("path", REQUIRED)
def test_a_number_out_of_range_is_refused_with_its_range(tmp_path: Path, path: str) -> None:
    field = NUMBERS[path]
    name = path.rpartition(".")[2]
    whole = field.annotation is int
    for bound, step in zip(bounds(field), (-1, 1), strict=True):
        value: float = bound + step * max(1.0, abs(bound))
        value = int(value) if whole else float(value)
        message = refusal(tmp_path, edit(path, f"{name} = {value!r}"))
        assert message == f"{path} = {shown(value)}: accepted: {range_of(field)}"


@pytest.mark.parametrize("path", REQUIRED)
def test_a_missing_number_is_named(tmp_path: Path, path: str) -> None:
    assert refusal(tmp_path, edit(path, None)) == f"{path}: missing"


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ('"heavy"', "'heavy'"),
        ('"1.5"', "'1.5'"),
        ("true", "True"),
        ("[1.5]", "[1.5]"),
        ("nan", "nan"),
        ("inf", "inf"),
        ("2020-01-01", "datetime.date(2020, 1, 1)"),
    ],
)
@pytest.mark.parametrize("path", ["body.mass_kg", "battery.cells", "sensors.gps.rate_hz"])
def test_a_value_of_another_type_is_refused(
    tmp_path: Path, path: str, value: str, shown: str
) -> None:
    message = refusal(tmp_path, edit(path, f"{path.rpartition('.')[2]} = {value}"))
    assert message.startswith(f"{path} = {shown}: accepted: ")
    assert range_of(NUMBERS[path]) in message


def test_a_fraction_of_a_cell_is_refused(tmp_path: Path) -> None:
    message = refusal(tmp_path, edit("battery.cells", "cells = 3.5"))
    assert message.startswith("battery.cells = 3.5: accepted: ")


def test_a_whole_number_passes_for_a_float(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(edit("body.mass_kg", "mass_kg = 2"), encoding="utf-8")
    assert load_profile("vehicles", str(path), VehicleProfile).body.mass_kg == 2.0


@pytest.mark.parametrize(
    ("path", "line", "message"),
    [
        ("body.mass_kg", "mas_kg = 1.5", "body.mas_kg: unknown field; did you mean 'mass_kg'?"),
        (
            "sensors.gps.rate_hz",
            "rate_hertz = 5.0",
            "sensors.gps.rate_hertz: unknown field; did you mean 'rate_hz'?",
        ),
        ("drag.angular_n_m_s", "zzz = 1.0", "linear_n_s_m, quadratic_n_s2_m2, angular_n_m_s"),
    ],
)
def test_an_unknown_field_gets_a_suggestion(
    tmp_path: Path, path: str, line: str, message: str
) -> None:
    assert message in refusal(tmp_path, edit(path, line))


def test_an_unknown_table_gets_a_suggestion(tmp_path: Path) -> None:
    text = QUAD_TOML.replace("[battery]", "[batery]")
    assert "batery: unknown field; did you mean 'battery'?" in refusal(tmp_path, text)


def test_a_number_in_place_of_a_table_is_refused(tmp_path: Path) -> None:
    start, end = QUAD_TOML.index("[drag]"), QUAD_TOML.index("[battery]")
    text = "drag = 3\n" + QUAD_TOML[:start] + QUAD_TOML[end:]
    message = refusal(tmp_path, text)
    assert message.startswith("drag = 3: accepted: a table with the fields linear_n_s_m, ")


def test_an_empty_file_misses_everything(tmp_path: Path) -> None:
    message = refusal(tmp_path, "")
    assert re.fullmatch(r"description: missing \(and \d+ more\)", message)


@pytest.mark.parametrize("text", ["[body", "mass_kg = ", "a = 1\na = 2", b"\xff\xfe"])
def test_what_is_no_toml_is_refused(tmp_path: Path, text: str | bytes) -> None:
    assert refusal(tmp_path, text).startswith("not valid TOML: ")


@pytest.mark.parametrize("value", ['"high"', '"0.5"', "true", "[0.5]", "nan"])
def test_a_parameter_that_is_no_number_is_refused(tmp_path: Path, value: str) -> None:
    message = refusal(tmp_path, edit("parameters.MPC_THR_HOVER", f"MPC_THR_HOVER = {value}"))
    assert message.startswith("parameters.MPC_THR_HOVER = ")


# --- finding


@pytest.mark.parametrize("kind", ["vehicles", "computers", "arenas"])
def test_an_unknown_profile_lists_those_that_exist(kind: Kind) -> None:
    shipped = sorted(path.stem for path in (ROOT / "profiles" / kind).glob("*.toml"))
    assert shipped
    assert list_profiles(kind) == shipped
    with pytest.raises(UsageError) as error:
        load_profile(kind, "no-such-thing", VehicleProfile)
    assert "'no-such-thing'" in str(error.value)
    assert ", ".join(shipped) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_path_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="gone") as error:
        load_profile("vehicles", str(tmp_path / "gone.toml"), VehicleProfile)
    assert "quad" in str(error.value)


def test_a_profile_by_path_is_that_file(tmp_path: Path) -> None:
    path = tmp_path / "heavy.toml"
    path.write_text(edit("body.mass_kg", "mass_kg = 2.15"), encoding="utf-8")
    mine = load_profile("vehicles", str(path), VehicleProfile)
    assert mine.body.mass_kg == 2.15
    assert mine.rotor == QUAD.rotor


def test_a_checkout_uses_its_own_profiles() -> None:
    assert profiles_dir() == ROOT / "profiles"


def test_an_installed_package_uses_the_profiles_inside_it(tmp_path: Path) -> None:
    # The layout of the wheel: airl_mav/_profiles, and no profiles/ beside the package.
    site = tmp_path / "site"
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "airl_mav", site / "airl_mav", ignore=ignore)
    shutil.copytree(ROOT / "profiles", site / "airl_mav" / "_profiles")
    vehicles = site / "airl_mav" / "_profiles" / "vehicles"
    (vehicles / "heavy.toml").write_text(edit("body.mass_kg", "mass_kg = 2.15"), encoding="utf-8")
    code = (
        "from airl_mav.profiles.loading import *;"
        "from airl_mav.profiles.vehicle import VehicleProfile;"
        "print(profiles_dir(), load_profile('vehicles', 'heavy', VehicleProfile).body.mass_kg)"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(site)!r}); {code}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.split() == [str(site / "airl_mav" / "_profiles"), "2.15"]


# --- the quad


def test_the_hover_thrust_parameter_carries_the_weight() -> None:
    # Thrust is linear in the command: thrust_curve = 0, PX4's THR_MDL_FAC = 0.
    assert QUAD.rotor.thrust_curve == 0.0
    share = QUAD.body.mass_kg * 9.80665 / (4 * QUAD.rotor.thrust_max_n)
    assert QUAD.parameters["MPC_THR_HOVER"] == pytest.approx(share, abs=0.005)


def test_the_quads_facts() -> None:
    body, rotor, battery, camera = QUAD.body, QUAD.rotor, QUAD.battery, QUAD.camera
    assert 4 * rotor.thrust_max_n / (body.mass_kg * 9.80665) == pytest.approx(1.92, abs=0.01)
    inertia = sorted([body.inertia_xx_kg_m2, body.inertia_yy_kg_m2, body.inertia_zz_kg_m2])
    assert inertia[2] < inertia[0] + inertia[1]  # As for every real body.
    assert body.width_m > 2 * rotor.arm_right_m
    assert battery.cell_empty_v < battery.cell_full_v
    assert (camera.width_px, camera.height_px) == (64, 48)


def test_every_override_is_a_known_parameter_in_range() -> None:
    specs = {spec.name: spec for spec in SPECS}
    assert QUAD.parameters
    store = Parameters(QUAD.parameters)
    for name, value in QUAD.parameters.items():
        assert specs[name].low <= value <= specs[name].high
        assert store[name] == value


# --- the parameter store


def test_defaults_lie_in_their_ranges_and_names_fit_mavlink() -> None:
    store = Parameters()
    assert len(store) == len(SPECS) == len({spec.name for spec in SPECS})
    assert [spec.name for spec in SPECS] == sorted(spec.name for spec in SPECS)
    for index, spec in enumerate(SPECS):
        assert len(spec.name) <= 16
        assert spec.low <= spec.default <= spec.high
        value = store.by_index(index)
        assert value is not None
        assert (value.name, value.value, value.index) == (spec.name, spec.default, index)
        assert store.by_name(spec.name) == value
        assert type(value.value) is type(spec.default)


@pytest.mark.parametrize("index", [-1, len(SPECS), 10_000])
def test_an_index_out_of_range_is_nothing(index: int) -> None:
    assert Parameters().by_index(index) is None


def test_an_unknown_name_is_nothing() -> None:
    store = Parameters()
    assert store.by_name("NO_SUCH") is None
    assert store.set("NO_SUCH", 1.0) is None
    with pytest.raises(KeyError):
        store["NO_SUCH"]


@given(st.sampled_from(SPECS), st.floats(width=32) | st.integers(-(2**31), 2**31 - 1))
def test_a_value_is_stored_as_given_and_flown_in_bounds(spec: ParameterSpec, value: float) -> None:
    store = Parameters()
    heard: list[float] = []
    store.on_change(lambda: heard.append(store[spec.name]))
    stored = store.set(spec.name, value)
    assert stored is not None
    assert type(stored.value) is type(spec.default)
    whole = isinstance(spec.default, int)
    if not math.isfinite(value) or (whole and not -(2**31) <= math.trunc(value) < 2**31):
        assert stored.value == spec.default
        assert heard == []
        return
    assert stored.value == (math.trunc(value) if whole else value)
    assert store.by_name(spec.name) == stored
    flown = store[spec.name]
    assert heard == [flown]  # Once, after the change.
    assert store.value(spec.name) == flown
    off = spec.zero_is_off and stored.value == 0.0
    assert off or spec.flown_low <= flown <= spec.flown_high
    if spec.flown_low <= stored.value <= spec.flown_high:
        assert flown == stored.value


def test_all_of_px4s_parameters_exist_with_their_types() -> None:
    # PX4 lists these two as well once it has checked a mission.
    of_missions = {"MIS_DIST_1WP", "MIS_TKO_LAND_REQ"}
    # And this one with the driver of a GPS receiver.
    specs = [spec for spec in SPECS if spec.name not in of_missions | {"GPS_UBX_DYNMODEL"}]
    assert len(specs) == len(SPECS) - 3
    types = [type(spec.default) for spec in specs]
    assert (types.count(int), types.count(float)) == (281, 583)  # As a PX4 1.17 SITL has them.


def test_what_is_used_has_flown_bounds_that_are_numbers_around_the_default() -> None:
    for spec in SPECS:
        if spec.is_used:
            assert math.isfinite(spec.flown_low), spec.name
            assert math.isfinite(spec.flown_high), spec.name
        assert spec.flown(spec.default) == spec.default, spec.name


def test_that_a_value_is_not_flown_as_stored_is_told_once() -> None:
    store = Parameters()
    store.set("MPC_TILTMAX_AIR", 500.0)
    store.set("MPC_TILTMAX_AIR", 600.0)
    store.set("WV_YRATE_MAX", -1e9)  # Has no effect here: nothing is bounded.
    assert [text.text for text in store.take_texts()] == ["MPC_TILTMAX_AIR 500 is flown as 89"]
    assert store.take_texts() == []
    store.set("MPC_TILTMAX_AIR", 45.0)
    store.set("MPC_TILTMAX_AIR", 700.0)
    assert [text.text for text in store.take_texts()] == ["MPC_TILTMAX_AIR 700 is flown as 89"]


def test_a_filter_is_off_at_zero_and_never_slower_than_can_be_flown() -> None:
    store = Parameters()
    for value, flown in ((0.0, 0.0), (1e-30, 5.0), (-3.0, 5.0), (20.0, 20.0)):
        store.set("IMU_GYRO_CUTOFF", value)
        assert store["IMU_GYRO_CUTOFF"] == flown


def test_a_bound_that_a_float_reaches_is_not_told() -> None:
    store = Parameters()
    single = struct.unpack("<f", struct.pack("<f", 0.1))[0]
    store.set("MC_ROLLRATE_D", single)  # Slightly above 0.1, the maximum.
    assert store.take_texts() == []


def test_reset_returns_to_the_vehicles_values() -> None:
    store = Parameters({"MPC_XY_P": 1.5})
    store.set("MPC_XY_P", 1.0)
    store.set("SDLOG_MODE", 2)
    assert store.changed() == {"MPC_XY_P": 1.0, "SDLOG_MODE": 2}
    store.reset()
    assert store.changed() == {}
    assert store["MPC_XY_P"] == 1.5


def test_stored_values_are_taken_over_as_given_and_the_rest_is_left_out() -> None:
    class Kept:
        def read(self) -> Mapping[str, int | float]:
            return {"MPC_XY_P": 99.0, "NO_SUCH": 1, "SDLOG_MODE": 2**31, "MPC_Z_P": math.nan}

        def write(self, values: Mapping[str, int | float]) -> None:
            raise OSError("a full disk")

    store = Parameters({"MPC_XY_P": 1.5}, Kept())
    assert not store.save()
    assert store.changed() == {"MPC_XY_P": 99.0}
    assert store["MPC_XY_P"] == 2.0


def test_what_a_profile_may_name_is_all_of_px4_in_its_range() -> None:
    assert px4_release().flown_values({"SDLOG_MODE": 2})["SDLOG_MODE"] == 2.0
    assert px4_release().flown_values({"MPC_XY_VEL_MAX": 0.0})["MPC_XY_VEL_MAX"] > 0.0
    for name, value in (("MPC_XY_P", 9.0), ("NO_SUCH", 1), ("SDLOG_MODE", 0.5)):
        with pytest.raises(UsageError, match=f"parameters.{name}"):
            px4_release().flown_values({name: value})


def test_every_listener_hears_every_change() -> None:
    store = Parameters()
    heard: list[str] = []
    store.on_change(lambda: heard.append("a"))
    store.on_change(lambda: heard.append("b"))
    store.set("MPC_XY_P", 1.0)
    store.set("MPC_XY_P", 1.0)
    store.set("NO_SUCH", 1.0)
    assert heard == ["a", "b", "a", "b"]


def test_stores_do_not_share_values() -> None:
    changed, other = Parameters(), Parameters()
    changed.set("MPC_XY_P", 1.5)
    assert other["MPC_XY_P"] == 0.95


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"MPC_THR_HOVR": 0.5}, "parameters.MPC_THR_HOVR: no such parameter in PX4 1.17"),
        (
            {"MPC_THR_HOVER": 0.9},
            "parameters.MPC_THR_HOVER = 0.9: accepted: 0.1 <= value <= 0.8",
        ),
        (
            {"MPC_TILTMAX_AIR": 5},
            "parameters.MPC_TILTMAX_AIR = 5: accepted: 20 <= value <= 89 deg",
        ),
        ({"MPC_XY_P": math.nan}, "parameters.MPC_XY_P = nan: accepted: 0 <= value <= 2"),
    ],
)
def test_a_wrong_override_is_refused_in_one_line(overrides: dict[str, float], message: str) -> None:
    with pytest.raises(UsageError) as error:
        Parameters(overrides)
    assert str(error.value) == message


def test_a_profile_says_only_what_differs_from_its_base(tmp_path: Path) -> None:
    quad = load_profile("vehicles", "quad", VehicleProfile)
    path = tmp_path / "heavy.toml"
    path.write_text('base = "quad"\n[body]\nmass_kg = 1.8\n', encoding="utf-8")
    heavy = load_profile("vehicles", str(path), VehicleProfile)
    assert heavy.body.mass_kg == 1.8
    assert heavy.body.width_m == quad.body.width_m
    assert heavy.model_copy(update={"body": quad.body}) == quad
    second = tmp_path / "second.toml"
    second.write_text(f'base = "{path}"\n[camera]\nrange_m = 15\n', encoding="utf-8")
    both = load_profile("vehicles", str(second), VehicleProfile)
    assert (both.body.mass_kg, both.camera.range_m) == (1.8, 15.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('base = "nothing"', "no vehicle profile 'nothing'"),
        ("base = 3", "base = 3: accepted"),
        ('base = "quad"\n[body]\nmass = 1', "body.mass: unknown field"),
    ],
)
def test_a_wrong_base_gets_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=re.escape(message)):
        load_profile("vehicles", str(path), VehicleProfile)


def test_a_base_that_leads_in_a_circle_is_refused(tmp_path: Path) -> None:
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text(f'base = "{two}"', encoding="utf-8")
    two.write_text(f'base = "{one}"', encoding="utf-8")
    with pytest.raises(UsageError, match="leads back to"):
        load_profile("vehicles", str(one), VehicleProfile)


# --- hostile files


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = " + "[" * 5_000, "nested too deep: accepted: 100 levels"),
        ("x = " + "[" * 200 + "]" * 200, "nested too deep: accepted: 100 levels"),
        ("[" + ".".join("a" * 5_000) + "]", "nested too deep: accepted: 100 levels"),
        ("x = " + "9" * 6_000, "not valid TOML: Exceeds the limit"),
        ("".join(f"k{i} = 1\n" for i in range(400_000)), "at most 1,048,576 bytes"),
        ("".join(f"k{i} = 1\n" for i in range(10_000)), "k0: unknown field; fields: "),
        ("\0", "not valid TOML"),
    ],
    ids=lambda value: value[:12],
)
def test_hostile_files_get_one_line(tmp_path: Path, text: str, words: str) -> None:
    message = refusal(tmp_path, text)
    assert words in message
    assert len(message) < 300


def test_a_long_chain_of_bases_is_refused(tmp_path: Path) -> None:
    for i in range(3_000):
        (tmp_path / f"{i}.toml").write_text(f'base = "{tmp_path / str(i + 1)}.toml"\n')
    assert (
        refusal(tmp_path, f'base = "{tmp_path}/0.toml"')
        == "base: accepted: at most 10 below each other"
    )


def test_a_vehicle_that_cannot_hover_is_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path, edit("body.mass_kg", "mass_kg = 5.0")) == (
        "body.mass_kg = 5: cannot hover: needs 63.74 newton with 30 % margin, has 28.28 "
        "(4 x rotor.thrust_max_n 7.07)"
    )
    path = tmp_path / "light.toml"
    path.write_text(edit("body.mass_kg", "mass_kg = 2.2"))
    assert load_profile("vehicles", str(path), VehicleProfile).thrust_n == 4 * 7.07


def test_a_sensor_that_hardly_ever_samples_is_refused(tmp_path: Path) -> None:
    message = refusal(tmp_path, edit("sensors.barometer.rate_hz", "rate_hz = 5e-324"))
    assert message == "sensors.barometer.rate_hz = 5e-324: accepted: 1 <= value <= 250 Hz"


# --- power models


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('model = "momentum"\n', "", "power.model: missing"),
        ('"momentum"', '"magic"', "power.model = 'magic': accepted: 'momentum', 'regression'"),
        (
            "merit = 0.65",
            "merit = 0.9",
            "power.figure_of_merit = 0.9: accepted: 0.2 <= value <= 0.85",
        ),
        ("avionics_w = 5.0", "", "power.avionics_w: missing"),
        (
            "avionics_w",
            "avionic_w",
            "power.avionic_w: unknown field; did you mean 'avionics_w'? (and 1 more)",
        ),
    ],
)
def test_a_wrong_power_model_is_refused_by_its_own_fields(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert refusal(tmp_path, QUAD_TOML.replace(old, new)) == message


REGRESSION = """
[power]
model = "regression"
b1_vxy = -1.526
b2_axy = 3.934
b3_vxy_axy = 0.968
b4_vz = 18.125
b5_az = 96.613
b6_vz_az = -1.085
b7_payload = 0.220
b8_wind = 1.332
b9_hover = 433.9
"""


def test_a_wrong_coefficient_is_refused_by_its_own_range(tmp_path: Path) -> None:
    text = f'base = "quad"\n{REGRESSION}'.replace("433.9", "-1.0")
    assert refusal(tmp_path, text) == "power.b9_hover = -1: accepted: 0 <= value <= 100000 W"


def test_a_camera_that_sees_all_round_is_a_cylinder(tmp_path: Path) -> None:
    camera = load_vehicle("quad-panorama").camera
    assert (camera.projection, camera.horizontal_fov_deg) == ("cylindrical", 360.0)
    assert Intrinsics.of(camera).horizontal_fov_rad == pytest.approx(2.0 * math.pi)
    # As far up and down as its source says.
    assert math.degrees(math.atan2(20.0, Intrinsics.of(camera).focal)) == pytest.approx(44.5, 0.01)
    for projection, fov, accepted in (
        ("pinhole", 170, "< 170 deg"),
        ("cylindrical", 361, "<= 360"),
    ):
        file = tmp_path / "round.toml"
        table = f'[camera]\nprojection = "{projection}"\nhorizontal_fov_deg = {fov}.0\n'
        file.write_text(f'base = "quad"\n{table}')
        with pytest.raises(UsageError, match=rf"camera.horizontal_fov_deg = {fov}.*{accepted}"):
            load_vehicle(str(file))


def test_a_pinhole_is_written_down_as_it_was_before_there_were_others() -> None:
    camera = load_vehicle("quad").camera
    assert camera.projection == "pinhole"
    assert "projection" not in camera.model_dump()
    assert Camera.model_validate(camera.model_dump()) == camera
    round_ = load_vehicle("quad-panorama").camera
    assert Camera.model_validate_json(round_.model_dump_json()) == round_


def test_a_camera_s_kind_is_one_of_three(tmp_path: Path) -> None:
    camera = load_vehicle("quad-rgb").camera
    assert camera.kind == "rgb"
    assert Camera.model_validate_json(camera.model_dump_json()) == camera
    # Profiles that say nothing of it are written down as before there was colour.
    assert "kind" not in load_vehicle("quad").camera.model_dump()
    file = tmp_path / "mine.toml"
    file.write_text('base = "quad"\n[camera]\nkind = "rgbd"\n')
    with pytest.raises(
        UsageError, match=r"camera.kind = 'rgbd': accepted: 'depth', 'rgb' or 'grey'"
    ):
        load_vehicle(str(file))
    file.write_text('base = "quad-d435"\n[camera]\nkind = "grey"\n')
    with pytest.raises(UsageError, match=r"camera.kind = 'grey': with a table camera.stereo"):
        load_vehicle(str(file))

"""Faults as they are written down, and when they act."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.cli import sitl_command
from airl_mav.cli.options import read_options, scenario_of
from airl_mav.core.constants import TICK_US
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import validated
from airl_mav.faults import (
    FOREVER_US,
    KINDS,
    Fault,
    Part,
    Phase,
    active,
    gust_share,
    next_change_us,
    window_us,
)
from airl_mav.profiles.loading import read_toml
from airl_mav.scenario.model import Scenario, save_scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.stand_alone import StandAloneVehicle, check_vehicle

TIMES = st.floats(min_value=0.0, max_value=99_999.0, allow_nan=False)


@st.composite
def faults(draw: st.DrawFn) -> Fault:
    """Any fault at all."""
    part, kind = draw(st.sampled_from(sorted(KINDS)))
    about = KINDS[part, kind]
    amount = about.amount
    value: list[float] = []
    if amount is not None:
        number = st.floats(min_value=amount.low, max_value=amount.high)
        value = draw(st.lists(number, min_size=amount.width, max_size=amount.width))
    lasts = st.floats(min_value=1e-3, max_value=1e5)
    duration: st.SearchStrategy[float | None] = st.none()
    if about.lasts:
        duration = lasts if about.needs_duration else st.none() | lasts
    return Fault(
        part=part,
        kind=kind,
        value=tuple(value),
        phase=draw(st.none() | st.sampled_from(get_args(Phase))),
        at_s=draw(TIMES),
        for_s=draw(duration),
    )


@given(faults())
def test_words_and_fields_are_the_same_fault(fault: Fault) -> None:
    assert Fault.model_validate(str(fault)) == fault
    assert Fault.model_validate_json(fault.model_dump_json()) == fault


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("gps off at 8s for 5s", "gps off at 8s for 5s"),
        ("gps lost at 800ms", "gps off at 0.8s"),
        ("motor 2 weak 60% at hold+2s", "motor2 weak 0.6 at hold+2s"),
        ("gps jump 20,0,-1 m at offboard", "gps bias 20,0,-1m at offboard"),
        ("baro biased 100Pa", "baro bias 1hPa"),
        ("link loss 20% for 1s at 2s", "link loss 0.2 at 2s for 1s"),
        ("gyro noisy 5x", "gyro noise 5"),
        ("wind gust 6,0,0m/s at climb for 3s", "wind gust 6,0,0m/s at climb for 3s"),
        ("gyro biased 2,-2,0.5deg/s", "gyro bias 2,-2,0.5deg/s"),
        ("battery drop 95% at 3s", "battery drop 0.95 at 3s"),
        ("companion stopped at offboard+1s for 2s", "companion stopped at offboard+1s for 2s"),
        ("firmware killed at hold", "firmware killed at hold"),
    ],
)
def test_what_people_write(written: str, meant: str) -> None:
    assert str(Fault.model_validate(written)) == meant


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("", "no such part"),
        ("gsp off", "no such part; accepted: accel, gyro"),
        ("gps", "no such fault of gps; accepted: off, stuck"),
        ("gps weak", "no such fault of gps"),
        ("motor5 off", "no such part"),
        ("gps off 3m", "gps off has no amount"),
        ("gps bias 1m", "accepted: three numbers, -100000 <= value <= 100000 m"),
        ("gps bias 1,2,3", "written with m"),
        ("gps bias 1,nan,3m", "accepted: three numbers"),
        ("flow bias 1rad/s", "accepted: two numbers, -35 <= value <= 35 rad/s"),
        ("gps noise 0.5x", "accepted: 1 <= value <= 1000"),
        ("gps noise", "none: accepted"),
        ("gps off at 8", "accepted: a time as 8s or 500ms, or a phase"),
        ("gps off at dinner", "accepted: a time"),
        ("gps off at hold+", "gps off"),
        ("gps off at", "accepted: at TIME"),
        ("gps off at 1s at 2s", "stands twice"),
        ("gps off at 1s soon", "accepted: at TIME"),
        ("gps off for 0s", "0 < value"),
        ("gps off at 1e9s", "0 <= value <= 100000 s"),
        ("battery drop 10% for 2s", "happens once"),
        ("wind gust 1,1,1m/s", "it has a duration"),
        ("companion killed for 1s", "happens once"),
        ("companion off", "no such fault of companion; accepted: stopped, killed"),
    ],
)
def test_wrong_words_get_one_line_that_says_what_is_accepted(written: str, said: str) -> None:
    if written == "gps off at hold+":
        assert Fault.model_validate(written).at_s == 0.0
        return
    with pytest.raises(FieldError) as caught:
        validated(Fault, written)
    line = str(caught.value)
    assert said in line
    assert "\n" not in line


# --- in scenarios, files and on the command line

ASKED = ("gps off at 8s for 5s", "motor 2 weak 60% at hold")


def test_faults_of_a_command_line_come_back_from_its_file(tmp_path: Path) -> None:
    words = [word for fault in ASKED for word in ("--fault", fault)]
    asked = scenario_of(read_options(sitl_command.OPTIONS, "airl-sitl", words))
    assert [str(fault) for fault in asked.faults] == [ASKED[0], "motor2 weak 0.6 at hold"]
    file = tmp_path / "scenario.toml"
    save_scenario(asked, file)
    assert "[[faults]]" in file.read_text()
    assert Scenario.model_validate(read_toml(file)).faults == asked.faults
    # More of them on the command line come on top of those in the file.
    more = read_options(sitl_command.OPTIONS, "airl-sitl", [str(file), "--fault", "baro off"])
    assert [fault.part for fault in scenario_of(more).faults] == ["gps", "motor2", "baro"]


def test_a_fault_in_words_is_as_good_as_a_table(tmp_path: Path) -> None:
    file = tmp_path / "scenario.toml"
    file.write_text('faults = ["gps off at 8s for 5s"]\n')
    table = tmp_path / "table.toml"
    table.write_text('[[faults]]\npart = "gps"\nkind = "off"\nat_s = 8.0\nfor_s = 5.0\n')
    both = [Scenario.model_validate(read_toml(each)) for each in (file, table)]
    assert both[0] == both[1]


def test_what_is_wrong_on_a_command_line_names_the_option() -> None:
    with pytest.raises(UsageError, match=r"^--fault: 'gps of': no such fault of gps"):
        read_options(sitl_command.OPTIONS, "airl-sitl", ["--fault", "gps of"])


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"level": "gym", "faults": ["baro off"]}, "faults 'baro off': accepted: at level"),
        (
            {"firmware": "px4", "real": {"px4_connect": True}, "faults": ["link cut"]},
            "with firmware builtin",
        ),
        ({"level": "lockstep", "faults": ["firmware stopped"]}, "accepted: at level sitl"),
        (
            {"firmware": "px4", "real": {"px4_connect": True}, "faults": ["firmware killed"]},
            "with firmware builtin",
        ),
    ],
)
def test_what_a_level_cannot_do_is_refused(fields: dict[str, Any], line: str) -> None:
    with pytest.raises(FieldError, match=line):
        resolve(Scenario.model_validate(fields))


# --- activation times


def fault(text: str) -> Fault:
    return Fault.model_validate(text)


def test_a_window_counts_from_the_start_or_from_the_phase() -> None:
    assert window_us(fault("gps off at 8s for 5s"), {}) == (8_000_000, 13_000_000)
    assert window_us(fault("gps off"), {}) == (0, FOREVER_US)
    later = fault("gps off at hold+2s for 1s")
    assert window_us(later, {}) is None
    assert window_us(later, {"hold": 3_000_000}) == (5_000_000, 6_000_000)


def test_no_simulated_time_passes_while_the_firmware_stands() -> None:
    begin_us, end_us = window_us(fault("firmware stopped at 2.001s for 3s"), {}) or (0, 0)
    assert (begin_us, end_us - begin_us) == (2_001_000, TICK_US)


def test_after_some_faults_of_a_process_nothing_comes() -> None:
    assert fault("companion killed").for_good
    assert fault("companion stopped").for_good
    assert not fault("companion stopped for 3s").for_good
    assert not fault("gps off").for_good


def test_only_a_rehearsal_can_stop_its_processes() -> None:
    asked = StandAloneVehicle(faults=(fault("companion stopped at hold"),))
    with pytest.raises(FieldError, match="in a rehearsal"):
        check_vehicle(asked)


def test_what_acts_is_a_function_of_time_and_phases() -> None:
    asked = [fault("gps off at 8s for 5s"), fault("baro off at hold"), fault("mag off at 9s")]
    entered = {"hold": 9_500_000}
    expected = {7.9: (), 8.0: (0,), 9.2: (0, 2), 9.5: (0, 1, 2), 13.0: (1, 2)}
    for time_s, indices in expected.items():
        assert tuple(active(asked, round(time_s * 1e6), entered)) == indices
    assert next_change_us(asked, 0, {}) == 8_000_000
    assert next_change_us(asked, 9_000_000, entered) == 9_500_000
    assert next_change_us(asked, 13_000_000, entered) == FOREVER_US


def test_a_gust_rises_and_falls() -> None:
    assert gust_share(0.0, 4.0) == pytest.approx(0.0)
    assert gust_share(2.0, 4.0) == pytest.approx(1.0)
    assert gust_share(1.0, 4.0) == pytest.approx(0.5)
    assert gust_share(4.1, 4.0) == 0.0


def test_every_kind_says_what_it_means() -> None:
    assert {part for part, _ in KINDS} == set(get_args(Part))
    for kind in KINDS.values():
        assert kind.meaning
        assert kind.amount is None or kind.amount.low < kind.amount.high

"""The scenario: declared once, read once, the same in a file, as options and in a process."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo
from rich.console import Console

from airl_mav.cli import main, sitl_command
from airl_mav.cli.companion_command import CompanionOptions
from airl_mav.cli.options import read_options
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import unit_of, validated
from airl_mav.profiles.loading import read_toml
from airl_mav.profiles.vehicle import Payload, WindSettings
from airl_mav.rehearsal.run_folder import load
from airl_mav.scenario.model import Scenario, anchored, save_scenario
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from airl_mav.scenario.stand_alone import StandAloneCompanion, StandAloneVehicle
from tests.support.processes import ROOT

# --- the model


def fields_of(model: type[BaseModel], table: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yield all fields with their dotted names, including fields of tables."""
    for name, field in model.model_fields.items():
        yield f"{table}{name}", field
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from fields_of(kind, f"{name}.")


@pytest.mark.parametrize("model", [Scenario, StandAloneVehicle, StandAloneCompanion])
def test_every_field_has_a_meaning_and_every_number_its_unit(model: type[BaseModel]) -> None:
    for name, field in fields_of(model):
        assert field.description, name
        assert not field.is_required(), name
        kinds = {field.annotation, *get_args(field.annotation)}
        # The pace of the stand-alone vehicle is a number or "max"; a goal is two numbers.
        if kinds & {int, float} and name not in ("speed", "goal"):
            assert unit_of(field), name


def test_options_are_unique_without_their_tables() -> None:
    """--px4-dir stands for real.px4_dir: no other table has a field of that name."""
    names = [
        name.rpartition(".")[2]
        for model in (Scenario,)
        for name, _ in fields_of(model)
        if not name.startswith("wind.")
    ]
    assert len(names) == len(set(names))


# --- resolution

BUSY: dict[str, Any] = {
    "policy": "greedy",
    "latency": "lognormal:396ms,20.125ms",
    "hold_s": 0.1,
    "arena_seed": 7,
    "wind": {"north_m_s": 1 / 3, "gust_m_s": 0.1},
    "watchdog": {"hover_after_s": 0.06},
    "real": {"firmware_dir": "kept"},
}


@pytest.mark.parametrize(
    "fields",
    [{}, BUSY, {"level": "lockstep", "computer": "ras-pi-4", "workload": "template-5x32"}],
    ids=["default", "busy", "lockstep"],
)
def test_a_resolved_scenario_survives_json_bit_by_bit(fields: dict[str, Any]) -> None:
    resolved = resolve(Scenario.model_validate(fields))
    adapter = TypeAdapter(ResolvedScenario)
    text = adapter.dump_json(resolved)
    again = adapter.validate_json(text)
    assert again == resolved
    assert adapter.dump_json(again) == text
    # Both sides of the pipe derive the same settings.
    assert (again.companion_pilot, again.setup, again.rules) == (
        resolved.companion_pilot,
        resolved.setup,
        resolved.rules,
    )
    for native in (False, True):
        here = resolved.latency_sampler(3, native=native)
        there = again.latency_sampler(3, native=native)
        if here is None:
            assert there is None
            continue
        assert there is not None
        assert [here.sample_us() for _ in range(50)] == [there.sample_us() for _ in range(50)]


READS = """
import sys
from collections import Counter
from pathlib import Path

opened = Counter()

def note(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, Path)):
        path = Path(arguments[0])
        if path.suffix in (".toml", ".json", ".onnx") and "profiles" in path.parts[:-2]:
            opened["/".join(path.parts[-2:])] += 1

sys.addaudithook(note)
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

resolved = resolve(Scenario(policy="static-obstacles", level="lockstep", time_limit_s=3.0,
                            computer="ras-pi-4", workload="template-5x32"))
for name in ("vehicles/quad.toml", "arenas/static-obstacles.toml", "computers/ras-pi-4.toml",
             "static-obstacles/card.json"):
    assert opened.pop(name) == 1, (name, opened)
del opened["static-obstacles/policy.onnx"]
assert not opened, opened
fly(resolved, resolved.fresh_policy(1), 0, 1)
assert not opened, opened
"""


@pytest.mark.nightly
def test_profiles_and_card_are_read_once_and_never_in_flight(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", READS],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=170,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"hold_s": 3.0}, "watchdog.decision_timeout_s 2: accepted: more than the hold time, 3 s"),
        ({"ablate": "depth"}, "ablate 'depth': accepted: at level gym or lockstep"),
        ({"speed": 20.0}, "speed 20: accepted: 0.5 <= value <= 10 at level sitl"),
        ({"tlogs": True}, "tlogs True: accepted: at level lockstep"),
        ({"workers": 2}, "workers 2: accepted: at level gym or lockstep"),
        ({"ports": {"camera_port": 0}}, "ports.camera_port 0: accepted: 1 <= value <= 65535"),
        ({"ports": {"gcs_port": 14540}}, "ports.gcs_port 14540: accepted: another than that of"),
        ({"firmware": "px4"}, "firmware 'px4': accepted: with px4_dir or px4_connect"),
        (
            {"firmware": "px4", "level": "gym", "real": {"px4_dir": "px4"}},
            "firmware 'px4': accepted: at level lockstep or sitl",
        ),
        (
            {"firmware": "ardupilot", "level": "lockstep", "real": {"ardupilot_connect": True}},
            "firmware 'ardupilot': accepted: at level sitl; at level lockstep only builtin and px4",
        ),
        ({"real": {"serial": "x"}}, "real.serial 'x': accepted: with firmware px4-hitl"),
        ({"policy": "greedy", "ablate": "depth", "level": "gym"}, "ablate 'depth': accepted: for"),
    ],
    ids=lambda value: str(value)[:50],
)
def test_fields_that_contradict_each_other_are_named(fields: dict[str, Any], line: str) -> None:
    with pytest.raises(FieldError) as refused:
        resolve(validated(Scenario, fields))
    assert str(refused.value).startswith(line)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--hold-s", "3"], "--decision-timeout-s 2: accepted: more than the hold time, 3 s"),
        (["--ablate", "depth"], "--ablate depth: accepted: at level gym or lockstep"),
        (["--firmware", "px4"], "--firmware px4: accepted: with --px4-dir or --px4-connect"),
        (["--level", "gym"], "--level gym: accepted: lockstep or sitl"),
        (["--wind.gust-m-s", "99"], "--wind.gust-m-s 99: accepted: 0 <= value <= 50 m/s"),
        (["--serial", "/dev/ttyX"], "--serial /dev/ttyX: accepted: with firmware px4-hitl"),
    ],
    ids=" ".join,
)
def test_options_that_contradict_each_other_are_named(
    words: list[str],
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["airl-sitl", *words])
    with pytest.raises(SystemExit) as end:
        main.sitl()
    out, err = capsys.readouterr()
    assert (end.value.code, out) == (2, "")
    assert err.startswith(f"error: {line}")
    assert list(tmp_path.iterdir()) == []


# --- files


def options(*words: str) -> sitl_command.SitlOptions:
    return read_options(sitl_command.SitlOptions, "airl-sitl", words)


def read_file(path: Path) -> Scenario:
    return validated(Scenario, read_toml(path), path)


def test_a_scenario_survives_its_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    for fields in ({}, BUSY):
        scenario = Scenario.model_validate(fields)
        save_scenario(scenario, path)
        assert read_file(path) == anchored(scenario)


def test_paths_in_the_file_of_a_run_are_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for file in ("pi.txt", "mine/card.json", "static-obstacles/card.json"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    fields = {"vehicle": "v.toml", "arena": "static-obstacles", "latency": "pi.txt"}
    here = {"vehicle": f"{tmp_path}/v.toml", "latency": f"{tmp_path}/pi.txt"}
    for policy, absolute in (
        ("mine", f"{tmp_path}/mine"),
        ("static-obstacles", "static-obstacles"),
        ("mine.py:Pilot", f"{tmp_path}/mine.py:Pilot"),
    ):
        saved = anchored(Scenario(**fields, policy=policy))
        assert saved == Scenario(**fields | here | {"policy": absolute})
    for latency, absolute in (
        ("80ms", "80ms"),
        ("ras-pi-4/template-5x32", "ras-pi-4/template-5x32"),
        ("pi.toml/fast", f"{tmp_path}/pi.toml/fast"),
    ):
        assert anchored(Scenario(latency=latency)).latency == absolute


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"episodes": 0}, "episodes 0: accepted: 1 <= value <= 100000"),
        ({"wind": {"north_m_s": 99}}, "wind.north_m_s 99: accepted: -50 <= value <= 50 m/s"),
        ({"goal_radius_m": 0.1}, "goal_radius_m 0.1: accepted: 0.2 <= value <= 50 m"),
        ({"episode": 3}, "episode: unknown field; did you mean 'episodes'?"),
    ],
)
def test_a_wrong_field_is_told_in_one_line(fields: dict[str, Any], line: str) -> None:
    with pytest.raises(FieldError) as refused:
        Scenario(**fields)
    assert str(refused.value) == line


def test_options_lie_over_the_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        'policy = "greedy"\nepisodes = 7\nhold_s = 0.3\n[wind]\nnorth_m_s = 2.0\n[ports]\n'
        "gcs_port = 15000\n"
    )
    asked = options(str(path), "--episodes", "2", "--wind.east-m-s", "1")
    assert (asked.policy, asked.episodes, asked.hold_s) == ("greedy", 2, 0.3)
    assert (asked.wind.north_m_s, asked.wind.east_m_s) == (2.0, 1.0)
    assert asked.ports.gcs_port == 15000


def test_a_companion_has_its_options_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "companion.toml"
    path.write_text(
        'start = "offboard"\ngoal = [30.0, -5.0]\nblack_box = "/flights"\n'
        "[limits]\nradius_m = 40.0\n"
    )
    asked = read_options(CompanionOptions, "airl-companion", [str(path), "--limits.height-m", "9"])
    assert (asked.start, asked.goal, asked.black_box) == (
        "offboard",
        (30.0, -5.0),
        Path("/flights"),
    )
    assert (asked.limits.radius_m, asked.limits.height_m) == (40.0, 9.0)
    path.write_text("[limits]\nradius_m = -1\n")
    with pytest.raises(UsageError) as refused:
        read_options(CompanionOptions, "airl-companion", [str(path)])
    assert str(refused.value).startswith(f"{path}: limits.radius_m = -1: accepted: 0 < value")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("episodes = 0", "episodes = 0: accepted: 1 <= value <= 100000"),
        ("episodes = [", "not valid TOML: "),
        ("episode = 3", "episode: unknown field; did you mean 'episodes'?"),
        ("[wind]\nnorth_m_s = 99", "wind.north_m_s = 99: accepted: -50 <= value <= 50 m/s"),
        ('[watchdog]\nhover_after_s = "soon"', "watchdog.hover_after_s = 'soon': accepted: 0 <= "),
        ('level = "hil"', "level = 'hil': accepted: 'gym', 'lockstep' or 'sitl'"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_errors_in_a_file_name_it_and_the_field(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    reads: list[Callable[[], object]] = [
        lambda: read_file(path),
        lambda: options(str(path)),
    ]
    for read in reads:
        with pytest.raises(UsageError) as refused:
            read()
        assert str(refused.value).startswith(f"{path}: {line}")
        assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nowhere\.toml: No such file"):
        options(str(tmp_path / "nowhere.toml"))


def test_contradictions_in_a_file_name_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("hold_s = 3.0\n")
    monkeypatch.setattr(sys, "argv", ["airl-sitl", str(path)])
    with pytest.raises(SystemExit) as end:
        main.sitl()
    assert end.value.code == 2
    assert capsys.readouterr().err.startswith(
        f"error: {path}: watchdog.decision_timeout_s = 2: accepted: more than the hold time, 3 s"
    )


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_scenario_of_a_run_flies_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sitl_command, "conclude", lambda *_: 0)
    out, console = [tmp_path / "first", tmp_path / "again"], Console(quiet=True)
    words = ("--level", "lockstep", "--episodes", "1", "--seed", "11", "--time-limit-s", "5")
    assert (
        sitl_command.run(options(*words, "--latency", "80ms", "--out", str(out[0])), console) == 0
    )
    assert (
        sitl_command.run(options(str(out[0] / "scenario.toml"), "--out", str(out[1])), console) == 0
    )
    first, again = (load(path) for path in out)
    assert first.episodes[0].sha256 is not None
    assert first.episodes == again.episodes
    assert first.info.config == again.info.config


def test_the_facts_of_a_report_name_the_conditions_that_are_not_the_defaults() -> None:
    plain = resolve(Scenario(level="gym")).setup
    assert plain.conditions == ""
    windy = Scenario(
        level="gym", battery_charge=0.5, wind=WindSettings(east_m_s=4.0), payload=Payload(mass_g=50)
    )
    told = resolve(windy).setup.conditions
    assert told == "payload.mass_g 50, wind.east_m_s 4, battery_charge 0.5"


# --- the arena


def test_movers_are_at_the_same_places_when_navigation_begins_at_every_level() -> None:
    twin, lockstep = (
        resolve(Scenario(level=level, arena="dynamic-obstacles", policy="greedy", altitude_m=4.0))
        for level in ("gym", "lockstep")
    )
    assert twin.takeoff_s == 0.0
    assert lockstep.takeoff_s == pytest.approx(9.2 + 4.0 / 1.5)
    begins, after_takeoff = twin.arena_of(3), lockstep.arena_of(3)
    assert begins.tours
    takeoff_us = round(lockstep.takeoff_s * 1e6)
    for time_us in (0, 1_000_000, 70_000_000):
        there, here = after_takeoff.centers_at(takeoff_us + time_us), begins.centers_at(time_us)
        assert abs(there - here).max() < 3e-6  # From a microsecond of rounding, at 2.5 m/s.

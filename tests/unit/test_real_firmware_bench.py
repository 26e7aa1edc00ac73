"""Bench of real firmware: its table, and its choice of firmware; nothing is flown."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from airl_mav.core.errors import UsageError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def bench() -> Any:
    """The script as a module."""
    spec = importlib.util.spec_from_file_location(
        "real_firmware", ROOT / "scripts/real_firmware.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def answer(name: str, outcome: str, *, agrees: bool = True) -> dict[str, Any]:
    return {"name": name, "outcome": outcome, "agrees": agrees, "value": None}


def test_calls_that_only_one_firmware_answers_are_not_comparable(bench: Any) -> None:
    real = [answer("a", "ok"), answer("b", "TIMEOUT"), answer("c", "ok"), answer("d", "no ack")]
    builtin = [
        answer("a", "ok"),
        answer("b", "ok"),
        answer("c", "ok", agrees=False),
        answer("d", "TIMEOUT"),
        answer("e", "ok"),
    ]
    found = bench.agreement(real, builtin)
    assert (found.calls, found.comparable, found.agree) == (4, 3, 1)
    assert [each.partition(":")[0] for each in found.differences] == ["b", "c", "d"]


def step(latency_s: float, overshoot_percent: float) -> dict[str, float]:
    rest = dict.fromkeys(("t10_s", "t50_s", "error", "settle_s"), 0.0)
    return {"latency_s": latency_s, "rise_s": 1.0, "overshoot_percent": overshoot_percent, **rest}


def steps(north_2: dict[str, float]) -> dict[str, Any]:
    return {kind: {"north-2": north_2} for kind in ("true", "estimated")}


def test_a_step_is_shown_with_its_difference(bench: Any) -> None:
    real, builtin = {"north-2": step(0.22, 5.0)}, {"north-2": step(0.20, 3.5)}
    latency, rise, overshoot = bench.step_rows(real, builtin)
    assert (latency.real, latency.builtin) == ("220 ms (+10.0 %)", "200 ms")
    assert rise.real == "1000 ms (+0.0 %)"
    assert (overshoot.real, overshoot.builtin) == ("5.0 % (+1.5 points)", "3.5 %")
    assert bench.step_rows(real, None)[0] == bench.Row("north-2 latency", "220 ms")


def test_versions_of_px4_and_ardupilot(bench: Any) -> None:
    px4 = bench.version_of(0x01110180, bytes.fromhex("bacdaf15fefa5f15"))
    assert px4 == {"version": "1.17.1 beta", "number": 0x01110180, "git": "155ffafe15"}
    copter = bench.version_of(0x04070000, b"c0ffee12")
    assert (copter["version"], copter["git"]) == ("4.7.0 dev", "c0ffee12")


def test_a_firmware_without_a_part_has_a_dash(bench: Any, tmp_path: Path) -> None:
    px4, copter = bench.Firmware("1.17", "px4", tmp_path), bench.Firmware("copter", "ardupilot")
    builtin = bench.Firmware("builtin")
    version = {"version": "1.17.0", "number": 0x011100FF, "git": "abc"}
    checks = [
        {"name": "arm", "outcome": "pass"},
        {"name": "land", "outcome": "fail", "finding": "x"},
    ]
    for name, part, data in (
        ("1.17", "identity", version),
        ("1.17", "steps", steps(step(0.22, 5.0))),
        ("builtin", "steps", steps(step(0.20, 3.5))),
        ("copter", "identity", version),
        ("copter", "conformance", {"checks": checks}),
        ("builtin", "conformance", {"checks": checks[:1]}),
    ):
        file = tmp_path / name / f"{part}.json"
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps(data))
    text = bench.report(tmp_path, [px4, copter], {"1.17": builtin, "copter": builtin})
    lines = text.splitlines()
    assert lines[0] == "| figure | 1.17 | builtin | copter | builtin |"
    assert "| north-2 latency | 220 ms (+10.0 %) | 200 ms | – | – |" in lines
    assert "| conformance checks | – | – | 1 of 2: land | 1 of 1 |" in lines
    assert "- copter: land: x" in lines
    data = json.loads((tmp_path / "drift.json").read_text())
    assert data["1.17"]["rows"][0]["real"] == "1.17.0 (abc)"
    assert data["parts"]["builtin"]["steps"]["true"]["north-2"]["latency_s"] == 0.20
    (judged,) = [row for row in data["1.17"]["rows"] if row["figure"].startswith("steps beyond")]
    assert "north-2 latency in ms 220, stored" in judged["real"]


def test_the_built_in_one_has_the_nearest_release(bench: Any, tmp_path: Path) -> None:
    for number, release in ((0x010E03FF, "1.16"), (0x01110080, "1.17"), (0x011400FF, "1.18")):
        (tmp_path / "px4").mkdir(exist_ok=True)
        (tmp_path / "px4" / "identity.json").write_text(json.dumps({"number": number}))
        found = bench.builtin_for(tmp_path, bench.Firmware("px4", "px4", tmp_path))
        assert found.options == ["--px4-release", release]
    assert bench.builtin_for(tmp_path, bench.Firmware("copter", "ardupilot")).path is None


def test_a_test_of_a_later_release_is_left_out(bench: Any) -> None:
    data = {
        "tests": [
            {"name": "land", "passed": True, "since": [0, 0]},
            {"name": "jump", "passed": False, "since": [1, 18]},
        ]
    }
    assert bench.tests_of(data, 0x011100FF) == {"land": True}
    assert bench.tests_of(data, 0x01120000) == {"land": True, "jump": False}


@pytest.mark.parametrize("word", ["px4", "=/opt/px4", "a=", "builtin=/opt/px4"])
def test_a_firmware_has_a_name_and_a_path(bench: Any, tmp_path: Path, word: str) -> None:
    with pytest.raises(UsageError, match="accepted: NAME=PATH"):
        bench.firmware_of(word, tmp_path)


def test_a_folder_without_firmware(bench: Any, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no bin/px4.*arducopter"):
        bench.firmware_of(f"mine={tmp_path}", tmp_path)


def test_arducopter_is_found_by_its_program(bench: Any, tmp_path: Path) -> None:
    program = tmp_path / "arducopter"
    program.touch(mode=0o755)
    assert bench.firmware_of(f"copter={program}", tmp_path).kind == "ardupilot"


def test_what_is_flown_is_not_flown_again(bench: Any, tmp_path: Path) -> None:
    flown: list[str] = []

    def part(_command: Any, firmware: Any) -> dict[str, Any]:
        flown.append(firmware.name)
        if len(flown) == 1:
            raise bench.PartError("lost")
        return {"n": 1}

    command = bench.Command((), out=tmp_path)
    bench.PARTS["walk"], kept = (part, ("px4",)), bench.PARTS["walk"]
    try:
        firmware = bench.Firmware("1.17", "px4", tmp_path)
        assert not bench.fly_part(command, firmware, "walk")
        assert bench.fly_part(command, firmware, "walk")
        assert bench.fly_part(command, firmware, "walk")
        assert bench.fly_part(command, bench.Firmware("copter", "ardupilot"), "walk")
    finally:
        bench.PARTS["walk"] = kept
    assert flown == ["1.17", "1.17"]
    assert bench.results_of(tmp_path, firmware) == {"walk": {"n": 1}}

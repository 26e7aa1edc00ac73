"""Unusable input: one line with the accepted values, exit code 2, nothing left behind."""

from __future__ import annotations

import errno
import math
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from airl_mav.cli import list_command, main
from airl_mav.core.first_start import compile_first
from airl_mav.profiles.loading import Kind, list_profiles, profiles_dir
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import plan_of, resolve
from tests.support.ports import LOOPBACK, choose_ports
from tests.support.processes import ROOT
from tests.support.run_demo import write_demo_run

Entry = Callable[[], None]
Run = Callable[..., str]


@pytest.fixture
def refuse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Run:
    """Run a command that must refuse its options; return its one line of error."""

    def run(command: Entry, *options: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["airl", *options])
        before = sorted(tmp_path.iterdir())
        with pytest.raises(SystemExit) as end:
            command()
        out, err = capsys.readouterr()
        assert end.value.code == 2
        assert out == ""
        assert "Traceback" not in err
        (line,) = err.splitlines()
        assert line.startswith("error: ")
        assert sorted(tmp_path.iterdir()) == before, "a folder was left behind"
        return line

    return run


@pytest.mark.parametrize(
    ("option", "kind"),
    [("--vehicle", "vehicles"), ("--arena", "arenas"), ("--computer", "computers")],
)
def test_unknown_profile_lists_those_that_exist(refuse: Run, option: str, kind: Kind) -> None:
    line = refuse(main.sitl, option, "zeppelin")
    assert "'zeppelin'" in line
    for name in list_profiles(kind):
        assert name in line


def test_unknown_policy_and_workload_list_those_that_exist(refuse: Run) -> None:
    assert "greedy" in refuse(main.sitl, "--policy", "telepathy")
    line = refuse(main.sitl, "--computer", "ras-pi-4", "--workload", "chess")
    for name in ("'chess'", "template-5x32", "template-4x48", "template-7x32"):
        assert name in line
    assert "greedy" in refuse(main.companion, "--policy", "telepathy")
    assert "template-5x32" in refuse(
        main.companion, "--computer", "ras-pi-4", "--workload", "chess"
    )
    assert "quad" in refuse(main.firmware, "--vehicle", "zeppelin")
    assert "static-obstacles" in refuse(main.firmware, "--arena", "zeppelin")


def test_bad_toml_names_file_field_and_range(refuse: Run, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("description = [", encoding="utf-8")
    line = refuse(main.sitl, "--arena", str(path))
    assert str(path) in line
    assert "not valid TOML" in line
    shipped = (profiles_dir() / "vehicles" / "quad.toml").read_text(encoding="utf-8")
    path.write_text(shipped.replace("mass_kg = 1.5", "mass_kg = -1.5"), encoding="utf-8")
    line = refuse(main.sitl, "--vehicle", str(path))
    for part in (str(path), "body.mass_kg = -1.5", "accepted: ", "value"):
        assert part in line
    assert "body.mass_kg" in refuse(main.firmware, "--vehicle", str(path))
    path.write_text(shipped.replace("mass_kg", "mas_kg"), encoding="utf-8")
    assert "mas_kg" in refuse(main.sitl, "--vehicle", str(path))


def test_arena_that_cannot_be_made_is_refused_before_anything_starts(
    refuse: Run, tmp_path: Path
) -> None:
    # A first start compiles kernels, which its output says.
    compile_first([plan_of(resolve(Scenario()))])
    path = tmp_path / "crammed.toml"
    path.write_text(
        """description = "two hundred pillars in a cupboard"
[size]
north_m = 20.0
east_m = 20.0
[start]
north_m = 3.0
east_m = 10.0
[static]
count = [200, 200]
""",
        encoding="utf-8",
    )
    assert "error: " in refuse(main.sitl, "--arena", str(path))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--speed", "0"], ["--speed 0:", "0.01 <= value <= 1000"]),
        (["--speed", "-1"], ["--speed -1:"]),
        (["--speed", "0.3"], ["--speed 0.3:", "0.5 <= value <= 10"]),
        (["--speed", "20"], ["--speed 20:"]),
        (["--speed", "nan"], ["--speed nan:"]),
        (["--speed", "inf"], ["--speed inf:"]),
        (["--episodes", "0"], ["--episodes 0:", "1 <= value"]),
        (["--seed", "-1"], ["--seed -1:", "0 <= value <= 2147483648"]),
        (["--seed", str(2**31 + 1)], ["--seed 2147483649:"]),
        (["--hold-s", "-0.5"], ["--hold-s -0.5:", "0 <= value <= 10"]),
        (["--hold-s", "2.0"], ["--decision-timeout-s 2:", "more than the hold time, 2 s"]),
        (["--altitude-m", "0"], ["--altitude-m 0:"]),
        (["--goal-radius-m", "0"], ["--goal-radius-m 0:"]),
        (["--time-limit-s", "0"], ["--time-limit-s 0:"]),
        (["--decision-timeout-s", "-1"], ["--decision-timeout-s -1:", "0.1 <= value <= 60"]),
        (["--decision-timeout-s", "nan"], ["--decision-timeout-s nan:"]),
        (["--leave-after-s", "0"], ["--leave-after-s 0:"]),
        (["--hover-after-s", "-0.1"], ["--hover-after-s -0.1:"]),
        (["--wind.gust-time-s", "0"], ["--wind.gust-time-s 0:"]),
        (["--wind.north-m-s", "1000"], ["--wind.north-m-s 1000:"]),
        (["--wind.random-m-s", "-1"], ["--wind.random-m-s -1:", "0 <= value <= 50 m/s"]),
        (["--spread.mass", "1"], ["--spread.mass 1:", "0 <= value <= 0.9"]),
        (
            ["--spread.mass", "0.3", "--spread.thrust", "0.35"],
            ["--spread.thrust 0.35:", "needs 24.86 newton", "has 18.38 (4 x", "4.5955)"],
        ),
        (["--sensors.navigation-noise", "11"], ["--sensors.navigation-noise 11:", "value <= 10"]),
        (["--sensors.depth-dropout", "-1"], ["--sensors.depth-dropout -1:", "value <= 0.9"]),
        (["--api-port", "65536"], ["--api-port 65536:", "value <= 65535"]),
        (["--api-port", "0"], ["--api-port 0:"]),
        (["--api-local-port", "-1"], ["--api-local-port -1:"]),
        (["--gcs-port", "70000"], ["--gcs-port 70000:"]),
        (["--gcs-port", "14540"], ["--gcs-port 14540:", "another than that of the onboard API"]),
        (["--gcs-local-port", "70000"], ["--gcs-local-port 70000:"]),
        (["--camera-port", "70000"], ["--camera-port 70000:"]),
        # The companion has to know it.
        (["--camera-port", "0"], ["--camera-port 0:", "1 <= value <= 65535"]),
    ],
    ids=" ".join,
)
def test_sitl_options(refuse: Run, options: list[str], words: list[str]) -> None:
    line = refuse(main.sitl, *options)
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--speed", "0"], ["--speed 0:", "0 < value <= 100"]),
        (["--speed", "nan"], ["--speed nan:"]),
        (["--speed", "1000"], ["--speed 1000:"]),
        (["--seed", "-1"], ["--seed -1:"]),
        (["--duration", "-1"], ["--duration -1:"]),
        (["--wind.gust-m-s", "-1"], ["--wind.gust-m-s -1:"]),
        (["--camera-port", "65536"], ["--camera-port 65536:", "0 <= value <= 65535"]),
        (["--api-port", "65536"], ["--api-port 65536:"]),
        (["--api-local-port", "65536"], ["--api-local-port 65536:"]),
        (["--gcs-local-port", "65536"], ["--gcs-local-port 65536:"]),
        (["--tlog", "nowhere/flight.tlog"], ["--tlog nowhere/flight.tlog", "no folder nowhere"]),
        (["--bind", "0.0.0.0"], ["0.0.0.0:14580", "--insecure"]),  # noqa: S104
        (["--bind", "everywhere"], ["'everywhere'", "IPv4"]),
        (["--camera-key", "nowhere"], ["--camera-key nowhere: cannot be read"]),
        (["--companion-host", "192.168.1.20"], ["192.168.1.20:14540", "--insecure"]),
        # The other link is bound before, to a free port: another simulator may be running.
        (
            ["--gcs-host", "192.168.1.20", "--api-local-port", "0"],
            ["192.168.1.20:14550", "--insecure"],
        ),
    ],
    ids=" ".join,
)
def test_firmware_options(refuse: Run, options: list[str], words: list[str]) -> None:
    line = refuse(main.firmware, *options)
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--speed", "0"], ["--speed 0:", "0.1 <= value <= 100"]),
        (["--speed", "nan"], ["--speed nan:"]),
        (["--seed", "-1"], ["--seed -1:"]),
        (["--hold-s", "-1"], ["--hold-s -1:"]),
        (["--hold-s", "5"], ["--decision-timeout-s 2:", "more than the hold time, 5 s"]),
        (["--goal", "nan", "0"], ["--goal nan:"]),
        (["--altitude-m", "-3"], ["--altitude-m -3:"]),
        (["--max-speed-m-s", "0"], ["--max-speed-m-s 0:"]),
        (["--goal-radius-m", "0"], ["--goal-radius-m 0:"]),
        (["--decision-timeout-s", "0"], ["--decision-timeout-s 0:"]),
        (["--leave-after-s", "1000"], ["--leave-after-s 1000:"]),
        (["--hover-after-s", "nan"], ["--hover-after-s nan:"]),
        (["--connect-timeout", "0"], ["--connect-timeout 0:"]),
        (["--log", "nowhere/log.npz"], ["--log nowhere/log.npz", "no folder nowhere"]),
        (["--camera", "tcp://127.0.0.1:70000"], ["--camera tcp://127.0.0.1:70000", "1..65535"]),
        (["--camera", "tcp://127.0.0.1"], ["--camera tcp://127.0.0.1", "tcp://HOST:PORT"]),
        (["--camera", "smoke"], ["--camera smoke:", "tcp://HOST:PORT"]),
        (
            ["--camera", "tcp://192.168.1.2:5600"],
            ["--camera tcp://192", "--camera-key, or --insec"],
        ),
        (["--camera", "tcp://simulator:5600"], ["--camera tcp://sim", "--camera-key, or --insec"]),
        (["--camera-key", "nowhere"], ["--camera-key nowhere: cannot be read"]),
        (
            ["--camera", "realsense", "--camera-key", "nowhere"],
            ["--camera-key nowhere", "ZeroMQ address"],
        ),
        (["--system-id", "0"], ["--system-id 0:", "1 <= value <= 255"]),
        (["--system-id", "256"], ["--system-id 256:", "1 <= value <= 255"]),
        (["--connect", "pigeon://loft"], ["--connect pigeon://loft", "udpin://HOST:PORT"]),
        (["--connect", "udpin://127.0.0.1:70000"], ["--connect udpin://127.0.0.1:70000"]),
    ],
    ids=" ".join,
)
def test_companion_options(refuse: Run, options: list[str], words: list[str]) -> None:
    line = refuse(main.companion, *options)
    for word in words:
        assert word in line


def test_off_loopback_is_refused_for_the_camera_too(refuse: Run) -> None:
    """Nothing is bound before the refusal: the camera's port stays free."""
    ports = choose_ports()
    refuse(main.firmware, "--bind", "0.0.0.0", *ports.options())  # noqa: S104
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind((LOOPBACK, ports.camera))


def test_used_folder_is_refused_and_left_alone(refuse: Run, tmp_path: Path) -> None:
    folder = tmp_path / "old"
    folder.mkdir()
    (folder / "run.json").write_text("{}", encoding="utf-8")
    assert "schema = None: accepted: 1" in refuse(main.sitl, "--out", str(folder))
    assert (folder / "run.json").read_text(encoding="utf-8") == "{}"
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert "--out" in refuse(main.sitl, "--out", str(tmp_path / "file" / "run"))


def test_report_of_nothing(refuse: Run, tmp_path: Path) -> None:
    assert "no run here" in refuse(main.airl, "report", str(tmp_path))


@pytest.mark.parametrize("damage", ["flipped", "empty", "nested"])
def test_report_of_a_damaged_run(refuse: Run, tmp_path: Path, damage: str) -> None:
    folder, _ = write_demo_run(tmp_path / "run", episodes=2)
    latency, info = folder.path / "latency.npz", folder.path / "run.json"
    if damage == "flipped":
        data = bytearray(latency.read_bytes())
        data[len(data) // 3] ^= 1
        latency.write_bytes(data)
    elif damage == "empty":
        latency.write_bytes(b"")
    else:
        info.write_text('{"schema": 1, "config": ' + "[" * 100_000, encoding="utf-8")
    line = refuse(main.airl, "report", str(folder.path))
    assert str(info if damage == "nested" else latency) in line


def test_a_full_disk_is_the_machines_failure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", "run/latency.npz")

    monkeypatch.setattr(list_command, "run", full)
    monkeypatch.setattr(sys, "argv", ["airl", "list"])
    with pytest.raises(SystemExit) as end:
        main.airl()
    assert end.value.code == 1
    assert capsys.readouterr().err == "error: run/latency.npz: No space left on device\n"


@pytest.mark.parametrize("command", ["sitl", "firmware", "companion"])
def test_real_process_says_one_line(tmp_path: Path, command: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", f"airl_mav.cli.{command}_command", "--speed", str(math.nan)],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: --speed nan: accepted: ")
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []

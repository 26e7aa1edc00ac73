"""`airl profile`: what it measures, what it writes, and what flies from it afterwards."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from ports import choose_ports
from processes import ROOT
from rich.console import Console
from test_companion_light import BLOCK

from airl_mav.cli import profile
from airl_mav.cli.companion_command import CompanionCommand, sampler
from airl_mav.cli.profile_command import ProfileCommand
from airl_mav.cli.profile_plan import planned
from airl_mav.cli.profile_report import correlation_line, verdict
from airl_mav.errors import UsageError
from airl_mav.latency.stages import STAGES
from airl_mav.machine_state import MachineState
from airl_mav.ports import Ports
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.computer_file import existing_profile, write_profile
from airl_mav.profiles.loading import list_profiles

SMALL = {"network": "2x4", "image": "64x48"}


def profiled(command: ProfileCommand) -> str:
    """Run the command; return what it printed."""
    console = Console(file=io.StringIO(), width=200, force_terminal=False)
    assert profile.run(command, console) == 0
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert isinstance(printed, str)
    return printed


def bare(out: Path, **options: object) -> ProfileCommand:
    given = {"on": "box", "out": out, "decisions": 80, "warm_up": 5, **options}
    return ProfileCommand(**given)  # type: ignore[arg-type]


def test_profile_flies(tmp_path: Path) -> None:
    printed = profiled(bare(tmp_path))
    path = tmp_path / "box.toml"
    computer = load_computer(str(path))
    work = computer.workloads["static-obstacles-bare"]
    stamps = np.load(tmp_path / "box.static-obstacles-bare.npz")
    took_us = stamps["action_ready_us"] - stamps["infer_start_us"]
    assert all(stamps[key].dtype == np.int64 for key in stamps.files)
    assert len(took_us) == 80
    # In their order, as the replay wants them.
    assert work.latency.samples_ms == tuple(took_us / 1000.0)
    assert "--computer" in printed
    assert f"{path} --workload static-obstacles-bare" in printed
    command = CompanionCommand(computer=str(path), workload="static-obstacles-bare")
    drawn = sampler(command, 1)
    assert drawn is not None
    assert {drawn.sample_us() for _ in range(80)} == set(took_us.tolist())
    # This very policy on that computer: found by its digest, in a rehearsal.
    found = sampler(CompanionCommand(computer=str(path), control="stdio"), 1)
    assert found is not None


def test_what_is_said(tmp_path: Path) -> None:
    printed = profiled(bare(tmp_path))
    assert "this computer adds" in printed
    assert "396 ms" in printed
    assert "--network 5x32 --image 256x154" in printed
    assert "the first 5 decisions of a flight" in printed
    assert "first inference" in printed
    row = next(line for line in printed.splitlines() if "t2 infer" in line)
    assert row.count("too few") == 2  # p99, p99.9 of 80
    assert "autocorrelation of t2" in printed
    assert "governor" in printed


def test_other_workloads_are_kept(tmp_path: Path) -> None:
    profiled(bare(tmp_path, watts=6.4, price=80.0))
    profiled(bare(tmp_path, decisions=30, workload="again"))
    computer = load_computer(str(tmp_path / "box.toml"))
    assert list(computer.workloads) == ["static-obstacles-bare", "again"]
    assert len(computer.workloads["static-obstacles-bare"].latency.samples_ms or ()) == 80
    assert len(computer.workloads["again"].latency.samples_ms or ()) == 30
    assert (computer.watts, computer.price_usd) == (6.4, 80.0)
    assert "not measured" not in computer.source


def test_power_that_nobody_gave_is_said_to_be_unknown(tmp_path: Path) -> None:
    profiled(bare(tmp_path))
    held = load_computer(str(tmp_path / "box.toml"))
    assert held.watts == 0.0
    assert "watts: not measured" in held.source
    profiled(bare(tmp_path, watts=5.0))
    later = load_computer(str(tmp_path / "box.toml"))
    assert later.watts == 5.0
    assert "watts: not measured" not in later.source


def test_facts_beside_the_samples(tmp_path: Path) -> None:
    profiled(bare(tmp_path))
    facts = json.loads((tmp_path / "box.static-obstacles-bare.json").read_text())
    assert facts["schema"] == 1
    assert facts["command"]["decisions"] == 80
    assert facts["stages_us"]["t2"]["n"] == 80
    assert facts["stages_us"]["t2"]["p99"] is None
    assert facts["first_us"] > 0
    assert set(facts["before"]) == set(facts["after"])


def test_random_network_needs_no_policy(tmp_path: Path) -> None:
    printed = profiled(bare(tmp_path, **SMALL))
    work = load_computer(str(tmp_path / "box.toml")).workloads["template-2x4-64x48-bare"]
    assert (work.network.layers, work.network.filters) == (2, 4)
    assert (work.network.image_width_px, work.network.image_height_px) == (64, 48)
    assert work.policy_sha256 is None
    assert "airl evaluate POLICY --computer" in printed


def test_every_shipped_profile_is_written_as_it_was_read(tmp_path: Path) -> None:
    for name in list_profiles("computers"):
        path = tmp_path / f"{name}.toml"
        write_profile(path, load_computer(name))
        assert load_computer(str(path)) == load_computer(name)


def test_paper_network_has_its_size() -> None:
    paper = load_computer("ras-pi-4").workloads["template-5x32"].network
    from airl_mav.policy.template import template_size

    assert template_size(5, 32, 154, 256, 25) == (paper.parameters, paper.macs)


def test_verdict_follows_the_measurement(tmp_path: Path) -> None:
    with planned(bare(tmp_path)) as plan:
        assert verdict(plan, np.full(1000, 100)).startswith("this computer adds no gap for")
        assert "0.02% of its decision period of 0.5 s" in verdict(plan, np.full(1000, 100))
        assert verdict(plan, np.full(1000, 20_000)).startswith("this computer adds a small gap")
        assert verdict(plan, np.full(1000, 396_000)).startswith("this computer adds a gap for")
        # A rare stall is not hidden behind the median: the p99 decides.
        rare = np.full(1000, 100)
        rare[::50] = 400_000
        assert verdict(plan, rare).startswith("this computer adds a gap for")


def test_runs_of_slow_decisions_are_seen() -> None:
    rng = np.random.default_rng(1)
    noise = rng.integers(1_000, 2_000, 1_000)
    assert "hardly matters" in correlation_line(noise)
    runs = noise + 1_000 * (np.arange(1_000) // 20 % 2)
    assert "the order of the samples matters" in correlation_line(runs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": "telepathy"}, "no such policy; known: greedy"),
        ({"policy": "greedy"}, "POLICY greedy: has no network"),
        ({"policy": "static-obstacles", "network": "2x4"}, "accepted: one of them"),
        ({"network": "five"}, "--network five: accepted: LAYERSxFILTERS"),
        ({"network": "0x32"}, "--network 0x32: accepted"),
        ({"network": "2x4", "image": "big"}, "--image big: accepted: WIDTHxHEIGHT"),
        ({"network": "2x4", "image": "4000x4"}, "width_px = 4000: accepted: 4 <= value <= 640"),
        ({"network": "20x256", "image": "640x480"}, "parameters; accepted: at most 475,000,000"),
        ({"network": "2x4", "image": "50x50", "level": "sitl"}, "--image 50x50: vehicle"),
        ({"network": "2x4", "runtime": "torch"}, "--runtime torch with --network: accepted: onnx"),
        ({"decisions": 5}, "--decisions 5: accepted: 10 <= value"),
        ({"warm_up": 0}, "--warm-up 0: accepted: 1 <= value"),
        ({"on": "../x"}, "--on '../x': accepted: letters"),
        ({"watts": -1.0}, "--watts -1: accepted"),
        ({"vehicle": "quad-256x144"}, "--vehicle quad-256x144: camera"),
    ],
)
def test_what_cannot_be_used(tmp_path: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=re.escape(message)):
        profile.run(bare(tmp_path, **options), Console(file=io.StringIO()))
    assert not list(tmp_path.iterdir())


def test_file_of_another_machine_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "box.toml"
    write_profile(path, load_computer("ras-pi-4"))
    before = path.read_bytes()
    with pytest.raises(UsageError, match=r"Cortex-A72.*accepted: another --on or --out"):
        profile.run(bare(tmp_path), Console(file=io.StringIO()))
    assert path.read_bytes() == before
    assert existing_profile(path, "4 x Arm Cortex-A72, 1.5 GHz") is not None


LIGHT = """
import sys
from airl_mav.cli import main
sys.argv = ["airl", *sys.argv[1:]]
main.main()
"""


def in_light_install(tmp_path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run `airl` where only the companion's installation is there."""
    # A learned policy needs ONNX Runtime, which the light installation has.
    block = BLOCK.replace("'onnxruntime', ", "")
    absent = "\nimport importlib.util as u\nfound = u.find_spec\n" + (
        "def find_spec(name, package=None):\n"
        "    try:\n"
        "        return found(name, package)\n"
        "    except ImportError:\n"
        "        return None\n"
        "u.find_spec = find_spec\n"
    )
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", absent + block + LIGHT, *words],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "HOME": str(tmp_path), "COLUMNS": "120"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_light_installation_measures(tmp_path: Path) -> None:
    done = in_light_install(tmp_path, "profile", "--decisions", "20", "--on", "pi")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "computers/pi.toml").exists()


def test_light_installation_has_help(tmp_path: Path) -> None:
    for words in ([], ["profile"], ["evaluate"], ["train"]):
        done = in_light_install(tmp_path, *words, "--help")
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        (["evaluate", "static-obstacles"], "sim"),
        (["arena"], "sim"),
        (["profile", "--network", "2x4"], "profile"),
        (["profile", "--level", "sitl"], "sim"),
    ],
)
def test_light_installation_says_what_to_install(
    tmp_path: Path, words: list[str], extra: str
) -> None:
    done = in_light_install(tmp_path, *words)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: not installed: ")
    assert line.endswith(f"pip install 'airl-mav[{extra}]'")
    assert not list(tmp_path.iterdir())


def test_interrupted_profile_writes_nothing(tmp_path: Path) -> None:
    words = [sys.executable, "-u", "-m", "airl_mav.cli.main", "profile"]
    process = subprocess.Popen(
        [*words, "--decisions", "100000", "--out", str(tmp_path / "out")],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    assert "profile" in process.stdout.readline()
    assert "network" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    rest = process.communicate(timeout=60)[0]
    assert process.returncode == 130, rest
    assert "interrupted: nothing was written" in rest
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.xdist_group("flight")
def test_stages_in_flight(tmp_path: Path) -> None:
    free = choose_ports()
    ports = Ports(
        api_port=free.api,
        api_local_port=free.api_local,
        gcs_port=free.gcs,
        gcs_local_port=free.gcs_local,
        camera_port=free.camera,
    )
    command = bare(tmp_path, level="sitl", decisions=70, warm_up=10, ports=ports)
    printed = profiled(command)
    stamps = np.load(tmp_path / "box.static-obstacles-sitl.npz")
    assert len(stamps["sent_us"]) == 70
    order = [stamps[stage.start] for stage in STAGES[:6]]
    assert all((later >= sooner).mean() > 0.95 for sooner, later in pairwise(order))
    held = stamps["held_until_us"] - stamps["sent_us"]
    assert (held >= 50_000).mean() > 0.95
    assert (np.diff(stamps["sent_us"]) >= 50_000).mean() > 0.95
    assert "link" in printed
    assert "timing was measured, not flying well" in printed
    assert "static-obstacles-sitl" in load_computer(str(tmp_path / "box.toml")).workloads


def test_busy_machine_is_said_to_be_so() -> None:
    idle = MachineState(None, None, None, None, None, (0.1, 3.0, 3.0))
    assert profile.busy_remark(idle, 2) is None
    assert profile.busy_remark(replace(idle, load=None), 2) is None
    remark = profile.busy_remark(replace(idle, load=(8.5, 0.0, 0.0)), 2)
    assert remark is not None
    assert "load average 8.50 on 2 usable cores" in remark


@pytest.mark.slow
@pytest.mark.xdist_group("flight")
def test_on_the_drones_computer(tmp_path: Path) -> None:
    free = choose_ports()
    words = [sys.executable, "-m", "airl_mav.cli.firmware", "--arena", "no-obstacles"]
    with (tmp_path / "firmware.log").open("wb") as log:
        firmware = subprocess.Popen(
            [*words, *free.options()],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=log,
            stderr=log,
        )
        try:
            command = bare(
                tmp_path,
                level="hil",
                decisions=70,
                warm_up=10,
                connect=f"udpin://127.0.0.1:{free.api}",
                camera=f"tcp://127.0.0.1:{free.camera}",
            )
            printed = profiled(command)
        finally:
            firmware.terminate()
            firmware.wait(30)
    stamps = np.load(tmp_path / "box.static-obstacles-hil.npz")
    # Nothing relates the simulator's clock to ours: what lies between them is not written down.
    assert "capture_us" not in stamps.files
    assert "motor_us" not in stamps.files
    assert len(stamps["sent_us"]) == 70
    assert "t1, link, control and end to end were not measured" in printed
    facts = json.loads((tmp_path / "box.static-obstacles-hil.json").read_text())
    counts = {key: stage["n"] for key, stage in facts["stages_us"].items()}
    assert (counts["t2"], counts["t3"], counts["period"]) == (70, 70, 69)
    assert (counts["t1"], counts["link"], counts["end_to_end"]) == (0, 0, 0)

"""`airl profile`: measurements, output files, and flights with the measured profile."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from airl_mav.addons.profiling import hil
from airl_mav.addons.profiling import profile as command
from airl_mav.addons.profiling.hil import Exchanges
from airl_mav.addons.profiling.measurement import ProfileRequest, Recording
from airl_mav.addons.profiling.profile import busy_remark, profile
from airl_mav.addons.profiling.report import verdict
from airl_mav.cli.options import read_options, run_command
from airl_mav.core.clock import WallClock
from airl_mav.core.errors import UsageError
from airl_mav.core.machine import MachineState
from airl_mav.latency.injection import latency_generator
from airl_mav.latency.stages import STAGES
from airl_mav.latency.stamps import DecisionLog
from airl_mav.policy.registry import find_policy
from airl_mav.profiles.computer import existing_profile, load_computer, write_profile
from airl_mav.profiles.loading import list_profiles
from airl_mav.scenario.checks import select_latency
from airl_mav.scenario.model import DEFAULT_POLICY, Lateness
from companion.pilot import MissionResult
from tests.support.ports import choose_ports
from tests.support.processes import ROOT, allow_interrupt
from tests.unit.test_companion_light import BLOCK
from tests.unit.test_machine_power import ORIN_NX
from tests.unit.test_machine_state import write

SMALL = ("--network", "2x4", "--image", "64x48")


def profiled(out: Path, *words: str) -> str:
    """Run the command; return what it printed."""
    printed = io.StringIO()
    console = Console(file=printed, width=200, force_terminal=False)
    few = ("--decisions", "80", "--warm-up", "5")
    given = ("--on", "box", "--out", str(out), *few, *words)
    assert command.run(read_options(command.OPTIONS, "airl profile", given), console) == 0
    return printed.getvalue()


def test_profile_flies(tmp_path: Path) -> None:
    printed = profiled(tmp_path)
    path = tmp_path / "box.toml"
    computer = load_computer(str(path))
    work = computer.workloads[f"{DEFAULT_POLICY}-bare"]
    stamps = np.load(tmp_path / f"box.{DEFAULT_POLICY}-bare.npz")
    took_us = stamps["action_ready_us"] - stamps["infer_start_us"]
    assert all(stamps[key].dtype == np.int64 for key in stamps.files)
    assert len(took_us) == 80
    # In their order, as the replay wants them.
    assert work.latency.samples_ms == tuple(took_us / 1000.0)
    assert "--computer" in printed
    assert f"{path} --workload {DEFAULT_POLICY}-bare" in printed
    policy = find_policy(DEFAULT_POLICY)
    asked = Lateness(computer=str(path), workload=f"{DEFAULT_POLICY}-bare")
    drawn = select_latency(asked, policy, on_this_computer=True).sampler(latency_generator(1, 0))
    assert drawn is not None
    assert {drawn.sample_us() for _ in range(80)} == set(took_us.tolist())
    # This very policy on that computer: found by its digest, in a rehearsal.
    found = select_latency(Lateness(computer=str(path)), policy, on_this_computer=False)
    assert found.latency == work.latency


def test_python_api_measures_without_a_word(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    request = ProfileRequest(decisions=30, warm_up=5, on="box")
    measured = profile(request)
    assert capfd.readouterr() == ("", "")
    assert measured.files == ()
    assert measured.t2_us.dtype == np.int64
    assert len(measured.t2_us) == 30
    samples_ms = measured.profile.workloads[measured.workload].latency.samples_ms
    assert samples_ms == tuple(measured.t2_us / 1000.0)
    written = profile(request, out=tmp_path)
    assert [path.name for path in written.files] == [
        "box.toml",
        *(f"box.{DEFAULT_POLICY}-bare{end}" for end in (".txt", ".npz", ".json")),
    ]
    assert load_computer(str(written.files[0])) == written.profile


def test_what_is_said(tmp_path: Path) -> None:
    printed = profiled(tmp_path)
    assert "this computer adds" in printed
    assert "396 ms" in printed
    assert "--network 5x32 --image 256x154" in printed
    assert "the first 5 decisions of a flight" in printed
    assert "first inference" in printed
    row = next(line for line in printed.splitlines() if "t2 infer" in line)
    assert row.count("too few") == 2  # p99, p99.9 of 80
    assert "governor" in printed


def test_other_workloads_are_kept(tmp_path: Path) -> None:
    profiled(tmp_path, "--watts", "6.4", "--price-usd", "80")
    profiled(tmp_path, "--decisions", "30", "--workload", "again")
    computer = load_computer(str(tmp_path / "box.toml"))
    assert list(computer.workloads) == [f"{DEFAULT_POLICY}-bare", "again"]
    assert len(computer.workloads[f"{DEFAULT_POLICY}-bare"].latency.samples_ms or ()) == 80
    assert len(computer.workloads["again"].latency.samples_ms or ()) == 30
    assert (computer.watts, computer.price_usd) == (6.4, 80.0)
    assert "not measured" not in computer.source
    assert "not known" not in computer.source


def test_power_that_nobody_gave_is_said_to_be_unknown(tmp_path: Path) -> None:
    profiled(tmp_path)
    held = load_computer(str(tmp_path / "box.toml"))
    assert held.watts == 0.0
    assert "watts: not measured" in held.source
    profiled(tmp_path, "--watts", "5")
    later = load_computer(str(tmp_path / "box.toml"))
    assert later.watts == 5.0
    assert "watts: not measured" not in later.source


def test_facts_beside_the_samples(tmp_path: Path) -> None:
    profiled(tmp_path)
    facts = json.loads((tmp_path / f"box.{DEFAULT_POLICY}-bare.json").read_text())
    assert facts["schema"] == 1
    assert facts["command"]["decisions"] == 80
    assert facts["stages_us"]["t2"]["n"] == 80
    assert facts["stages_us"]["t2"]["p99"] is None
    assert facts["first_us"] > 0
    assert set(facts["before"]) == set(facts["after"])


def test_random_network_needs_no_policy(tmp_path: Path) -> None:
    printed = profiled(tmp_path, *SMALL)
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
    from airl_mav.policy.card_writing import template_size

    assert template_size(5, 32, 154, 256, 25) == (paper.parameters, paper.macs)


def test_verdict_follows_the_measurement() -> None:
    card = find_policy("static-obstacles").card
    assert card is not None
    assert verdict(card, np.full(1000, 100)).startswith("this computer adds no gap for")
    assert "0.02% of its decision period of 0.5 s" in verdict(card, np.full(1000, 100))
    assert verdict(card, np.full(1000, 20_000)).startswith("this computer adds a small gap")
    assert verdict(card, np.full(1000, 396_000)).startswith("this computer adds a gap for")
    # A rare stall is not hidden behind the median: the p99 decides.
    rare = np.full(1000, 100)
    rare[::50] = 400_000
    assert verdict(card, rare).startswith("this computer adds a gap for")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["telepathy"], "no such policy; known: greedy"),
        (["greedy"], "greedy: accepted: a learned policy"),
        (["static-obstacles", "--network", "2x4"], "accepted: either a policy or a network"),
        (["--network", "five"], "--network five: accepted: a text that matches"),
        (["--network", "0x32"], "--network 0x32: accepted"),
        (["--network", "2x4", "--image", "big"], "--image big: accepted: a text that matches"),
        (["--network", "2x4", "--image", "4000x4"], "width_px = 4000: accepted: 4 <= value <= 640"),
        (["--network", "20x256", "--image", "640x480"], "accepted: at most 475,000,000"),
        (["--network", "2x4", "--image", "50x50", "--level", "sitl"], "50x50: vehicle"),
        (["--network", "2x4", "--runtime", "torch"], "--runtime torch: accepted: onnx"),
        (["--decisions", "5"], "--decisions 5: accepted: 10 <= value"),
        (["--warm-up", "0"], "--warm-up 0: accepted: 1 <= value"),
        (["--hold-s", "2"], "--hold-s 2: accepted: 0 <= value <= 1 s"),
        (["--on", "../x"], "--on ../x: accepted"),
        (["--watts", "-1"], "--watts -1: accepted"),
        (["--soak", "long"], "--soak long: accepted: 10s to 24h, as 90s, 10min or 1h"),
        (["--soak", "9.9s"], "--soak 9.9s: accepted: 10s to 24h"),
        (["--soak", "25h"], "--soak 25h: accepted: 10s to 24h"),
        (["--vehicle", "quad-256x144"], "--vehicle quad-256x144: camera"),
    ],
)
def test_what_cannot_be_used(
    tmp_path: Path, words: list[str], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    given = ["--on", "box", "--out", str(tmp_path), *words]
    with pytest.raises(SystemExit, match="2"):
        run_command("airl profile", command.__name__, given)
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert not list(tmp_path.iterdir())


def test_file_of_another_machine_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "box.toml"
    write_profile(path, load_computer("ras-pi-4"))
    before = path.read_bytes()
    with pytest.raises(UsageError, match=r"Cortex-A72.*accepted: another --on or --out"):
        profile(ProfileRequest(on="box"), out=tmp_path)
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
    # The default policy needs these, which the light installation has.
    block = BLOCK
    for name in ("airl_mav.core.kernels", "numba", "onnxruntime"):
        block = block.replace(f"'{name}', ", "")
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


@pytest.mark.nightly
def test_light_installation_has_help(tmp_path: Path) -> None:
    for words in ([], ["profile"], ["companion"], ["list"], ["train"]):
        done = in_light_install(tmp_path, *words, "--help")
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        (["evaluate", "static-obstacles"], "sim"),
        (["arena"], "sim"),
        (["evaluate", "--help"], "sim"),
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
        preexec_fn=allow_interrupt,
    )
    assert process.stdout is not None
    assert "profile" in process.stdout.readline()
    assert "network" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    rest = process.communicate(timeout=60)[0]
    assert process.returncode == 130, rest
    assert "interrupted: nothing was written" in rest
    assert not (tmp_path / "out").exists()


@pytest.mark.nightly
def test_an_interrupted_soak_keeps_what_was_measured(tmp_path: Path) -> None:
    words = [sys.executable, "-u", "-m", "airl_mav.cli.main", "profile", "--soak", "10min"]
    process = subprocess.Popen(
        [*words, "--decisions", "20", "--on", "box", "--out", str(tmp_path / "out")],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    for what in ("profile", "network", "soak"):
        assert what in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    rest = process.communicate(timeout=60)[0]
    assert process.returncode == 130, rest
    stem = tmp_path / f"out/box.{DEFAULT_POLICY}-bare"
    facts = json.loads(Path(f"{stem}.json").read_text())
    assert facts["soak"]["interrupted"]
    assert facts["soak"]["duration_s"] < 60.0 < facts["soak"]["asked_s"] == 600.0
    assert "of 10.0 min, interrupted: t2 from the first to the last" in rest
    with np.load(f"{stem}.soak.npz") as series:
        assert len(series["time_s"]) == round(facts["soak"]["duration_s"])
        assert series["time_s"][-1] == facts["soak"]["duration_s"]
        assert (series["n"] >= 1).all()
        assert (series["p50_ms"] <= series["max_ms"]).all()
    # The measurement before the soak is whole, and flies.
    work = load_computer(str(tmp_path / "out/box.toml")).workloads[f"{DEFAULT_POLICY}-bare"]
    assert len(work.latency.samples_ms or ()) == 20


def test_power_that_the_computer_tells_is_its_watts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("airl_mav.addons.profiling.profile.IDLE_US", 20_000)
    root, out = write(tmp_path / "machine", ORIN_NX), tmp_path / "out"
    few = ProfileRequest(on="box", decisions=10, warm_up=1)
    measured = profile(few, out=out, root=root)
    assert measured.power.idle_w == pytest.approx(5.016 * 1.2)
    assert measured.power.busy_w == pytest.approx(5.016 * 1.2)
    told = "measured while deciding at level bare (6.02 W idle, 6.02 W busy, INA monitor: VDD_IN)"
    held = load_computer(str(out / "box.toml"))
    assert held.watts == pytest.approx(6.02)
    assert held.source.endswith(f"; watts: {told}; price: not known")
    facts = json.loads((out / f"box.{DEFAULT_POLICY}-bare.json").read_text())
    assert facts["power"]["source"] == "INA monitor: VDD_IN"
    # Measured again: listed once. Given by the user: kept over later measurements.
    profile(few, out=out, root=root)
    assert load_computer(str(out / "box.toml")).source.count("watts: ") == 1
    profile(few.model_copy(update={"watts": 9.0, "price_usd": 5.0}), out=out, root=root)
    profile(few, out=out, root=root)
    held = load_computer(str(out / "box.toml"))
    assert (held.watts, held.price_usd) == (9.0, 5.0)
    assert "watts: " not in held.source
    assert "price: " not in held.source


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("flight")
def test_stages_in_flight(tmp_path: Path) -> None:
    words = ("--level", "sitl", "--decisions", "40", "--warm-up", "5", *choose_ports().options())
    printed = profiled(tmp_path, *words)
    stamps = np.load(tmp_path / f"box.{DEFAULT_POLICY}-sitl.npz")
    assert len(stamps["sent_us"]) == 40
    order = [stamps[stage.start] for stage in STAGES[:6]]
    assert all((later >= sooner).mean() > 0.95 for sooner, later in pairwise(order))
    held = stamps["held_until_us"] - stamps["sent_us"]
    assert (held >= 50_000).mean() > 0.95
    assert (np.diff(stamps["sent_us"]) >= 50_000).mean() > 0.95
    assert "link" in printed
    assert "timing was measured, not the quality of flight" in printed
    assert f"{DEFAULT_POLICY}-sitl" in load_computer(str(tmp_path / "box.toml")).workloads


def test_busy_machine_is_said_to_be_so() -> None:
    idle = MachineState(None, None, None, None, None, (0.1, 3.0, 3.0))
    assert busy_remark(idle, 2) is None
    assert busy_remark(replace(idle, load=None), 2) is None
    remark = busy_remark(replace(idle, load=(8.5, 0.0, 0.0)), 2)
    assert remark is not None
    assert "load average 8.50 on 2 usable cores" in remark


AHEAD_US = 5_000_000


def flown_beside(simulator_us: Callable[[int], int]) -> hil.TimedMission:
    """A flight of 40 decisions against a simulator whose clock is a function of ours."""

    def asked(start_us: int, n: int, interval_us: int, trip_us: int) -> Exchanges:
        sent = start_us + interval_us * np.arange(n)
        remote = np.array([simulator_us(int(t) + trip_us // 2) for t in sent])
        return Exchanges(sent, remote, sent + trip_us)

    log = DecisionLog()
    for i in range(40):
        seen_us = 2_000_000 + 60_000 * i
        a, b, c, d, e = (seen_us + later for later in (8_000, 8_100, 9_000, 9_100, 59_100))
        log.record(simulator_us(seen_us), a, b, c, d, e, (0.0, 0.0, 0.0, 0.0))
    return hil.TimedMission(
        MissionResult("stopped", (), log),
        asked(0, 100, 5_000, 400),
        asked(1_000_000, 50, 100_000, 700),
        asked(7_000_000, 100, 5_000, 600),
    )


def test_exposures_are_brought_to_this_computers_clock() -> None:
    flown = flown_beside(lambda own_us: own_us + AHEAD_US)
    stamps, exposure, remarks = hil.relate_stamps(flown, 10)
    assert exposure == "capture_us"
    t1_us = stamps["decoded_us"] - stamps["capture_us"]
    assert (np.abs(t1_us - 8_000) <= stamps["capture_uncertainty_us"]).all()
    # Between half of 400 and half of 600, and 2 for two clocks of whole microseconds.
    assert stamps["capture_uncertainty_us"].min() >= 200
    assert stamps["capture_uncertainty_us"].max() <= 303
    assert len(stamps["decoded_us"]) == 30
    # Only exchanges of decisions, not of take-off and landing.
    first_us, last_us = stamps["exchange_sent_us"][[0, -1]]
    assert stamps["infer_start_us"][0] <= first_us < last_us <= stamps["held_until_us"][-1]
    assert "least round trip 0.400 ms" in remarks[0]
    assert "least round trip 0.600 ms" in remarks[0]
    assert "50 of 50 exchanges in flight agree" in remarks[0]
    stages = Recording((stamps,), exposure, 0, 0).stages
    assert set(stages["mavlink_round_trip"].tolist()) == {700}
    assert stages["t1_uncertainty"].max() == stamps["capture_uncertainty_us"].max()
    assert stages["link"].size == stages["end_to_end"].size == 0


@pytest.mark.parametrize(
    ("simulator_us", "why"),
    [
        # It fell behind in flight, and gave up time.
        (lambda own_us: own_us + AHEAD_US - 300_000 * (own_us > 3_000_000), "ppm"),
        (lambda own_us: 2 * own_us, "as if a clock did not keep real time"),
    ],
)
def test_clocks_that_cannot_be_related(simulator_us: Callable[[int], int], why: str) -> None:
    stamps, exposure, (remark,) = hil.relate_stamps(flown_beside(simulator_us), 10)
    assert exposure == "decoded_us"
    assert "capture_us" not in stamps
    assert remark.startswith("t1, link, control and end to end were not measured (-)")
    assert why in remark
    assert "t1_uncertainty" not in Recording((stamps,), exposure, 0, 0).stages


def test_an_autopilot_without_timesync() -> None:
    none = Exchanges(*(np.zeros(0, np.int64) for _ in range(3)))
    flown = replace(
        flown_beside(lambda own_us: own_us + AHEAD_US), before=none, during=none, after=none
    )
    stamps, exposure, (remark,) = hil.relate_stamps(flown, 10)
    assert (exposure, len(stamps["exchange_sent_us"])) == ("decoded_us", 0)
    assert "0 answers in a row" in remark


def test_frames_of_yet_another_clock() -> None:
    flown = flown_beside(lambda own_us: own_us + AHEAD_US)
    shifted = [
        Exchanges(row.sent_us, row.remote_us - 20_000, row.received_us)
        for row in (flown.before, flown.during, flown.after)
    ]
    flown = hil.TimedMission(flown.result, *shifted)
    _, exposure, (remark,) = hil.relate_stamps(flown, 10)
    assert exposure == "decoded_us"
    assert "30 frames would have been decoded before they were exposed" in remark


FIRMWARE_THAT_TELLS_ITS_EPOCH = """
import sys
from airl_mav.cli.options import run_command
from airl_mav.rehearsal import firmware_process

fly = firmware_process.fly

def told(firmware, *rest):
    fly(firmware, *rest)
    print("epoch_ns", firmware.epoch_ns, flush=True)
    print("slipped_us", firmware.slipped_us, flush=True)

firmware_process.fly = told
run_command("airl-firmware", "airl_mav.cli.firmware_command")
"""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("flight")
def test_on_the_drones_computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clocks: list[WallClock] = []

    def made() -> WallClock:
        clocks.append(WallClock())
        return clocks[-1]

    monkeypatch.setattr(hil, "WallClock", made)
    free = choose_ports()
    profile = [sys.executable, "-c", FIRMWARE_THAT_TELLS_ITS_EPOCH, "--arena", "no-obstacles"]
    log_path = tmp_path / "firmware.log"
    with log_path.open("wb") as log:
        firmware = subprocess.Popen(
            [*profile, *free.options()],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=log,
            stderr=log,
        )
        try:
            connect = f"udpin://127.0.0.1:{free.api}"
            words = ("--level", "hil", "--decisions", "70", "--warm-up", "10")
            addresses = ("--connect", connect, "--camera", f"tcp://127.0.0.1:{free.camera}")
            printed = profiled(tmp_path, *words, *addresses)
        finally:
            firmware.terminate()
            firmware.wait(30)
    stamps = np.load(tmp_path / f"box.{DEFAULT_POLICY}-hil.npz")
    facts = json.loads((tmp_path / f"box.{DEFAULT_POLICY}-hil.json").read_text())
    counts = {key: stage["n"] for key, stage in facts["stages_us"].items()}
    assert "motor_us" not in stamps.files
    assert len(stamps["sent_us"]) == 70
    assert "link, control and end to end were not measured" in printed
    assert (counts["t2"], counts["t3"], counts["period"]) == (70, 70, 69)
    assert (counts["link"], counts["end_to_end"]) == (0, 0)
    trips = stamps["exchange_received_us"] - stamps["exchange_sent_us"]
    assert counts["mavlink_round_trip"] == len(trips) >= 10
    assert "MAVLink round trip" in printed
    told = dict(re.findall(r"^(epoch_ns|slipped_us) (\d+)$", log_path.read_text(), re.MULTILINE))
    if counts["t1"] == 0:
        # Refused, and rightly: this host could not keep pace.
        assert int(told["slipped_us"]) > 0
        return
    # Here both clocks are one, and the truth is known.
    assert counts["t1"] == counts["t1_uncertainty"] == 70
    assert re.search(r"t1 fetch ±\d+\.\d+", printed)
    ahead_us = (clocks[0].epoch_ns - int(told["epoch_ns"])) / 1_000
    error_us = stamps["capture_us"] - (stamps["capture_simulator_us"] - ahead_us)
    within_us = stamps["capture_uncertainty_us"]
    assert (np.abs(error_us) <= within_us).all()
    assert (within_us < 4_000).all()
    # Figures of the true clock, as in level sitl, lie within the printed bounds.
    true_t1_us = stamps["decoded_us"] - (stamps["capture_simulator_us"] - ahead_us)
    shown, most_us = facts["stages_us"]["t1"], facts["stages_us"]["t1_uncertainty"]["max"]
    true_p50_us = np.percentile(true_t1_us, 50.0, method="inverted_cdf")
    assert abs(shown["p50"] - true_p50_us) <= most_us
    assert abs(shown["mean"] - true_t1_us.mean()) <= most_us

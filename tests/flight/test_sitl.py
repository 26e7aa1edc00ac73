"""Whole rehearsals, everything real: two processes, MAVSDK, the run folder, the report."""

from __future__ import annotations

import json
import os
import re
import socket
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil

from airl_mav.core.constants import LOOPBACK
from airl_mav.core.signing import write_key
from airl_mav.latency.injection import build_sampler
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.profiles.computer import load_computer
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from tests.support.command_line import airl
from tests.support.foreign_messages import CHANGED, FOREIGN
from tests.support.forged_frames import ForgedFrames
from tests.support.mavlink_clients import RawClient
from tests.support.ports import choose_ports
from tests.support.processes import SITL, SITL_WITHOUT_REPORT, running, write_arena

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("rehearsal"), pytest.mark.timeout(300)]

EPISODES = 2
SEED = 6
"""Its flights, and the next one's, pass no obstacle that a late decision could lead into."""
SPEED = 1.0
HOLD_US = 100_000
SIX_STAGES = (
    "capture_us",
    "decoded_us",
    "infer_start_us",
    "action_ready_us",
    "sent_us",
    "accepted_us",
    "motor_us",
)


@dataclass(frozen=True)
class Done:
    """A finished run of airl-sitl."""

    folder: Path
    output: str
    episodes: list[dict[str, Any]]
    config: dict[str, Any]

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        """Read one archive."""
        with np.load(self.folder / name, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}


def sitl(folder: Path, *options: str, report: bool = True) -> Done:
    """Run airl-sitl to its end."""
    words = [*(SITL if report else SITL_WITHOUT_REPORT), *choose_ports().options()]
    words += ["--out", str(folder / "run"), *options]
    with running(words, folder) as process:
        process.find_children("firmware", "companion")
        assert process.wait(250.0) == 0, process.text()
        process.no_child_left()
    run = folder / "run"
    lines = (run / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    return Done(
        run,
        process.text(),
        [json.loads(line) for line in lines],
        json.loads((run / "run.json").read_text(encoding="utf-8")),
    )


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    """The front door with its vehicle named (on free ports, patient on a busy host)."""
    folder = tmp_path_factory.mktemp("sitl")
    flights = ("--episodes", str(EPISODES), "--seed", str(SEED), "--speed", str(SPEED))
    return sitl(folder, "--vehicle", "quad", "--tables", "--limits.silence-s", "3", *flights)


def test_folder_is_complete_and_nothing_else(done: Done) -> None:
    names = {path.name for path in done.folder.iterdir()}
    flights = [f"flight-{i:03d}" for i in range(EPISODES)]
    assert names == {
        *("run.json", "scenario.toml", "episodes.jsonl", "latency.npz", "trajectories.npz"),
        *("report.html", "verdict.json", "firmware.log", "companion.log"),
        *("latency.png", "latency-timeline.png", "trajectories.png"),
        *(f"{flight}{end}" for flight in flights for end in (".tlog", ".ulg", "-map.png")),
    }
    for name in names:
        size = (done.folder / name).stat().st_size
        if name.endswith(".log"):
            assert size == 0, (done.folder / name).read_text(encoding="utf-8")
        else:
            assert size > 100, name
    for png in done.folder.glob("*.png"):
        assert png.read_bytes().startswith(b"\x89PNG\r\n")


def test_what_was_flown_is_on_record(done: Done) -> None:
    config = done.config
    assert config["schema"] == 1
    assert config["seeds"] == [SEED, SEED + 1]
    assert config["config"]["vehicle"] == "quad"
    assert config["config"]["episodes"] == EPISODES
    assert config["setup"]["level"] == "sitl"
    assert config["setup"]["speed"] == SPEED
    assert config["setup"]["injection"]["origin"] == "measured"
    assert "mavsdk" in config["versions"]
    for i, episode in enumerate(done.episodes):
        assert (episode["index"], episode["seed"], episode["schema"]) == (i, SEED + i, 1)
        assert episode["outcome"] == "success", episode
        assert episode["notes"] == []
        assert episode["started_us"] < episode["navigation_us"] < episode["ended_us"]
        assert 0.9 < episode["battery_remaining"] < 1.0
        assert episode["wall_s"] > 0.0


def test_what_the_companion_took_is_on_record(done: Done) -> None:
    for episode in done.episodes:
        use = episode["companion_use"]
        # From arming to the ground: longer than to the verdict, and on the wall clock.
        flown_s = (episode["ended_us"] - episode["started_us"]) / 1e6 / SPEED
        assert 0.7 * flown_s < use["wall_s"] < flown_s + 60.0
        # MAVSDK, camera and policy take some of a core, and never as much as all of them.
        assert 0.01 < use["cpu_s"] < use["wall_s"] * (os.cpu_count() or 1)
        assert 30e6 < use["peak_memory_bytes"] < 1e9
        assert use["peak_since"] in ("begin", "process start")
        assert use["power_w"] is None or use["power_w"] > 0.0
        assert use["power_source"]
    assert "companion, processor time a flight" in done.output
    assert "mean power of the machine" in (done.folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("index", range(EPISODES))
def test_deadlines_and_steps_follow_from_the_decisions(done: Done, index: int) -> None:
    archive, quality = done.arrays("latency.npz"), done.episodes[index]["quality"]
    taken = archive[f"{index:03d}/motor_us"] - archive[f"{index:03d}/capture_us"]
    never = archive[f"{index:03d}/motor_us"] == NO_STAMP
    # The flight's end cuts off what comes after the last decision that moved the motors.
    judged = len(taken) - int(np.argmin(never[::-1]))
    late = np.count_nonzero(((taken > HOLD_US) | never)[:judged])
    assert quality["deadline_misses"] == pytest.approx(late / judged)
    setpoints = archive[f"{index:03d}/setpoint"].astype(float)
    steps = [np.hypot.reduce(b[:3] - a[:3]) for a, b in pairwise(setpoints)]
    assert quality["command_step_m_s"] == pytest.approx(np.mean(steps))
    assert quality["command_step_max_m_s"] == pytest.approx(max(steps))
    assert 0.0 < quality["jerk_rms_m_s3"] < quality["jerk_peak_m_s3"]
    assert quality["command_jerk_rms_m_s3"] > 0.0


def test_episodes_are_on_one_clock(done: Done) -> None:
    first, second = done.episodes
    assert second["started_us"] > first["ended_us"]
    assert first["goal"] != second["goal"]


@pytest.mark.parametrize("index", range(EPISODES))
def test_every_decision_is_followed_to_the_motors(done: Done, index: int) -> None:
    archive = done.arrays("latency.npz")
    stamps = {name: archive[f"{index:03d}/{name}"] for name in SIX_STAGES}
    episode = done.episodes[index]
    rows = np.stack([stamps[name] for name in SIX_STAGES])
    assert rows.shape[1] >= 5
    # Where the host was busy a decision may be overtaken by the next one before it is read.
    followed = stamps["accepted_us"] > 0
    assert followed.mean() > 0.9
    steps = np.diff(rows[:, followed], axis=0)
    assert np.all(steps >= 0)
    took_us = stamps["motor_us"] - stamps["capture_us"]
    np.testing.assert_array_equal(steps.sum(axis=0), took_us[followed])
    # Every decision lies in its flight, one after the other, held for a tenth of a second.
    assert np.all(stamps["capture_us"] > episode["started_us"])
    # (Where the host gave up time, the simulator's clock has seen less of a hold.)
    least_us = HOLD_US - episode["slipped_us"]
    # On a busy host the last decisions may be made when the flight has ended, at one time.
    flown = stamps["sent_us"] < episode["ended_us"]
    assert flown.sum() >= len(flown) - 2
    assert np.all(np.diff(stamps["sent_us"][flown]) >= least_us)
    held = archive[f"{index:03d}/held_until_us"] - stamps["sent_us"]
    assert np.all(held[flown] >= least_us)
    # The loops hand over within five ticks of 4 ms, but where the host was busy.
    assert np.median((stamps["motor_us"] - stamps["accepted_us"])[followed]) <= 20_000


@pytest.mark.parametrize("index", range(EPISODES))
def test_quality_follows_from_the_true_path(done: Done, index: int) -> None:
    """Recomputed from cumulative sums over the raw arrays."""
    archive, episode = done.arrays("trajectories.npz"), done.episodes[index]
    path = {
        key.partition("/")[2]: values
        for key, values in archive.items()
        if key.startswith(f"{index:03d}/")
    }
    time_us, quality = path["time_us"], episode["quality"]
    legs = np.linalg.norm(np.diff(path["position"], axis=0), axis=1)
    joules = path["power_w"][1:] * np.diff(time_us) / 1e6
    span = [episode["navigation_us"], episode["ended_us"]]

    def over(amounts: np.ndarray, between: list[int]) -> float:
        total = np.concatenate([[0.0], np.cumsum(amounts)])
        first, last = np.interp(between, time_us, total)
        return float(last - first)

    seconds = (span[1] - span[0]) / 1e6
    assert quality["flight_time_s"] == pytest.approx(seconds, abs=1e-9)
    assert quality["distance_m"] == pytest.approx(over(legs, span), rel=1e-9)
    assert quality["energy_j"] == pytest.approx(over(joules, span), rel=1e-9)
    assert quality["mean_speed_m_s"] == pytest.approx(over(legs, span) / seconds, rel=1e-9)
    watts = done.config["setup"]["computer_watts"]
    assert quality["computer_energy_j"] == pytest.approx(watts * seconds, rel=1e-9)
    at = np.unique([*span, *time_us[(time_us > span[0]) & (time_us < span[1])]])
    velocity = [np.interp(at, time_us, path["velocity"][:, axis]) for axis in range(3)]
    fastest = np.linalg.norm(velocity, axis=0).max()
    assert quality["max_speed_m_s"] == pytest.approx(fastest, rel=1e-9)
    before = [int(time_us[0]), span[0]]
    assert quality["takeoff"]["distance_m"] == pytest.approx(over(legs, before), rel=1e-9)
    assert quality["takeoff"]["energy_j"] == pytest.approx(over(joules, before), rel=1e-9)
    # It took off, reached the goal, and came down again.
    assert path["position"][:, 2].min() < -2.0
    arrived = [np.interp(span[1], time_us, path["position"][:, axis]) for axis in range(2)]
    assert np.hypot(*(np.array(arrived) - episode["goal"])) < episode["goal_radius_m"]
    assert abs(path["position"][-1, 2]) < 0.2
    # The estimate is near the truth all the way.
    latency = done.arrays("latency.npz")
    believed = latency[f"{index:03d}/estimate/position"]
    times = latency[f"{index:03d}/estimate/time_us"]
    real = np.stack([np.interp(times, time_us, path["position"][:, a]) for a in range(3)], axis=1)
    assert np.linalg.norm(believed - real, axis=1)[times > span[0]].max() < 2.0


@pytest.mark.parametrize("index", range(EPISODES))
def test_tlog_opens(done: Done, index: int) -> None:
    log = mavutil.mavlogfile(str(done.folder / f"flight-{index:03d}.tlog"))
    seen: Counter[str] = Counter()
    first = last = 0.0
    while (message := log.recv_match()) is not None:
        seen[message.get_type()] += 1
        first, last = first or message._timestamp, message._timestamp
    log.close()
    episode = done.episodes[index]
    assert last - first > (episode["ended_us"] - episode["started_us"]) / 1e6
    assert seen["HEARTBEAT"] > last - first  # the vehicle's and the companion's
    decisions = len(done.arrays("latency.npz")[f"{index:03d}/sent_us"])
    assert seen["SET_POSITION_TARGET_LOCAL_NED"] >= decisions
    assert seen["BAD_DATA"] == 0


def tables(output: str) -> list[str]:
    """Return the lines from the first table to the report."""
    lines = [line.rstrip() for line in output.splitlines()]
    start = next(i for i, line in enumerate(lines) if line.startswith("vehicle "))
    ends = ("drawing the report", "report  ")
    end = next(i for i, line in enumerate(lines) if i > start and line.startswith(ends))
    # Blank lines surround what is printed before the report.
    return [line for line in lines[start:end] if line]


def test_the_output_ends_with_one_sentence(done: Done) -> None:
    saved = json.loads((done.folder / "verdict.json").read_text(encoding="utf-8"))
    assert done.output.splitlines()[-1] == saved["sentences"][0]
    assert "level sitl: 2 of 2 goals reached, 100.0 % [34.2, 100.0]" in done.output


def test_report_again_says_the_same(done: Done) -> None:
    html = (done.folder / "report.html").read_bytes()
    code, again = airl("report", str(done.folder), width=200)
    assert code == 0, again
    assert tables(again) == tables(done.output)
    assert (done.folder / "report.html").read_bytes() == html
    text = "\n".join(tables(done.output))
    for word in ("Decision latency", "end to end", "Quality of flight", "success rate", "100 %"):
        assert word in text


@pytest.mark.nightly  # A trace, in lockstep: test_latency_levels.py.
def test_injected_latency(tmp_path: Path) -> None:
    """Flown as if the paper's Raspberry Pi decided: 396 ms a decision, and labelled so."""
    arena = write_arena(tmp_path, 24.0)
    pi = ("--policy", "greedy", "--computer", "ras-pi-4", "--workload", "template-5x32")
    run = sitl(tmp_path, *pi, "--episodes", "1", "--arena", str(arena), "--speed", "3")
    archive = run.arrays("latency.npz")
    t2_us = archive["000/action_ready_us"] - archive["000/infer_start_us"]
    assert len(t2_us) >= 6
    latency = load_computer("ras-pi-4").workloads["template-5x32"].latency
    sampler = build_sampler(latency, np.random.default_rng(1))
    drawn_us = np.array([sampler.sample_us() for _ in t2_us])
    # Where the host gave up time, the simulator's clock has seen less of it.
    lost_us = run.episodes[0]["slipped_us"]
    assert np.all(t2_us >= drawn_us - lost_us)
    # Overhead of the host; the median ignores a busy moment.
    assert np.median(t2_us - drawn_us) < 20_000
    spread_ms = 4.0 * 19.8 / np.sqrt(len(t2_us))
    assert abs(np.mean(drawn_us) / 1e3 - 396.0) < spread_ms
    assert abs(np.median(t2_us) / 1e3 - 396.0) < 1.3 * spread_ms + 20.0
    # The command between two decisions flew on for as long.
    least_us = 500_000 + drawn_us.min() - lost_us
    assert np.diff(archive["000/sent_us"]).min() >= least_us
    injection = run.config["setup"]["injection"]
    assert injection["origin"] == "injected"
    assert "template-5x32" in injection["label"]
    assert injection["latency"]["mean_ms"] == 396.0
    assert "396 ± 19.8 ms of injected latency" in run.output
    assert "as if Raspberry Pi 4" in (run.folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.nightly  # Bit by bit, in lockstep: test_lockstep_tokens.py.
def test_a_third_sender_does_not_end_a_signed_flight(tmp_path: Path) -> None:
    """With encrypted images."""
    key, ports, forged = tmp_path / "key", choose_ports(), ForgedFrames()
    write_key(key, bytes(range(1, 33)))
    words = [*SITL_WITHOUT_REPORT, *ports.options(), "--out", str(tmp_path / "run")]
    words += ["--arena", "no-obstacles", "--episodes", "1", "--signing-key", str(key)]
    words += ["--camera-key", str(key)]
    stop = threading.Event()

    def attack() -> None:
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
            while not stop.wait(0.02):
                for port in (ports.api, ports.api_local, ports.gcs_local):
                    for frame in forged.take(6):
                        sender.sendto(frame, (LOOPBACK, port))

    attacker = threading.Thread(target=attack)
    attacker.start()
    try:
        with running(words, tmp_path) as process:
            assert process.wait(250.0) == 0, process.text()
    finally:
        stop.set()
        attacker.join()
    assert forged.sent.total() >= 5_000
    (line,) = (tmp_path / "run" / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(line)["outcome"] == "success"


@pytest.mark.nightly
def test_other_senders_are_named(tmp_path: Path) -> None:
    """A ground station sets parameters; system 77 sends poses to the companion's link."""
    ports = choose_ports()
    words = [*SITL_WITHOUT_REPORT, *ports.options(), "--episodes", "1", "--arena", "no-obstacles"]
    words += ["--policy", "greedy", "--out", str(tmp_path / "run")]
    beat = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    with (
        running(words, tmp_path) as process,
        sending(ports.gcs_local, (255, 190), [beat, *CHANGED.values()]),
        sending(ports.api_local, (77, 1), [*FOREIGN["ODOMETRY"], beat]),
    ):
        # Without validity checks, other senders are notes.
        assert process.wait(250.0) == 0, process.text()
    (line,) = (tmp_path / "run" / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    episode = json.loads(line)
    said = "\n".join(episode["notes"])
    for name in CHANGED:
        assert f"system 255 component 190, {name} from " in said
    assert re.search(
        r"commanded by onboard 127.0.0.1:\d+, system 77 component 1, ODOMETRY \(\d+ times", said
    )
    assert {e["component"] for e in episode["effects"] if e["is_companion"]} == {195}


@contextmanager
def sending(port: int, ids: tuple[int, int], messages: Sequence[Any]) -> Iterator[None]:
    """Send messages to a port of the vehicle, ten times a second, from a thread."""
    client, done = RawClient(MemoryEndpoint(), ids), threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            while not done.wait(0.1):
                for message in messages:
                    wire.sendto(client.pack(message), ("127.0.0.1", port))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@pytest.mark.nightly
def test_a_crash_is_judged_and_the_run_goes_on(tmp_path: Path) -> None:
    """A storm into the wall: the companion is called off, the next episode starts."""
    storm = ("--wind.east-m-s", "48", "--arena", str(write_arena(tmp_path, 30.0)))
    run = sitl(tmp_path, *storm, "--episodes", "2", "--speed", "3", report=False)
    assert [episode["outcome"] for episode in run.episodes] == ["collision", "collision"]
    for episode in run.episodes:
        assert "hit " in episode["reason"]
    assert "Traceback" not in run.output

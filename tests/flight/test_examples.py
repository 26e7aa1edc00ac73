"""Every program in examples/ runs unmodified and prints the expected text."""

from __future__ import annotations

import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import WallClock
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.actions import discrete_actions
from airl_mav.policy.layouts import boxes
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.training.export import load_module
from airl_mav.training.export_request import ExportRequest
from airl_mav.training.onnx_export import random_inputs
from companion.frame_source import open_camera
from tests.support.ports import LOOPBACK, choose_ports
from tests.support.processes import ROOT, running

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("examples"), pytest.mark.timeout(600)]

EXAMPLES = ROOT / "examples"

AIRL = "from airl_mav.cli.main import airl; airl()"


def output_of(name: str, folder: Path, *arguments: str, timeout_s: float = 280.0) -> str:
    """Return what an example prints, run in an empty folder."""
    with running([str(EXAMPLES / name), *arguments], folder) as program:
        assert program.wait(timeout_s) == 0, program.text()
        return program.text()


def numbers_after(pattern: str, text: str) -> list[float]:
    """Return the numbers in the groups of every match."""
    return [float(group) for match in re.finditer(pattern, text, re.M) for group in match.groups()]


def test_every_example_is_flown() -> None:
    """lockstep_client.py is flown by test_lockstep_tokens.py."""
    here = Path(__file__).read_text(encoding="utf-8")
    named = set(re.findall(r"\w+\.py", here))
    assert {path.name for path in EXAMPLES.glob("*.py")} <= named


def test_every_example_is_on_a_page() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
    for path in filter(Path.is_file, EXAMPLES.iterdir()):
        assert f"examples/{path.name}" in pages, path.name


@pytest.mark.nightly
def test_rehearse(tmp_path: Path) -> None:
    text = output_of("rehearse.py", tmp_path)
    assert text.count("success") + text.count("collision") == 2
    (t2_ms,) = numbers_after(r"t2: (\d+) ms", text)
    assert 380 < t2_ms < 412, "the paper's Raspberry Pi: 396 ms"
    assert re.search(r"digest of all flights: [0-9a-f]{64}\n", text)
    page = re.search(r"report: (\S+)", text)
    assert page is not None
    assert (tmp_path / page[1]).is_file()


@pytest.mark.nightly
def test_faults_are_listed(tmp_path: Path) -> None:
    text = output_of("faults.py", tmp_path)
    assert "healthy: success" in text
    assert "  gps bias 20,0,0m at offboard+1s for 5s: " in text
    assert "  gps delay 0.8s at offboard: " in text


@pytest.mark.nightly  # Policies from a file: test_python_policy.py.
def test_own_policy(tmp_path: Path) -> None:
    text = output_of("own_policy.py", tmp_path)
    assert len(re.findall(r"^seed \d: (success|collision|timeout), ", text, re.M)) == 2


@pytest.mark.nightly  # It learns; the environment itself: test_rehearsal_env.py.
def test_gymnasium_px4(tmp_path: Path) -> None:
    """The policy flies in the vectorized simulator as in lockstep."""
    text = output_of("gymnasium_px4.py", tmp_path)
    pattern = r"^{}, seed \d: success after ([\d.]+) s and [\d.]+ m$"
    simulators = ("vectorized", "built-in")
    vectorized, built_in = (numbers_after(pattern.format(name), text) for name in simulators)
    assert len(vectorized) == len(built_in) == 3, text
    np.testing.assert_allclose(built_in, vectorized, rtol=0.1)


def test_snapshot(tmp_path: Path) -> None:
    assert output_of("snapshot.py", tmp_path) == "bit-identical: True\n"


def test_the_policy_of_own_acceleration_reaches_its_goal() -> None:
    policy = f"{EXAMPLES / 'own_acceleration.py'}:ToGoal"
    asked = resolve(Scenario(policy=policy, arena="no-obstacles", level="lockstep"))
    assert fly(asked, asked.fresh_policy(1), 0, 1).record.outcome is Outcome.SUCCESS


@pytest.mark.nightly  # In every run its policy flies above.
def test_own_acceleration(tmp_path: Path) -> None:
    text = output_of("own_acceleration.py", tmp_path)
    times_s = numbers_after(r"^seed \d: success after ([\d.]+) s$", text)
    assert len(times_s) == 3, text


@pytest.mark.nightly  # In every run its policy flies in test_body_rates.py, in time and late.
def test_own_body_rates(tmp_path: Path) -> None:
    """They need decisions in time, where velocities would hardly lose anything."""
    text = output_of("own_body_rates.py", tmp_path)
    assert "decisions 10 ms late: success, success\n" in text
    assert "decisions 200 ms late: collision, collision\n" in text


@pytest.mark.nightly
def test_own_arena(tmp_path: Path) -> None:
    text = output_of("own_arena.py", tmp_path)
    (trunks,) = numbers_after(r"seed 7: (\d+) trunks", text)
    assert 20 <= trunks <= 30
    assert (tmp_path / "forest.png").read_bytes().startswith(b"\x89PNG")
    assert len(re.findall(r"^seed [78]: (success|collision|timeout), ", text, re.M)) == 2


@pytest.mark.nightly
def test_own_reward(tmp_path: Path) -> None:
    text = output_of("own_reward.py", tmp_path)
    assert (tmp_path / "short-and-cheap/policy/card.json").is_file()
    assert re.search(r"^(success|collision|timeout): ", text, re.M)


@pytest.mark.nightly
def test_cleanrl_ppo_learns_by_itself_and_its_agent_can_be_exported(tmp_path: Path) -> None:
    text = output_of("cleanrl_ppo.py", tmp_path)
    assert len(re.findall(r"^ *\d+ steps: \d+ of \d+ flights", text, re.M)) == 3
    weights = torch.load(tmp_path / "agent.pt", weights_only=True)
    agent = load_module(f"{EXAMPLES / 'cleanrl_ppo.py'}:Agent", tmp_path / "agent.pt")
    torch.testing.assert_close(dict(agent.state_dict()), dict(weights))
    # In the form that the export takes, with the image that it takes by default.
    facts = ExportRequest(model="cleanrl_ppo.py:Agent", out=tmp_path / "agent").facts("test")
    seen = random_inputs(facts.observation, 3, np.random.default_rng(0))
    scores = agent(*(torch.from_numpy(seen[key]) for key in boxes(facts.observation)))
    assert scores.shape == (3, discrete_actions(facts.actions))


@pytest.mark.nightly  # It learns in 100 s of CPU time, which a busy host stretches.
@pytest.mark.timeout(1800)
def test_sb3_ppo_learns(tmp_path: Path) -> None:
    text = output_of("sb3_ppo.py", tmp_path, timeout_s=1700.0)
    (success,) = numbers_after(r"^([\d.]+) % of 300 flights reached the goal$", text)
    assert success >= 95.0
    assert (tmp_path / "static-obstacles.zip").is_file()


def test_sb3_ppo_runs_with_few_steps(tmp_path: Path) -> None:
    program = (EXAMPLES / "sb3_ppo.py").read_text(encoding="utf-8")
    for many, few in (("150_000", "1"), ('"n_steps": 128', '"n_steps": 8'), ("1, 301", "1, 3")):
        assert many in program
        program = program.replace(many, few)
    (tmp_path / "few.py").write_text(program, encoding="utf-8")
    assert re.search(r"^[\d.]+ % of 2 flights", output_of(f"{tmp_path}/few.py", tmp_path), re.M)


@pytest.mark.nightly
def test_latency_curve_rises(tmp_path: Path) -> None:
    text = output_of("latency_curve.py", tmp_path)
    times = numbers_after(r"%\s+([\d.]+) s", text)
    assert times == sorted(times)
    assert len(times) == 3


@pytest.mark.nightly
def test_compare_runs(tmp_path: Path) -> None:
    text = output_of("compare_runs.py", tmp_path)
    changes = numbers_after(r"^\w+ +([+-][\d.]+) %  \[[+-].*\]  over (\d+) pairs$", text)
    assert len(changes) == 6
    assert max(abs(change) for change in changes[::2]) < 50.0


def test_failed_flight_names_causes(tmp_path: Path) -> None:
    text = output_of("failed_flight.py", tmp_path)
    assert re.search(r"^flight \d+, hit static-\S+: seen ", text, re.M)
    assert re.search(r"; speed at the collision [\d.]+ m/s\.$", text, re.M)


def test_own_computer_replays_its_file(tmp_path: Path) -> None:
    text = output_of("own_computer.py", tmp_path)
    means = numbers_after(r": t2 (\d+) ms, at most (\d+) ms; success", text)
    latencies = [float(line) for line in (tmp_path / "my-computer.txt").read_text().split()]
    assert means[:2] == [1.0, 1.0]
    assert means[3] <= round(max(latencies))
    assert means[2] == pytest.approx(np.mean(latencies), rel=0.1)


def test_export_pandas(tmp_path: Path) -> None:
    text = output_of("export_pandas.py", tmp_path)
    rows = re.findall(r"^\d +\d +success +\d+ +([\d.]+) +[\d.]+$", text, re.M)
    assert [float(mean) for mean in rows] == pytest.approx([150.0] * 3, rel=0.1)


@pytest.mark.nightly  # It exports a network; the export itself: test_export.py.
def test_sb3_model(tmp_path: Path) -> None:
    text = output_of("sb3_model.py", tmp_path)
    assert (tmp_path / "my-policy/card.json").is_file()
    assert len(re.findall(r"^seed \d: (success|collision|timeout), ", text, re.M)) == 2


def test_the_workflow_passes_with_a_shipped_policy(tmp_path: Path) -> None:
    """The command of the workflow, without the latency, in the vectorized simulator."""
    text = (EXAMPLES / "rehearsal.yml").read_text(encoding="utf-8")
    found = re.search(r"airl (evaluate .*?)\n      - ", text, re.S)
    assert found is not None
    words = shlex.split(found[1])
    for old, new in (("policies/mine", "static-obstacles"), ("lockstep", "gym"), ("300", "80")):
        words[words.index(old)] = new
    for option in ("--computer", "--workload"):
        del words[words.index(option) : words.index(option) + 2]
    with running(["-c", AIRL, *words], tmp_path) as program:
        assert program.wait(280.0) == 0, program.text()
    assert (tmp_path / "runs/ci/junit.xml").is_file()
    assert (tmp_path / "runs/ci/rehearsal.svg").is_file()


def test_gymnasium_loop(tmp_path: Path) -> None:
    text = output_of("gymnasium_loop.py", tmp_path)
    assert len(re.findall(r"^seed [123]: \w+ after", text, re.M)) == 3


def test_conducted_program(tmp_path: Path) -> None:
    text = output_of("conducted_program.py", tmp_path)
    north, east, down = (float(word) for word in text.strip("[] \n").split())
    assert 8.0 < north < 12.0, "2 m/s for 5 s, and stopped"
    assert abs(east) < 1.0
    assert abs(down) < 0.2, "landed"


@pytest.mark.nightly
def test_mavsdk_client_flies_a_square(tmp_path: Path) -> None:
    ports = choose_ports()
    firmware_words = [
        "-m",
        "airl_mav.cli.firmware_command",
        "--arena",
        "open-field",
        *ports.options(),
    ]
    with running([*firmware_words, "--speed", "3"], tmp_path):
        text = output_of("mavsdk_client.py", tmp_path, f"udpin://{LOOPBACK}:{ports.api}")
    assert "landed" in text
    corners = numbers_after(r"corner at (-?[\d.]+) m north, (-?[\d.]+) m east", text)
    assert len(corners) == 8
    # Sides of 2 m/s, for 3 s of wall time at three times real time.
    assert math.dist(corners[0:2], corners[4:6]) > 8.0
    assert math.hypot(*corners[6:8]) < 12.0, "back near the start"


@pytest.mark.nightly
def test_own_camera_flies_to_the_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The companion with a driver of the user's, named by its file."""
    ports = choose_ports()
    monkeypatch.setenv("CAMERA", f"tcp://{LOOPBACK}:{ports.camera}")
    firmware = ["-m", "airl_mav.cli.firmware_command", "--arena", "open-field", *ports.options()]
    with running([*firmware, "--speed", "3"], tmp_path) as vehicle:
        vehicle.wait_for_text("Ctrl-C ends it")
        companion = [
            *("-m", "airl_mav.cli.companion_command", "--policy", "greedy", "--goal", "9", "0"),
            *("--connect", f"udpin://{LOOPBACK}:{ports.api}", "--speed", "3"),
            *("--camera", f"{EXAMPLES / 'own_camera.py'}:SimulatorCamera"),
        ]
        with running([*companion, "--check"], tmp_path) as program:
            assert program.wait(120.0) == 0, program.text()
        found = re.findall(r"^(\w[\w ]+?) +ok +(.*)", program.text(), re.M)
        assert [what for what, _ in found] == [
            *("policy", "camera", "flight controller", "telemetry", "battery", "health", "decision")
        ]
        assert "64x48 px" in found[1][1]
        assert "PX4, disarmed, mode hold" in found[2][1]
        with running(companion, tmp_path) as program:
            assert program.wait(120.0) == 0, program.text()
    assert "goal reached" in program.text()


def test_camera_publisher_is_heard(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/camera"
    with running([str(EXAMPLES / "camera_publisher.py"), endpoint], tmp_path):
        source = open_camera(endpoint, WallClock())
        received = source.wait(-1, 60.0)
        source.close()
    assert received is not None
    assert source.malformed == 0
    lens = Intrinsics.from_fov(64, 48, math.radians(90.0))
    assert received.frame.intrinsics == lens
    # The lowest row's ray hits the ground 2 m below.
    lowest = 2000.0 * lens.focal / (47 - lens.cy)
    assert abs(int(received.frame.depth_mm[-1, 0]) - lowest) <= 1
    assert not received.frame.depth_mm[:24].any(), "nothing above the horizon"

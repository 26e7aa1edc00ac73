"""Learned policy in flight: one rule for training and rehearsal, and rejected input."""

from __future__ import annotations

import json
import math
import shutil
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sb3_contrib", reason="needs the [train] extra")
pytest.importorskip("onnxscript", reason="needs the [train] extra")

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli import main
from airl_mav.core.errors import UsageError
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy import card as cards
from airl_mav.policy import registry
from airl_mav.policy.actions import Action, ActionSpec, commands
from airl_mav.policy.card import CARD_FILE, PolicyCard, Runtime, TorchRuntime, read_card
from airl_mav.policy.card_writing import write_card
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.observation import Kinematics, Observation, encode
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.policy.registry import (
    LearnedPolicy,
    decide,
    find_policy,
    load_learned,
    load_policy,
    policy_names,
)
from airl_mav.profiles.loading import profiles_dir
from airl_mav.scenario.checks import decide_piloting, select_latency
from airl_mav.scenario.model import DEFAULT_POLICY, Decisions, PilotSettings, Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.frame_source import ReceivedFrame
from companion.pilot import check_camera
from tests.support.policy_kit import SPEC, export_tiny, noise
from tests.support.processes import SITL_WITHOUT_REPORT, run_alone, running

LENS = Intrinsics.from_fov(64, 48, math.radians(90.0))
POLICIES = {"discrete": ("DQN", "arc-25"), "continuous": ("SAC", "velocity")}


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policies")
    for name, (algorithm, actions) in POLICIES.items():
        export_tiny(folder / name, algorithm, actions, name=name, with_torch=True)
    return folder


@pytest.fixture
def folder(exported: Path, tmp_path: Path) -> Path:
    """A discrete policy that a test may spoil."""
    return Path(shutil.copytree(exported / "discrete", tmp_path / "mine"))


def edit(folder: Path, **changes: Any) -> None:
    """Change the card."""
    plain = json.loads((folder / CARD_FILE).read_text())
    plain.pop("crc32", None)
    (folder / CARD_FILE).write_text(json.dumps(plain | changes))


def scene(seed: int = 1, lens: Intrinsics = LENS) -> Observation:
    """Return what one vehicle senses: a frame over the wire, telemetry, a goal."""
    rng = np.random.default_rng(seed)
    depth = rng.integers(0, 30_000, (lens.height, lens.width), np.uint16)
    frame = Frame.from_bytes(Frame(7, 1000, depth, lens).to_bytes())
    quaternion = np.array([1.0, *rng.normal(0, 0.3, 3)])
    state = Kinematics(
        rng.normal(0, 5, 3), rng.normal(0, 2, 3), quaternion / np.linalg.norm(quaternion)
    )
    return encode(frame, state, (20.0, -5.0))


class Answers(Runtime):
    """Network that returns given outputs and records its inputs."""

    def __init__(self, outputs: Any) -> None:
        self.outputs = np.asarray(outputs, np.float32)
        self.seen: list[Any] = []

    def infer(self, encoded: Any) -> np.ndarray:
        self.seen.append(encoded)
        return self.outputs


# --- runtimes


@pytest.mark.nightly
@pytest.mark.parametrize("name", POLICIES)
def test_torch_and_onnx_give_the_same(exported: Path, name: str) -> None:
    seen = noise(100)
    by_onnx = load_learned(exported / name).act_batch(seen)
    by_torch = load_learned(exported / name, runtime="torch", trust=True).act_batch(seen)
    assert len(np.unique(by_onnx, axis=0)) > 2
    np.testing.assert_allclose(by_torch, by_onnx, atol=1e-5)


@pytest.mark.nightly
def test_threads_do_not_change_what_comes_out(exported: Path) -> None:
    seen = noise(5)
    one = load_learned(exported / "continuous", threads=1).act_batch(seen)
    two = load_learned(exported / "continuous", threads=2).act_batch(seen)
    np.testing.assert_allclose(one, two, atol=1e-6)


def test_a_torch_program_runs_only_when_its_maker_is_trusted(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError) as caught:
        load_policy(str(folder), 0.5, runtime="torch")
    assert str(caught.value).startswith(f"{folder}: its policy.pt2 can run any code")
    assert "--trust" in str(caught.value)
    assert isinstance(load_policy(str(folder), 0.5, runtime="torch", trust=True), LearnedPolicy)
    # A policy that is shipped with the package.
    (folder.parent / "policies").mkdir()
    shipped = folder.rename(folder.parent / "policies" / folder.name)
    monkeypatch.setattr(cards, "profiles_dir", lambda: shipped.parents[1])
    assert load_learned(shipped, runtime="torch").card.name


def test_torch_without_its_program_is_refused(folder: Path) -> None:
    data = (folder / "policy.pt2").read_bytes()
    (folder / "policy.pt2").write_bytes(data[:-1] + b"?")
    with pytest.raises(UsageError, match=r"policy\.pt2: SHA-256"):
        load_learned(folder, runtime="torch")
    (folder / "policy.pt2").unlink()
    with pytest.raises(UsageError, match=r"policy.pt2: No such file"):
        load_learned(folder, runtime="torch")
    edit(folder, torch_sha256=None)
    with pytest.raises(UsageError, match=r"policy.pt2: the card names none"):
        load_learned(folder, runtime="torch")
    with pytest.raises(ValueError, match="not a program that torch loads"):
        TorchRuntime(b"nothing", SPEC)


# --- one decision


def test_one_decision_is_the_networks_best_score(exported: Path) -> None:
    policy = load_learned(exported / "discrete")
    seen = scene()
    runtime: Runtime = policy._runtime
    batch = Observation(
        seen.depth_mm[None],
        LENS,
        seen.goal[None],
        seen.velocity[None],
        roll=np.array([seen.roll]),
        pitch=np.array([seen.pitch]),
        yaw=np.array([seen.yaw]),
    )
    scores = runtime.infer(encode_layout(SPEC, batch))
    forward, right, turn = commands(ActionSpec(), np.array([int(np.argmax(scores))]))[0]
    action = policy.act(seen)
    assert isinstance(action, Action)
    assert (action.forward_m_s, action.right_m_s, action.yaw_rate_rad_s) == (forward, right, turn)


def test_scores_and_pairs_become_actions() -> None:
    discrete, continuous = ActionSpec(), ActionSpec(set="velocity")
    scores = np.full((3, 25), -5.0, np.float32)
    scores[0, 24], scores[1, 0], scores[2, 7] = 1.0, np.inf, -4.9
    np.testing.assert_array_equal(decide(discrete, scores), [24, 0, 7])
    pairs = np.array([[0.5, -1.0]], np.float32)
    np.testing.assert_array_equal(decide(continuous, pairs), pairs)
    for spec, outputs in ((discrete, scores), (continuous, pairs)):
        bad = outputs.copy()
        bad[0, 1] = np.nan
        with pytest.raises(ValueError, match="not a number"):
            decide(spec, bad)


@pytest.mark.parametrize(
    ("lens", "words"),
    [
        (Intrinsics.from_fov(48, 36, math.radians(90.0)), ["48x36", "32x24"]),
        (Intrinsics.from_fov(64, 48, math.radians(70.0)), ["70.0 deg", "90.0 deg"]),
    ],
)
def test_another_camera_is_refused(exported: Path, lens: Intrinsics, words: list[str]) -> None:
    policy = load_learned(exported / "discrete")
    policy.act(scene())
    with pytest.raises(UsageError) as error:
        policy.act(scene(lens=lens))
    for word in ("discrete", *words):
        assert word in str(error.value)
    policy.act(scene())
    assert policy.refuses(LENS) is None
    refused = policy.refuses(lens)
    assert refused is not None
    assert refused in str(error.value)


# --- chance


def test_chance_has_its_share_and_its_seed(exported: Path) -> None:
    card = read_card(exported / "discrete").model_copy(update={"epsilon": 0.3})
    scores = np.zeros((20_000, 25), np.float32)
    scores[:, 11] = 1.0
    seen = {"goal": np.zeros((20_000, 3), np.float32)}
    policy = LearnedPolicy(card, Answers(scores))
    chosen = policy.act_batch(seen, np.random.default_rng(4))
    # 24 of 25 random actions are others: 0.288, sd 0.0032.
    assert np.mean(chosen != 11) == pytest.approx(0.3 * 24 / 25, abs=0.015)
    counts = np.bincount(chosen, minlength=25)
    others = np.delete(counts, 11)
    assert others.min() > 0.8 * 20_000 * 0.3 / 25
    assert others.max() < 1.2 * 20_000 * 0.3 / 25
    again = policy.with_generator(np.random.default_rng(4)).act_batch(seen)
    np.testing.assert_array_equal(again, chosen)
    assert (policy.act_batch(seen, np.random.default_rng(5)) != chosen).any()
    with pytest.raises(ValueError, match="needs a random generator"):
        policy.act_batch(seen)


def test_without_epsilon_nothing_is_drawn(exported: Path) -> None:
    rng = np.random.default_rng(1)
    before = rng.bit_generator.state
    load_learned(exported / "discrete", rng=rng).act_batch(noise(3))
    assert rng.bit_generator.state == before


# --- ablation


@pytest.mark.parametrize("key", ["depth", "velocity", "goal"])
def test_an_ablated_input_never_reaches_the_network(exported: Path, key: str) -> None:
    network = Answers(np.zeros((4, 25)))
    policy = LearnedPolicy(read_card(exported / "discrete"), network, ablate=key)
    seen = noise(4)
    policy.act_batch(seen)
    (shown,) = network.seen
    for name, values in seen.items():
        np.testing.assert_array_equal(shown[name], 0 * values if name == key else values)


def test_an_input_that_is_none_cannot_be_ablated(exported: Path) -> None:
    with pytest.raises(UsageError, match="'smell': accepted: depth, velocity, goal"):
        load_learned(exported / "discrete", ablate="smell")


# --- training and flight


@pytest.mark.parametrize(("layout", "height"), [("body", 24), ("paper", 58)], ids=["body", "paper"])
def test_the_companion_encodes_what_the_environment_does(layout: str, height: int) -> None:
    """Five vehicles in mid-flight: each one's frame, over the wire, and telemetry."""
    width = 32 if layout == "body" else 64
    knobs = {"layout": layout, "image_width_px": width, "image_height_px": height}
    navigation = Navigation(EnvironmentSpec.model_validate(knobs), 5)
    navigation.begin(range(5), [11, 12, 13, 14, 15])
    rng = np.random.default_rng(3)
    for _ in range(4):
        navigation.fly(commands(ActionSpec(), rng.integers(0, 25, 5)))
    trained = navigation.observe()
    spec = ObservationSpec(
        layout="body" if layout == "body" else "paper",
        height_px=height,
        width_px=width,
        horizontal_fov_deg=90.0,
        range_m=20.0,
    )
    images, state = navigation.see().depth_mm, navigation.kinematics()
    assert len({image.tobytes() for image in images}) == 5
    for i, arena in enumerate(navigation.arenas):
        assert arena is not None
        sent = Frame(i, 1000 * i, images[i], navigation.intrinsics).to_bytes()
        one = Kinematics(state.position[i], state.velocity[i], state.quaternion[i])
        network = Answers(np.zeros((1, 25)))
        card = card_of(spec)
        north, east = arena.goal
        LearnedPolicy(card, network).act(encode(Frame.from_bytes(sent), one, (north, east)))
        (flown,) = network.seen
        assert flown.keys() == trained.keys()
        for key, values in flown.items():
            assert values.dtype == trained[key].dtype
            np.testing.assert_array_equal(values[0], trained[key][i])


def card_of(spec: ObservationSpec) -> PolicyCard:
    """Return a card for a network that needs none: only its layout counts."""
    return PolicyCard(
        name="none",
        observation=spec,
        hold_s=0.5,
        goal_radius_m=3.0,
        altitude_m=2.5,
        sha256="0" * 64,
        network="none",
        parameters=1,
        macs=1,
    )


# --- by name


def test_policies_are_found_by_name_and_by_path(
    exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_policy(DEFAULT_POLICY).description
    assert policy_names()[0] == "greedy"
    info = find_policy(str(exported / "discrete"))
    card = read_card(exported / "discrete")
    assert (info.name, info.description) == ("discrete", "random weights")
    assert (info.card, info.sha256, info.macs) == (card, card.sha256, card.macs)
    greedy = find_policy("greedy")
    assert (greedy.card, greedy.sha256, greedy.macs) == (None, None, None)
    monkeypatch.chdir(exported)
    assert find_policy("./continuous").name == "continuous"

    # As shipped: profiles/policies/<name>/
    for module in (cards, registry):
        monkeypatch.setattr(module, "profiles_dir", lambda: exported.parent / "shipped")
    shutil.copytree(exported, exported.parent / "shipped" / "policies")
    monkeypatch.chdir("/")
    assert policy_names() == ["greedy", "planner", "continuous", "discrete"]
    assert isinstance(load_policy("continuous", 0.5), LearnedPolicy)
    with pytest.raises(UsageError) as error:
        find_policy("discreet")
    assert "greedy, planner, continuous, discrete (or a path" in str(error.value)


def test_greedy_takes_no_runtime_and_no_ablation() -> None:
    cases: list[dict[str, Any]] = [{"runtime": "torch"}, {"ablate": "depth"}]
    for options in cases:
        with pytest.raises(UsageError, match="accepted: for a learned policy; greedy is none"):
            load_policy("greedy", 0.5, **options)


# --- the card's settings in flight


def test_the_pilot_flies_as_the_card_says_unless_told_otherwise(exported: Path) -> None:
    learned, greedy = find_policy(str(exported / "discrete")), find_policy("greedy")
    silent, radius_m = Decisions(), PilotSettings.goal_radius_m
    assert decide_piloting(silent, greedy, radius_m)[0] == PilotSettings()
    assert decide_piloting(silent, learned, radius_m)[0] == PilotSettings(
        hold_s=0.4, goal_radius_m=2.5, altitude_m=2.0, max_speed_m_s=5.0
    )
    asked = Decisions(hold_s=0.0, altitude_m=3.0)
    for info, radius in ((learned, 2.5), (greedy, radius_m)):
        pilot, _ = decide_piloting(asked, info, radius_m)
        assert (pilot.hold_s, pilot.altitude_m) == (0.0, 3.0)
        assert pilot.goal_radius_m == radius


def test_sitl_flies_as_the_card_says_unless_told_otherwise(exported: Path) -> None:
    path = str(exported / "discrete")
    resolved = resolve(Scenario(policy=path))
    pilot = resolved.pilot
    assert (pilot.hold_s, pilot.altitude_m, pilot.goal_radius_m) == (0.4, 2.0, 2.5)
    policy = resolved.setup.policy
    assert (policy.name, policy.description) == ("discrete", "random weights")
    # The companion flies closer to the goal than the referee requires.
    assert resolved.companion_pilot == replace(pilot, goal_radius_m=2.0)
    pilot = resolve(Scenario(policy=path, hold_s=0.7, goal_radius_m=4.0)).pilot
    assert (pilot.hold_s, pilot.altitude_m, pilot.goal_radius_m) == (0.7, 2.0, 4.0)
    pilot = resolve(Scenario(policy="greedy")).pilot
    assert (pilot.hold_s, pilot.altitude_m, pilot.goal_radius_m) == (0.5, 2.5, 3.0)


def test_a_torch_program_of_a_stranger_is_not_loaded_unasked(
    exported: Path, refuse: Callable[..., str]
) -> None:
    path = str(exported / "discrete")
    for command in (main.sitl, main.companion):
        line = refuse(command, "--policy", path, "--runtime", "torch")
        assert "accepted: with --trust" in line
        assert "policy.pt2" in line
    resolve(Scenario(policy=path, runtime="torch", trust=True))


def test_what_was_measured_for_this_policy_is_injected(exported: Path, tmp_path: Path) -> None:
    card = read_card(exported / "discrete")
    shipped = (profiles_dir() / "computers" / "ras-pi-4.toml").read_text(encoding="utf-8")
    computer = tmp_path / "pi.toml"
    computer.write_text(
        shipped.replace(
            "[workloads.template-5x32]",
            f'[workloads.template-5x32]\npolicy_sha256 = "{card.sha256}"',
        ),
        encoding="utf-8",
    )
    path = str(exported / "discrete")
    resolved = resolve(Scenario(policy=path, computer=str(computer)))
    assert resolved.injection.origin == "injected"
    assert "this policy as timed" in resolved.injection.label
    other = resolve(Scenario(policy=str(exported / "continuous"), computer=str(computer)))
    assert other.injection.origin == "measured"
    guess = resolve(Scenario(policy=path, computer="ras-pi-4", workload="estimate"))
    assert guess.injection.origin == "estimated"
    # Its decision is much longer than its network.
    with pytest.raises(UsageError, match="a policy that is only a network"):
        resolve(Scenario(policy="generalist", computer="ras-pi-4", workload="estimate"))

    # Stand-alone, the companion runs on that very computer. In lockstep no computer counts.
    asked, policy = StandAloneCompanion(policy=path, computer=str(computer)), resolved.policy
    assert select_latency(asked, policy, on_this_computer=True).origin == "measured"
    assert select_latency(asked, policy, on_this_computer=False) == resolved.injection


# --- rejected before a flight


@pytest.fixture
def refuse(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., str]:
    """Run a command that must refuse its options; return its one line of error."""

    def run(command: Callable[[], None], *options: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["airl", *options])
        with pytest.raises(SystemExit) as end:
            command()
        out, err = capsys.readouterr()
        assert end.value.code == 2
        assert out == ""
        (line,) = err.splitlines()
        assert line.startswith("error: ")
        assert not (tmp_path / "runs").exists()
        return line

    return run


@pytest.mark.parametrize("command", [main.sitl, main.companion])
def test_a_policy_that_cannot_be_flown_is_refused(
    folder: Path, refuse: Callable[..., str], command: Callable[[], None]
) -> None:
    assert "no such policy; known: greedy" in refuse(command, "--policy", "nowhere/to/be/found")
    assert "card.json: No such file" in refuse(command, "--policy", str(folder.parent))
    edit(folder, hold_s=99.0)
    assert "hold_s = 99: accepted: 0 <= value <= 10 s" in refuse(command, "--policy", str(folder))
    edit(folder, hold_s=3.0)
    assert "--decision-timeout-s 2: accepted: more than" in refuse(command, "--policy", str(folder))
    edit(folder, hold_s=0.5, torch_sha256=None)
    line = refuse(command, "--policy", str(folder), "--runtime", "torch", "--trust")
    assert "policy.pt2: the card names none" in line
    assert "--threads 0: accepted: 1 <= value" in refuse(
        command, "--policy", str(folder), "--threads", "0"
    )
    data = bytearray((folder / "policy.onnx").read_bytes())
    data[len(data) // 2] ^= 4
    (folder / "policy.onnx").write_bytes(data)
    assert "policy.onnx: SHA-256" in refuse(command, "--policy", str(folder))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("width_px = 64", "width_px = 60", ["60x48 px", "accepted: 32x24 px"]),
        ("horizontal_fov_deg = 90.0", "horizontal_fov_deg = 70.0", ["70.0 deg", "90.0 deg"]),
        ("range_m = 20.0", "range_m = 12.0", ["range of 12 m", "20 m or more"]),
    ],
)
def test_a_vehicle_with_another_camera_is_refused(
    exported: Path,
    tmp_path: Path,
    refuse: Callable[..., str],
    old: str,
    new: str,
    words: list[str],
) -> None:
    shipped = (profiles_dir() / "vehicles" / "quad.toml").read_text(encoding="utf-8")
    assert old in shipped
    vehicle = tmp_path / "mine.toml"
    vehicle.write_text(shipped.replace(old, new), encoding="utf-8")
    line = refuse(main.sitl, "--policy", str(exported / "discrete"), "--vehicle", str(vehicle))
    for word in ("--policy", str(vehicle), *words):
        assert word in line


class Camera:
    """A camera that shows its n-th frame, or none."""

    def __init__(self, lens: Intrinsics, silent_waits: int = 0) -> None:
        self.frame = Frame(3, 0, np.zeros((lens.height, lens.width), np.uint16), lens)
        self.silent_waits = silent_waits

    def latest(self) -> ReceivedFrame | None:
        return None

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        self.silent_waits -= 1
        return None if self.silent_waits >= 0 else ReceivedFrame(self.frame, 0)


def test_the_companion_looks_at_its_camera_before_take_off(exported: Path) -> None:
    policy = load_policy(str(exported / "discrete"), 0.5)
    wide, stop = Intrinsics.from_fov(64, 48, 2.0), threading.Event()
    check_camera(policy, Camera(LENS, 3), stop)
    with pytest.raises(UsageError, match="--policy discrete: camera with a horizontal field"):
        check_camera(policy, Camera(wide, 3), stop)
    check_camera(load_policy("greedy", 0.5), Camera(wide), stop)
    # A missing frame is handled by the pilot, not by the card check.
    check_camera(policy, Camera(wide, 1000), stop)
    stop.set()
    waits = Camera(wide, 1000)
    check_camera(policy, waits, stop)
    assert waits.silent_waits == 999


# --- processes

ALONE = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent}:
            raise ImportError(f"{{name}} is not for the companion")

sys.meta_path.insert(0, Absent())

import math
import numpy as np
import companion.pilot, companion.pilot, airl_mav.cli.companion_command as cli
from companion.program import prepare
assert "onnxruntime" not in sys.modules, "nobody asked for a network yet"
policy = prepare(cli.OPTIONS(policy={folder!r})).policy
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.policy.observation import Observation
lens = Intrinsics.from_fov(64, 48, math.radians(90.0))
seen = Observation(np.zeros((48, 64), np.uint16), lens, np.ones(2), np.zeros(3), 0.0, 0.0, 0.0)
policy.act(seen)
assert "onnxruntime" in sys.modules
found = {absent} & set(sys.modules)
assert not found, found
"""

NOT_ON_A_DRONE = {
    *("torch", "onnx", "onnxscript", "stable_baselines3", "sb3_contrib", "gymnasium"),
    *("numba", "pybullet", "scipy", "matplotlib", "pymavlink", "filterpy", "jinja2"),
}


def test_onnx_flies_without_torch_and_without_a_word(exported: Path, tmp_path: Path) -> None:
    code = ALONE.format(absent=NOT_ON_A_DRONE, folder=str(exported / "discrete"))
    done = run_alone(code, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout + done.stderr == ""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("flight")
@pytest.mark.timeout(300)
def test_a_learned_policy_flies_a_rehearsal(folder: Path, tmp_path: Path) -> None:
    write_card(folder, read_card(folder).model_copy(update={"hold_s": 0.3, "epsilon": 0.2}))
    run = tmp_path / "run"
    words = [*SITL_WITHOUT_REPORT, "--level", "lockstep", "--policy", str(folder)]
    words += ["--out", str(run), "--episodes", "1", "--time-limit-s", "4"]
    with running(words, tmp_path) as process:
        assert process.wait(250.0) == 0, process.text()
    config = json.loads((run / "run.json").read_text(encoding="utf-8"))
    assert config["setup"]["policy"] == {"name": "discrete", "description": "random weights"}
    assert config["config"]["pilot"]["hold_s"] == 0.3
    with np.load(run / "latency.npz") as archive:
        sent = [archive[key] for key in archive.files if key.endswith("sent_us")]
    assert len(sent) == 1
    for times in sent:
        assert len(times) >= 5
        periods_s = np.diff(times) / 1e6
        # Its own hold, not the default of 0.5 s.
        assert 0.3 <= np.median(periods_s) < 0.5

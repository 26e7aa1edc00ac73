"""Export: ONNX Runtime reproduces the trained model's outputs, for every training library."""

from __future__ import annotations

import base64
import json
import os
import pickle
import re
import sys
import warnings
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sb3_contrib", reason="needs the [train] extra")
pytest.importorskip("onnxscript", reason="needs the [train] extra")

import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.dqn.policies import MultiInputPolicy
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from airl_mav.cli import main
from airl_mav.core.errors import UsageError
from airl_mav.policy.actions import ActionSpec
from airl_mav.policy.card import load_card, open_model, read_card
from airl_mav.policy.card_writing import write_card
from airl_mav.policy.layouts import boxes
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.policy.registry import decide, load_learned
from airl_mav.profiles.computer import load_computer
from airl_mav.training import onnx_export as export
from airl_mav.training.export import export_sb3, network_of
from airl_mav.training.onnx_export import random_inputs
from tests.support.policy_kit import SPEC, Nowhere, export_tiny, facts, make_model, noise
from tests.support.processes import ROOT

ONE = (
    torch.zeros(1, 1, SPEC.height_px, SPEC.width_px, dtype=torch.uint8),
    torch.zeros(1, 3),
    torch.zeros(1, 3),
)

MODELS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "DQN": ("DQN", "arc-25", {}),
    "QRDQN": ("QRDQN", "paper-25", {"policy_kwargs": {"n_quantiles": 7}}),
    "PPO": ("PPO", "arc-25", {}),
    "PPO, two extractors": (
        "PPO",
        "arc-25",
        {"policy_kwargs": {"share_features_extractor": False}},
    ),
    "MaskablePPO": ("MaskablePPO", "arc-25", {}),
    "A2C": ("A2C", "paper-25", {}),
    "TRPO": ("TRPO", "arc-25", {}),
    "PPO, continuous": ("PPO", "velocity", {}),
    "PPO, squashed": (
        "PPO",
        "velocity",
        {"use_sde": True, "policy_kwargs": {"squash_output": True}},
    ),
    "SAC": ("SAC", "velocity", {}),
    "SAC, gSDE": ("SAC", "velocity", {"use_sde": True}),
    "TQC": ("TQC", "velocity", {}),
    "TD3": ("TD3", "velocity", {}),
    "DDPG": ("DDPG", "velocity", {}),
}


def model_of(name: str) -> tuple[BaseAlgorithm, ActionSpec]:
    algorithm, actions, options = MODELS[name]
    return make_model(algorithm, actions, **options), ActionSpec.model_validate({"set": actions})


def compare(found: np.ndarray, wanted: np.ndarray) -> None:
    """Compare decisions, which must not all be the same."""
    if found.ndim == 2:
        assert np.ptp(found, axis=0).min() > 0.1
        np.testing.assert_allclose(found, wanted, atol=1e-5)
    else:
        assert len(set(wanted.tolist())) > 2
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("name", MODELS)
def test_the_network_decides_as_the_model_predicts(name: str) -> None:
    model, actions = model_of(name)
    seen = noise(200)
    wanted, _ = model.predict(seen, deterministic=True)
    with torch.no_grad():
        outputs = network_of(model)(*(torch.from_numpy(seen[key]) for key in boxes(SPEC)))
    compare(decide(actions, outputs.numpy()), wanted)


@pytest.mark.parametrize(
    "name",
    [
        *("DQN", "QRDQN", "PPO", "SAC, gSDE"),
        *(pytest.param(n, marks=pytest.mark.nightly) for n in ("PPO, squashed", "TD3", "TQC")),
    ],
)
def test_onnx_decides_as_the_model_predicts(name: str, tmp_path: Path) -> None:
    model, actions = model_of(name)
    model.policy.set_training_mode(True)
    drawn = torch.get_rng_state()
    card = export_sb3(model, facts(actions=actions, algorithm=name), tmp_path)
    assert torch.equal(torch.get_rng_state(), drawn), "an export in training must not change it"
    assert model.policy.training
    seen = noise(200)
    wanted, _ = model.predict(seen, deterministic=True)
    compare(load_learned(tmp_path).act_batch(seen), wanted)
    assert card == load_card(tmp_path)


def scores_of(model: BaseAlgorithm) -> torch.nn.Module:
    """Return the network that scores the actions of a DQN."""
    network = model.policy.q_net
    assert isinstance(network, torch.nn.Module)
    return network


def test_scores_are_those_of_torch_for_any_number_of_rows(tmp_path: Path) -> None:
    model = make_model("DQN")
    card = export_sb3(model, facts(), tmp_path)
    runtime = open_model(tmp_path, card)
    for n in (1, 2, 17):
        seen = noise(n, seed=n)
        with torch.no_grad():
            wanted = scores_of(model)({k: torch.from_numpy(v) for k, v in seen.items()}).numpy()
        found = runtime.infer(seen)
        assert found.shape == (n, 25)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("scaled", [True, False])
def test_the_graph_scales_the_image_as_sb3_does(scaled: bool, tmp_path: Path) -> None:
    """Images are uint8; the network reads grey / 255, or grey if trained so."""
    model = make_model("DQN", policy_kwargs={"normalize_images": scaled})
    runtime = open_model(tmp_path, export_sb3(model, facts(), tmp_path))
    seen = noise(3)
    net: Any = model.policy.q_net
    floats = {k: torch.from_numpy(v.astype(np.float32)) for k, v in seen.items()}
    if scaled:
        floats["depth"] /= 255.0
    with torch.no_grad():
        wanted = net.q_net(net.features_extractor(floats)).numpy()
    np.testing.assert_allclose(runtime.infer(seen), wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["DQN", "PPO", "SAC", "PPO, two extractors"])
def test_parameters_and_macs_are_those_of_the_inference(name: str) -> None:
    algorithm, actions, options = MODELS[name]
    network = network_of(make_model(algorithm, actions, **options))
    with FlopCounterMode(display=False) as counter:
        network(*ONE)
    layers, parameters = export.inspect_network(network, ONE)
    macs = sum(layer.macs for layer in layers)
    assert macs == counter.get_total_flops() // 2
    # By hand: two convolutions to 11x15 and 5x7, dense 16, 16 and the output; no value function.
    outputs = 2 if actions == "velocity" else 25
    dense = (280 + 6) * 16 + 16 * 16 + 16 * outputs
    assert macs == 11 * 15 * 4 * 9 + 5 * 7 * 8 * 36 + dense
    assert parameters == (4 * 9 + 4) + (8 * 36 + 8) + dense + 16 + 16 + outputs
    parts = [layer.text for layer in layers]
    assert parts == ["conv 4 3x3/2", "conv 8 3x3/2", "dense 16", "dense 16", f"dense {outputs}"]


@pytest.mark.parametrize("workload", ["template-5x32", "template-4x48", "template-7x32"])
def test_counts_of_the_papers_networks(workload: str) -> None:
    """The computer profiles give them, counted in closed form."""
    network = load_computer("ras-pi-4").workloads[workload].network
    assert network.layers is not None
    assert network.filters is not None
    height, width, filters = network.image_height_px, network.image_width_px, network.filters

    class Template(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            assert network.layers is not None
            ins = [1] + [filters] * (network.layers - 1)
            self.eye = nn.Sequential(*(nn.Conv2d(n, filters, 3, padding=1) for n in ins))
            ins = [filters * height * width + 6] + [filters] * (network.layers - 1)
            self.mind = nn.Sequential(*(nn.Linear(n, filters) for n in ins))
            self.out = nn.Linear(filters, 25)

        def forward(self, depth: Any, velocity: Any, goal: Any) -> Any:
            flat = self.eye(depth / 255.0).flatten(1)
            return self.out(self.mind(torch.cat([flat, velocity, goal], dim=1)))

    with torch.device("meta"):
        template = Template()
        inputs = (torch.zeros(1, 1, height, width), torch.zeros(1, 3), torch.zeros(1, 3))
        layers, parameters = export.inspect_network(template, inputs)
        assert parameters == network.parameters
        assert sum(layer.macs for layer in layers) == network.macs


def test_the_card_tells_what_was_exported(tmp_path: Path) -> None:
    told = facts(hover_after_s=0.06, epsilon=0.05, goal_radius_m=3.5)
    card = export_sb3(make_model("DQN"), told, tmp_path)
    assert {name: getattr(card, name) for name in type(told).model_fields} == dict(told)
    assert card.network == "conv 4 3x3/2, conv 8 3x3/2, dense 16, dense 16, dense 25"
    assert card.parameters == sum(p.numel() for p in scores_of(make_model("DQN")).parameters())
    plain = json.loads((tmp_path / "card.json").read_text())
    assert next(iter(plain.items())) == ("schema", 1)
    assert plain["observation"] == {
        "layout": "body",
        "height_px": 24,
        "width_px": 32,
        "projection": "pinhole",
        "horizontal_fov_deg": 90.0,
        "range_m": 20.0,
        "kind": "depth",
        "frames": 1,
        "in_flight": [],
    }


@pytest.mark.nightly
def test_exports_are_equal_and_name_no_path_of_this_machine(tmp_path: Path) -> None:
    first = export_tiny(tmp_path / "a", with_torch=True)
    second = export_tiny(tmp_path / "b")
    assert first.sha256 == second.sha256
    with zipfile.ZipFile(tmp_path / "a" / "policy.pt2") as archive:
        inside = [archive.read(name) for name in archive.namelist()]
    for data in [*inside, *(path.read_bytes() for path in tmp_path.glob("*/*.*[nx]"))]:
        for word in (b"site-packages", str(ROOT).encode(), str(tmp_path).encode(), b".py"):
            assert word not in data


@pytest.mark.nightly
def test_a_second_export_replaces_all_of_the_first(tmp_path: Path) -> None:
    export_tiny(tmp_path, with_torch=True)
    export_tiny(tmp_path, "PPO", name="other")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "README.md",
        "card.json",
        "policy.onnx",
    ]
    assert load_card(tmp_path).name == "other"


@pytest.mark.nightly
def test_nothing_is_written_when_the_export_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "new"
    export_tiny(tmp_path / "wrong", "PPO")
    wrong = (tmp_path / "wrong" / "policy.onnx").read_bytes()
    monkeypatch.setattr(export, "_onnx", lambda *_: wrong)
    with pytest.raises(UsageError, match="ONNX Runtime is off by"):
        export_tiny(out)
    assert not out.exists()


def test_a_network_without_finite_scores_is_refused(tmp_path: Path) -> None:
    model = make_model("DQN")
    with torch.no_grad():
        next(scores_of(model).parameters()).fill_(torch.nan)
    with pytest.raises(UsageError):
        export_sb3(model, facts(), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_policy_that_decides_by_more_than_its_network_is_refused(tmp_path: Path) -> None:
    class Contrary(MultiInputPolicy):
        def _predict(self, obs: Any, deterministic: bool = True) -> torch.Tensor:
            return self.q_net(obs).argmin(dim=1)

    model = make_model("DQN")
    model.policy.__class__ = Contrary
    with pytest.raises(UsageError, match="decides by more than its network"):
        export_sb3(model, facts(), tmp_path)


RECURRENT: dict[str, tuple[str, dict[str, Any]]] = {
    "discrete": ("arc-25", {"lstm_hidden_size": 12}),
    "continuous, two layers": ("velocity", {"lstm_hidden_size": 8, "n_lstm_layers": 2}),
    "one LSTM for both": (
        "velocity",
        {"lstm_hidden_size": 8, "shared_lstm": True, "enable_critic_lstm": False},
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        "continuous, two layers",
        *(pytest.param(n, marks=pytest.mark.nightly) for n in ("discrete", "one LSTM for both")),
    ],
)
def test_a_recurrent_policy_remembers_as_the_model_does(name: str, tmp_path: Path) -> None:
    """Flights of ten decisions, three beside each other, and two one after the other."""
    actions, kwargs = RECURRENT[name]
    model = make_model("RecurrentPPO", actions, n_steps=8, policy_kwargs=kwargs)
    spec = ActionSpec.model_validate({"set": actions})
    card = export_sb3(model, facts(actions=spec), tmp_path, with_torch=True)
    units, layers = kwargs["lstm_hidden_size"], kwargs.get("n_lstm_layers", 1)
    assert card.state == {"hidden": (layers, units), "cell": (layers, units)}
    assert card == load_card(tmp_path)
    assert f"lstm {units}" in card.network
    loaded = load_learned(tmp_path)
    by_torch = load_learned(tmp_path, runtime="torch", trust=True)
    differs = 0
    for flight in range(2):
        # One object per flight, as in the companion.
        policies = [loaded.with_generator(np.random.default_rng(0)) for _ in range(3)]
        together = loaded.with_generator(np.random.default_rng(0))
        trusted = by_torch.with_generator(np.random.default_rng(0))
        state: Any = None
        for k in range(10):
            seen = noise(3, seed=100 * flight + k)
            wanted, state = model.predict(seen, state, deterministic=True)
            rows = [{key: value[i : i + 1] for key, value in seen.items()} for i in range(3)]
            alone = [p.act_batch(row)[0] for p, row in zip(policies, rows, strict=True)]
            np.testing.assert_allclose(np.array(alone), wanted, atol=1e-5)
            np.testing.assert_allclose(together.act_batch(seen), wanted, atol=1e-5)
            np.testing.assert_allclose(trusted.act_batch(seen), wanted, atol=1e-5)
            forgetful, _ = model.predict(seen, deterministic=True)
            differs += int(np.abs(forgetful - wanted).max() > 1e-3)
    assert differs > 5, "the memory matters"


OWN_LAYOUT = """
from airl_mav.policy.layouts import boxes, encode_layout

class Metric:
    def boxes(self, spec):
        return boxes(spec.model_copy(update={"layout": "body"}))

    def encode(self, spec, seen):
        body = encode_layout(spec.model_copy(update={"layout": "body"}), seen)
        return {**body, "velocity": 5.0 * body["velocity"]}
"""


@pytest.mark.parametrize(
    ("algorithm", "changed"),
    [("PPO", "layout"), ("RecurrentPPO", "in_flight"), ("RecurrentPPO", "both")],
)
def test_any_arrays_go_to_the_network_in_the_layout_s_order(
    algorithm: str, changed: str, tmp_path: Path
) -> None:
    """Sort the arrays of a custom layout by name, even if they equal the arrays of `body`."""
    (tmp_path / "layouts.py").write_text(OWN_LAYOUT)
    changes: dict[str, Any] = {}
    if changed != "layout":
        changes["in_flight"] = ("command", "age")
    if changed != "in_flight":
        changes["layout"] = f"{tmp_path / 'layouts.py'}:Metric"
    spec = ObservationSpec.model_validate(SPEC.model_dump() | changes)
    options: dict[str, Any] = {"n_steps": 8} if algorithm == "RecurrentPPO" else {}
    model = make_model(algorithm, "velocity", spec=spec, **options)
    asked = facts(observation=spec, actions=ActionSpec(set="velocity"))
    card = export_sb3(model, asked, tmp_path / "mine")
    seen = random_inputs(spec, 20, np.random.default_rng(1))
    wanted, _ = model.predict(seen, deterministic=True)
    found = load_learned(tmp_path / "mine", trust=True).act_batch(seen)
    compare(found, wanted)
    assert card.observation == spec


def test_the_card_and_the_file_agree_on_the_memory(tmp_path: Path) -> None:
    model = make_model("RecurrentPPO", n_steps=8, policy_kwargs={"lstm_hidden_size": 12})
    card = export_sb3(model, facts(), tmp_path)
    with pytest.raises(ValueError, match="3 flights; accepted: 2"):
        policy = load_learned(tmp_path)
        policy.act_batch(noise(2))
        policy.act_batch(noise(3))
    for state in ({}, {"hidden": (1, 13), "cell": (1, 13)}):
        write_card(tmp_path, card.model_copy(update={"state": state}))
        with pytest.raises(UsageError, match=r"policy\.onnx: inputs .*hidden"):
            load_card(tmp_path)


# --- the command


Refuse = Callable[..., str]


@pytest.fixture(scope="module")
def zips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Foreign models in the format of their `save`."""
    folder = tmp_path_factory.mktemp("zips")
    make_model("DQN").save(folder / "dqn.zip")
    make_model("SAC", "velocity").save(folder / "sac.zip")
    make_model("A2C", space=spaces.Discrete(7)).save(folder / "seven.zip")
    make_model("TD3", space=spaces.Box(-5.0, 5.0, (2,), np.float32)).save(folder / "five.zip")
    (folder / "text.zip").write_text("not a zip")
    with zipfile.ZipFile(folder / "empty.zip", "w") as archive:
        archive.writestr("readme.txt", "nothing")
    return folder


def airl(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["airl", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        main.main()
    return int(end.value.code or 0)


def test_a_foreign_zip_exports_with_one_command(
    zips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine"
    code = airl(
        monkeypatch,
        *("export", "--trust", zips / "dqn.zip", "--algorithm", "dqn", "--out", out),
        *(
            "--image",
            "32x24",
            "--horizontal-fov-deg",
            "90",
            "--range-m",
            "15",
            "--actions",
            "paper-25",
        ),
        *(
            "--max-speed-m-s",
            "4",
            "--hold-s",
            "0.25",
            "--epsilon",
            "0.1",
            "--description",
            "a friend's",
        ),
    )
    assert code == 0
    card = read_card(out)
    assert card.name == "mine"
    assert card.description == "a friend's"
    assert card.observation == SPEC.model_copy(update={"range_m": 15.0})
    assert card.actions == ActionSpec(set="paper-25", max_speed_m_s=4.0)
    assert (card.hold_s, card.epsilon) == (0.25, 0.1)
    assert card.training.command is not None
    assert card.training.command.startswith("airl export ")
    assert card.training.versions["torch"] == torch.__version__
    seen = noise(50)
    wanted, _ = make_model("DQN").predict(seen, deterministic=True)
    chosen = open_model(out, card).infer(seen).argmax(axis=1)
    np.testing.assert_array_equal(chosen, wanted)
    printed = capsys.readouterr()
    assert "policy.onnx" in printed.out
    assert printed.err == ""


@pytest.mark.nightly
def test_a_foreign_continuous_model_and_the_paper_layout(
    zips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--algorithm", "SAC", "--actions", "velocity", "--with-torch")
    assert (
        airl(monkeypatch, "export", "--trust", zips / "sac.zip", "--out", tmp_path / "v", *words)
        == 0
    )
    assert (tmp_path / "v" / "policy.pt2").is_file()
    assert load_learned(tmp_path / "v", runtime="torch", trust=True).act_batch(noise(4)).shape == (
        4,
        2,
    )
    paper = ObservationSpec(
        layout="paper", height_px=34, width_px=32, horizontal_fov_deg=90.0, range_m=20.0
    )
    make_model("PPO", spec=paper).save(tmp_path / "paper.zip")
    layout = ("--algorithm", "PPO", "--layout", "paper", "--image", "32x34")
    assert (
        airl(
            monkeypatch,
            "export",
            "--trust",
            tmp_path / "paper.zip",
            "--out",
            tmp_path / "p",
            *layout,
        )
        == 0
    )
    assert load_card(tmp_path / "p").observation == paper


def normalised(keys: Sequence[str], **options: Any) -> VecNormalize:
    """A VecNormalize that has seen something."""
    space: spaces.Space[Any] = spaces.Discrete(25)
    env = VecNormalize(
        DummyVecEnv([lambda: Nowhere(SPEC, space)]), norm_obs_keys=list(keys), **options
    )
    rng = np.random.default_rng(3)
    for key in keys if env.norm_obs else ():
        env.obs_rms[key].update(rng.normal(1.0, 0.5, (50, 3)))
    return env


@pytest.mark.parametrize("algorithm", ["DQN", "RecurrentPPO"])
def test_what_a_vec_normalize_did_becomes_part_of_the_network(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = normalised(["velocity", "goal"], clip_obs=2.5)
    env.save(str(tmp_path / "vecnormalize.pkl"))
    options: dict[str, Any] = {"n_steps": 8} if algorithm == "RecurrentPPO" else {}
    model = make_model(algorithm, **options)
    model.save(tmp_path / "model.zip")
    words = (
        "export",
        "--trust",
        tmp_path / "model.zip",
        "--algorithm",
        algorithm,
        "--out",
        tmp_path / "p",
    )
    given = ("--vec-normalize", tmp_path / "vecnormalize.pkl")
    assert airl(monkeypatch, *words, *given) == 0
    seen = noise(100)
    shown: Any = env.normalize_obs(dict(seen))
    assert (np.abs(shown["velocity"]) == 2.5).any(), "some are cut off"
    wanted, _ = model.predict(shown, deterministic=True)
    without, _ = model.predict(seen, deterministic=True)
    assert (wanted != without).any()
    compare(load_learned(tmp_path / "p").act_batch(seen), wanted)


@pytest.mark.nightly
def test_a_vec_normalize_of_rewards_alone_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    normalised([], norm_obs=False).save(str(tmp_path / "vecnormalize.pkl"))
    make_model("DQN").save(tmp_path / "model.zip")
    words = ("export", "--trust", tmp_path / "model.zip", "--algorithm", "DQN", "--out")
    given = ("--vec-normalize", tmp_path / "vecnormalize.pkl")
    assert airl(monkeypatch, *words, tmp_path / "with", *given) == 0
    assert airl(monkeypatch, *words, tmp_path / "without") == 0
    assert read_card(tmp_path / "with").sha256 == read_card(tmp_path / "without").sha256


@pytest.mark.parametrize(
    ("model", "file", "line"),
    [
        ("model.zip", "absent.pkl", "--vec-normalize absent.pkl: no such file"),
        ("model.zip", "model.zip", "--vec-normalize model.zip: no VecNormalize: "),
        ("model.zip", "other.pkl", "--vec-normalize other.pkl: accepted: what a VecNormalize of"),
        ("nets.py:Net", "other.pkl", "--vec-normalize other.pkl: accepted: with a .zip"),
        ("static-obstacles", "other.pkl", "--vec-normalize other.pkl: accepted: of a policy that"),
    ],
)
def test_what_is_no_vec_normalize_is_refused_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    model: str,
    file: str,
    line: str,
) -> None:
    make_model("DQN").save(tmp_path / "model.zip")
    (tmp_path / "nets.py").write_text(NETS)
    (tmp_path / "other.pkl").write_bytes(pickle.dumps([1, 2]))
    monkeypatch.chdir(tmp_path)
    words = ("--algorithm", "DQN") if model == "model.zip" else ()
    assert (
        airl(monkeypatch, "export", "--trust", model, "--vec-normalize", file, "--out", "p", *words)
        == 2
    )
    (told,) = capsys.readouterr().err.splitlines()
    assert line in told
    assert not (tmp_path / "p").exists()


class Canary:
    """An object whose pickle creates a folder."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("canary",)


@pytest.mark.parametrize("part", ["model.zip", "statistics.pkl"])
def test_nothing_is_unpickled_without_trust(
    part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    pickled = pickle.dumps(Canary())
    words = ["export", "model.zip", "--algorithm", "DQN", "--out", "p"]
    if part == "model.zip":
        with zipfile.ZipFile("model.zip", "w") as archive:
            held = {":type:": "a", ":serialized:": base64.b64encode(pickled).decode()}
            archive.writestr("data", json.dumps({"policy_class": held}))
    else:
        make_model("DQN").save("model.zip")
        Path(part).write_bytes(pickled)
        words += ["--vec-normalize", part]
    assert airl(monkeypatch, *words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "model.zip: unpickling it can run any code on this machine; accepted: with" in line
    assert not Path("canary").exists()
    assert airl(monkeypatch, *words, "--trust") == 2
    assert Path("canary").exists()  # The file does run code.


TOLD = """
description = "told of its own decisions"

[environment]
arena = "no-obstacles"
in_flight = ["command", "latency"]
"""


def test_what_a_network_is_told_is_told_by_a_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = ObservationSpec.model_validate(SPEC.model_dump() | {"in_flight": ("command", "latency")})
    make_model("PPO", spec=told).save(tmp_path / "model.zip")
    (tmp_path / "told.toml").write_text(TOLD)
    words = (
        "export",
        "--trust",
        tmp_path / "model.zip",
        "--algorithm",
        "PPO",
        "--out",
        tmp_path / "p",
    )
    assert airl(monkeypatch, *words) == 2
    line = capsys.readouterr().err
    assert "What in_flight tells is told by --like CONFIGURATION" in line
    assert airl(monkeypatch, *words, "--like", tmp_path / "told.toml") == 0
    assert load_card(tmp_path / "p").observation == told


def test_a_zip_says_its_image_and_kind_of_actions_itself(
    zips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("export", "--trust", zips / "sac.zip", "--algorithm", "SAC", "--out", tmp_path / "p")
    assert airl(monkeypatch, *words) == 0
    card = read_card(tmp_path / "p")
    assert (card.observation.width_px, card.observation.height_px) == (32, 24)
    assert card.actions.set == "velocity"


NETS = """
import torch
from torch import nn

class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.dense = nn.Linear(6, 2)

    def forward(self, depth, velocity, goal):
        nearest = depth.flatten(1).amin(dim=1, keepdim=True) / 255.0
        return torch.tanh(self.dense(torch.cat([velocity, goal], dim=1))) * nearest

class OfADict(Net):
    def forward(self, seen):
        return super().forward(seen["depth"], seen["velocity"], seen["goal"])

def make_net():
    return Net()

number = 3

def make_number():
    return number

class Needy(Net):
    def __init__(self, width):
        super().__init__()

class Narrow(Net):
    def forward(self, depth, velocity, goal):
        return super().forward(depth, velocity, goal)[:, :1]
"""


@pytest.mark.parametrize("name", ["make_net", "OfADict"])
@pytest.mark.parametrize("layout", ["body", "own"])
def test_a_module_of_one_s_own_flies_as_it_decides(
    name: str, layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Match inputs to argument names: a custom layout swaps goal and velocity."""
    (tmp_path / "nets.py").write_text(NETS)
    (tmp_path / "layouts.py").write_text(OWN_LAYOUT)
    spec = SPEC
    if layout == "own":
        layout = f"{tmp_path / 'layouts.py'}:Metric"
        spec = ObservationSpec.model_validate(SPEC.model_dump() | {"layout": layout})
    torch.manual_seed(3)
    trained = nn.Linear(6, 2)
    weights = {f"dense.{key}": value for key, value in trained.state_dict().items()}
    torch.save(weights, tmp_path / "net.pt")
    words = ("--weights", tmp_path / "net.pt", "--like", "dynamic-obstacles", "--hold-s", "0.3")
    source, out = f"{tmp_path / 'nets.py'}:{name}", tmp_path / "mine"
    assert airl(monkeypatch, "export", source, "--layout", layout, "--out", out, *words) == 0
    card = load_card(out, trust=True)
    # From the configuration, except for the options given.
    assert (card.actions.set, card.hold_s, card.training.arena) == (
        "velocity",
        0.3,
        "dynamic-obstacles",
    )
    assert card.observation == spec
    seen = noise(20)
    both = np.concatenate([seen["velocity"], seen["goal"]], axis=1)
    with torch.no_grad():
        wanted = torch.tanh(trained(torch.from_numpy(both))).numpy()
    wanted *= seen["depth"].reshape(20, -1).min(axis=1, keepdims=True) / np.float32(255.0)
    runtime = open_model(out, card, trust=True)
    np.testing.assert_allclose(runtime.infer(seen), wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("model", "options", "words"),
    [
        ("nets.py:absent", [], "accepted: a torch.nn.Module, or what makes one"),
        ("nets.py:make_number", [], "accepted: a torch.nn.Module, or what makes one"),
        ("nets.py:Needy", [], "cannot be made without arguments: .* missing 1 required"),
        ("absent.py:Net", [], "absent.py: no such file"),
        ("nets.py:Net", ["--weights", "none.pt"], "--weights none.pt: no such file"),
        ("nets.py:Net", ["--weights", "nets.py"], "--weights nets.py: not the module's: "),
        ("nets.py:Net", ["--weights", "other.pt"], "not the module's: .*[Mm]issing key"),
        (
            "nets.py:Net",
            ["--like", "nowhere"],
            "no training profile 'nowhere'; shipped: body-rates",
        ),
        ("nets.py:Narrow", ["--actions", "velocity"], "outputs action .*accepted: action"),
        ("model.zip", [], "algorithm: accepted: the class that wrote the .zip"),
        ("model.zip", ["--algorithm", "PPO", "--weights", "o.pt"], "with a module of your own"),
    ],
)
def test_a_module_that_cannot_be_exported_is_refused_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    model: str,
    options: list[str],
    words: str,
) -> None:
    (tmp_path / "nets.py").write_text(NETS)
    torch.save({"other.weight": torch.zeros(2)}, tmp_path / "other.pt")
    monkeypatch.chdir(tmp_path)
    assert airl(monkeypatch, "export", model, "--out", "out", *options) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(words, line)
    assert not (tmp_path / "out").exists()


def test_a_policy_is_copied_to_fly_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "every-frame"
    words = ("export", "crowded", "--out", str(out))
    assert airl(monkeypatch, *words, "--decisions", "pipelined", "--altitude-m", "3") == 0
    card, before = load_card(out), read_card(ROOT / "profiles/policies/crowded")
    changed = {"name": "every-frame", "decisions": "pipelined", "altitude_m": 3.0, "results": ()}
    assert dict(card) == dict(before) | changed
    capsys.readouterr()
    assert airl(monkeypatch, *words, "--actions", "arc-25") == 2
    assert "--actions arc-25: accepted: of a policy that is there" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("model", "options", "words"),
    [
        ("none.zip", ["--algorithm", "DQN"], ["none.zip: no such file"]),
        ("text.zip", ["--algorithm", "DQN"], ["text.zip: not a .zip"]),
        ("empty.zip", ["--algorithm", "DQN"], ["empty.zip: not a model of DQN"]),
        ("sac.zip", ["--algorithm", "DQN"], ["sac.zip: not a model of DQN"]),
        ("dqn.zip", ["--algorithm", "oracle"], ["algorithm 'oracle'", "DQN", "PPO", "QRDQN"]),
        (
            "dqn.zip",
            ["--algorithm", "DQN", "--image", "64x48"],
            ["observation space depth uint8 (1, 24, 32)", "depth uint8 (1, 48, 64)"],
        ),
        (
            "dqn.zip",
            ["--algorithm", "DQN", "--actions", "velocity"],
            ["action space Discrete(25)", "Box(-1.0, 1.0, (2,), float32)"],
        ),
        ("seven.zip", ["--algorithm", "A2C"], ["action space Discrete(7)", "Discrete(25)"]),
        (
            "five.zip",
            ["--algorithm", "TD3", "--actions", "velocity"],
            ["action space Box(-5.0, 5.0, (2,), float32)", "Box(-1.0, 1.0, (2,), float32)"],
        ),
        ("dqn.zip", ["--algorithm", "DQN", "--image", "32"], ["--image 32:", "WIDTHxHEIGHT"]),
        (
            "dqn.zip",
            ["--algorithm", "DQN", "--image", "2x2"],
            ["--image 2x2: width_px 2", "4 <= value"],
        ),
        (
            "dqn.zip",
            ["--algorithm", "DQN", "--layout", "paper", "--image", "32x10"],
            ["height_px = 10", "more than 10"],
        ),
        (
            "dqn.zip",
            ["--algorithm", "DQN", "--horizontal-fov-deg", "200"],
            ["--horizontal-fov-deg 200", "< 170"],
        ),
        ("dqn.zip", ["--algorithm", "DQN", "--range-m", "100"], ["--range-m 100", "<= 65 m"]),
        ("dqn.zip", ["--algorithm", "DQN", "--max-speed-m-s", "0"], ["--max-speed-m-s 0", "m/s"]),
        (
            "dqn.zip",
            ["--algorithm", "DQN", "--hold-s", "-1"],
            ["--hold-s -1", "0 <= value <= 10 s"],
        ),
        ("dqn.zip", ["--algorithm", "DQN", "--epsilon", "1.5"], ["--epsilon 1.5", "value <= 1"]),
        ("dqn.zip", ["--algorithm", "DQN", "--name", "a b"], ["--name a b"]),
        (
            "sac.zip",
            ["--algorithm", "SAC", "--actions", "velocity", "--epsilon", "0.1"],
            ["epsilon = 0.1", "0 with the action set 'velocity'"],
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_what_cannot_be_exported_is_refused_in_one_line(
    zips: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    model: str,
    options: list[str],
    words: list[str],
) -> None:
    out = tmp_path / "out"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        code = airl(monkeypatch, "export", "--trust", zips / model, "--out", out, *options)
    printed = capsys.readouterr()
    assert code == 2
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("error: ")
    for word in words:
        assert word in line
    assert not out.exists()


def test_out_that_is_a_file_is_refused(
    zips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.write_text("mine")
    code = airl(
        monkeypatch, "export", "--trust", zips / "dqn.zip", "--algorithm", "DQN", "--out", out
    )
    assert code == 2
    assert f"{out}: not a folder" in capsys.readouterr().err
    assert out.read_text() == "mine"

"""Checkpoints: bit-identical resume, completeness after a kill, detection of damage."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

from airl_mav.core.errors import UsageError
from airl_mav.training.algorithms import make_model
from airl_mav.training.checkpoint import load_latest, save_checkpoint
from airl_mav.training.config import ALGORITHMS, AlgorithmSpec, NetworkSpec
from tests.support.toy_fleet import ToyFleet

ROOT = Path(__file__).resolve().parents[2]
VEHICLES = 4
REPLAYING = {"buffer_size": 300, "learning_starts": 40, "batch_size": 8}
FIELDS: dict[str, dict[str, Any]] = {
    # The ring has gone round before the checkpoint.
    "dqn": REPLAYING | {"target_interval": 130, "exploration_fraction": 0.9},
    "ppo": {"batch_size": 32, "options": {"n_steps": 16, "n_epochs": 2}},
    "a2c": {},
    "recurrent-ppo": {
        "batch_size": 32,
        "options": {"n_steps": 8, "n_epochs": 2, "lstm_hidden_size": 8},
    },
    # Rings of stable-baselines3 that have gone round, too.
    "qr-dqn": REPLAYING | {"buffer_size": 100},
    "sac": REPLAYING | {"buffer_size": 100},
    "tqc": REPLAYING | {"buffer_size": 100},
    "td3": REPLAYING,
}
TOTAL = {"dqn": 1000, "ppo": 64 * 8, "recurrent-ppo": 32 * 8, "qr-dqn": 400}
OTHERS = 200


def fresh(name: str, seed: int = 3, **changes: Any) -> Any:
    vehicles = changes.pop("vehicles", VEHICLES)
    network = changes.pop("network", NetworkSpec())
    spec = AlgorithmSpec(**({"name": name} | FIELDS[name] | changes))
    env = ToyFleet(vehicles, continuous=ALGORITHMS[name].actions == "continuous")
    return make_model(spec, network, env, seed)


class SaveOnce(BaseCallback):
    """Saves between two rollouts, halfway."""

    def __init__(self, folder: Path, at: int) -> None:
        super().__init__()
        self.folder, self.at = folder, at

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self.at and not self.folder.exists():
            save_checkpoint(self.folder, self.model, {"note": [1, "two"]})

    def _on_step(self) -> bool:
        return True


def everything(model: Any) -> dict[str, np.ndarray]:
    """Weights, target weights and the optimisers' moments, by name."""
    found = {}

    def walk(path: str, value: object) -> None:
        if isinstance(value, torch.Tensor):
            found[path] = value.detach().numpy()
        elif isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{path}/{key}", inner)

    walk("", model.get_parameters())
    found["counters"] = np.array([model.num_timesteps, model._n_updates, model._episode_num])
    found["successes"] = np.array(model.ep_success_buffer)
    return found


def resume(name: str, folder: Path) -> dict[str, np.ndarray]:
    model = fresh(name, seed=99)
    assert load_latest(folder, model) == {"note": [1, "two"]}
    assert model.num_timesteps < TOTAL.get(name, OTHERS)
    model.learn(TOTAL.get(name, OTHERS) - model.num_timesteps, reset_num_timesteps=False)
    return everything(model)


def straight(name: str, folder: Path) -> dict[str, np.ndarray]:
    """Train to the end, saving on the way."""
    model = fresh(name)
    model.learn(TOTAL.get(name, OTHERS), callback=SaveOnce(folder, TOTAL.get(name, OTHERS) // 2))
    return everything(model)


def assert_same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> None:
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)


@pytest.mark.nightly
def test_a_run_goes_on_in_another_process_bit_for_bit(tmp_path: Path) -> None:
    """With DQN: test_training.py."""
    name = "ppo"
    folder, out = tmp_path / "checkpoints", tmp_path / "resumed.npz"
    expected = straight(name, folder)
    done = subprocess.run(
        [sys.executable, __file__, name, str(folder), str(out)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert_same(expected, dict(np.load(out)))


# One learner of each kind; the others keep their learning state like one of these.
EVERY_TIME = {"dqn", "qr-dqn", "recurrent-ppo", "sac"}


@pytest.mark.parametrize(
    "name",
    [
        *sorted(EVERY_TIME),
        *(
            pytest.param(name, marks=pytest.mark.nightly)
            for name in sorted(FIELDS.keys() - EVERY_TIME - {"ppo"})
        ),
    ],
)
def test_other_learners_go_on_bit_for_bit(name: str, tmp_path: Path) -> None:
    expected = straight(name, tmp_path / "checkpoints")
    random.random(), np.random.rand(), torch.rand(1)  # noqa: NPY002
    assert_same(expected, resume(name, tmp_path / "checkpoints"))


@pytest.mark.parametrize(
    "name", ["ppo", pytest.param("recurrent-ppo", marks=pytest.mark.nightly), "sac"]
)
def test_noise_that_depends_on_the_state_goes_on(name: str, tmp_path: Path) -> None:
    """gSDE draws before a rollout begins, which is when a checkpoint is written."""
    total = TOTAL.get(name, OTHERS)
    options = FIELDS[name].get("options", {}) | {"use_sde": True, "sde_sample_freq": 5}

    def noisy(seed: int) -> Any:
        spec = AlgorithmSpec(**({"name": name} | FIELDS[name] | {"options": options}))
        return make_model(spec, NetworkSpec(), ToyFleet(VEHICLES, continuous=True), seed)

    straight = noisy(3)
    straight.learn(total, callback=SaveOnce(tmp_path / "checkpoints", total // 2))
    resumed = noisy(99)
    load_latest(tmp_path / "checkpoints", resumed)
    resumed.learn(total - resumed.num_timesteps, reset_num_timesteps=False)
    assert_same(everything(straight), everything(resumed))


@pytest.mark.parametrize("name", ["dqn", "ppo"])
def test_saving_changes_nothing(name: str, tmp_path: Path) -> None:
    saved = straight(name, tmp_path / "checkpoints")
    model = fresh(name)
    model.learn(TOTAL.get(name, OTHERS))
    assert_same(saved, everything(model))


# --- on the disk


def marked(model: Any, mark: int) -> None:
    """Make weights and replay recognisable."""
    with torch.no_grad():
        for weights in model.policy.parameters():
            weights.fill_(mark)
    model.replay._actions[:] = mark


def started() -> Any:
    model = fresh("dqn")
    model.learn(60)
    return model


def assert_whole(model: Any, mark: int) -> None:
    assert all((weights == mark).all() for weights in model.policy.parameters())
    actions = model.replay.get_state()["actions"]
    assert len(actions) == 15
    assert (actions == mark).all()


def in_child(job: Callable[[], None]) -> int:
    """Run a job in a forked process and return its wait status."""
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1]
    try:
        job()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def test_kill_at_any_file_operation_leaves_a_whole_checkpoint(tmp_path: Path) -> None:
    model, reader = started(), fresh("dqn")
    for mark in (1, 2):
        marked(model, mark)
        save_checkpoint(tmp_path, model, {"mark": mark})
    seen = set()
    for mark in range(3, 100):
        marked(model, mark)

        def save_and_die(mark: int = mark) -> None:
            left = mark - 2

            def hook(event: str, _: object) -> None:
                nonlocal left
                if event in {"open", "os.rename", "os.remove", "os.rmdir", "os.mkdir"}:
                    left -= 1
                    if left == 0:
                        os.kill(os.getpid(), signal.SIGKILL)

            sys.addaudithook(hook)
            save_checkpoint(tmp_path, model, {"mark": mark})

        status = in_child(save_and_die)
        assert os.WIFSIGNALED(status) or status == 0
        for path in tmp_path.glob("checkpoint-*[0-9]"):
            assert len(list(path.iterdir())) == 4
        if mark % 2:
            (tmp_path / "latest").unlink(missing_ok=True)
        meta = load_latest(tmp_path, reader)
        assert meta is not None
        assert_whole(reader, meta["mark"])
        if status == 0:
            break
        seen.add(meta["mark"] == mark)
    assert status == 0
    assert meta is not None
    assert meta["mark"] == mark
    # It was killed before and after the new one counted.
    assert seen == {False, True}
    assert len(list(tmp_path.glob("checkpoint-*"))) == 2


def test_kill_at_any_time_leaves_a_whole_checkpoint(tmp_path: Path) -> None:
    model, reader = started(), fresh("dqn")
    marked(model, 0)
    save_checkpoint(tmp_path, model, {"mark": 0})
    rng = np.random.default_rng(0)
    kills = first = 0
    # On a busy machine some children die before they have saved anything.
    while kills < 12 or first < 4:

        def save_for_ever(first: int = first) -> None:
            for mark in range(first + 1, 10_000):
                marked(model, mark)
                save_checkpoint(tmp_path, model, {"mark": mark})

        child = os.fork()
        if not child:
            try:
                save_for_ever()
            finally:
                os._exit(1)
        time.sleep(rng.uniform(0.01, 0.2))
        os.kill(child, signal.SIGKILL)
        assert os.WIFSIGNALED(os.waitpid(child, 0)[1])
        kills += 1
        meta = load_latest(tmp_path, reader)
        assert meta is not None
        first = meta["mark"]
        assert_whole(reader, first)


@pytest.fixture
def two(tmp_path: Path) -> tuple[Path, Any]:
    """Return a folder with two checkpoints, marked 1 and 2, and a learner to load into."""
    model = started()
    for mark in (1, 2):
        marked(model, mark)
        save_checkpoint(tmp_path, model, {"mark": mark})
    return tmp_path, model


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


DAMAGE = {
    "flipped weights": lambda p: flip(p / "weights.pt"),
    "flipped arrays": lambda p: flip(p / "arrays.npz"),
    "flipped state": lambda p: flip(p / "state.json"),
    "cut arrays": lambda p: os.truncate(p / "arrays.npz", 100),
    "no weights": lambda p: (p / "weights.pt").unlink(),
    "no manifest": lambda p: (p / "manifest.json").unlink(),
    "empty manifest": lambda p: (p / "manifest.json").write_text(""),
    "other manifest": lambda p: (p / "manifest.json").write_text("[1]"),
    "binary manifest": lambda p: (p / "manifest.json").write_bytes(b"\xff\xfe\x00"),
    "partial manifest": lambda p: (p / "manifest.json").write_text('{"schema": 1, "files": {}}'),
    "other schema": lambda p: (p / "manifest.json").write_text('{"schema": 7, "files": {}}'),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damage_is_told_and_the_one_before_is_used(
    two: tuple[Path, Any], damage: Callable[[Path], object]
) -> None:
    folder, model = two
    damage(folder / "checkpoint-000002")
    told: list[str] = []
    assert load_latest(folder, model, told.append) == {"mark": 1}
    assert_whole(model, 1)
    assert len(told) == 1
    assert "checkpoint-000002: damaged checkpoint, not used: " in told[0]
    assert "\n" not in told[0]
    # The damaged checkpoint is not counted: two complete checkpoints stay.
    marked(model, 3)
    save_checkpoint(folder, model, {"mark": 3})
    assert load_latest(folder, model, told.append) == {"mark": 3}
    flip(folder / "checkpoint-000002" / "weights.pt")
    assert load_latest(folder, model, told.append) == {"mark": 1}


def test_damage_is_a_warning_by_default(two: tuple[Path, Any]) -> None:
    folder, model = two
    flip(folder / "checkpoint-000002" / "state.json")
    with pytest.warns(UserWarning, match="state.json has changed since it was written"):
        load_latest(folder, model)


def test_all_damaged_is_refused_for_good(two: tuple[Path, Any]) -> None:
    folder, model = two
    for path in folder.glob("checkpoint-*"):
        flip(path / "weights.pt")
    for _ in range(2):
        with pytest.raises(UsageError, match="every checkpoint is damaged"):
            load_latest(folder, model, lambda _: None)


def test_none_yet(tmp_path: Path) -> None:
    assert load_latest(tmp_path / "nothing", started()) is None


@pytest.mark.parametrize("pointer", [b"", b"checkpoint-000077\n", b"\xff\x00", None])
def test_without_its_pointer_the_newest_is_found(
    two: tuple[Path, Any], pointer: bytes | None
) -> None:
    folder, model = two
    (folder / "latest").unlink()
    if pointer is not None:
        (folder / "latest").write_bytes(pointer)
    assert load_latest(folder, model) == {"mark": 2}


def test_two_stay_and_the_pointer_names_the_newest(two: tuple[Path, Any]) -> None:
    folder, model = two
    save_checkpoint(folder, model, {"mark": 3})
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["checkpoint-000002", "checkpoint-000003", "latest"]
    assert (folder / "latest").read_text() == "checkpoint-000003\n"


@pytest.mark.parametrize(
    "other",
    [
        {"network": NetworkSpec(kind="appendix", strides=(1, 1, 1, 1))},
        {"vehicles": 5},
        {"n_step": 20, "vehicles": 8},
    ],
)
def test_another_configuration_is_refused(two: tuple[Path, Any], other: dict[str, Any]) -> None:
    folder, _ = two
    with pytest.raises(UsageError, match="a checkpoint of another configuration: ") as refusal:
        load_latest(folder, fresh("dqn", **other))
    assert "\n" not in str(refusal.value)


def test_another_algorithm_is_refused(two: tuple[Path, Any]) -> None:
    folder, _ = two
    with pytest.raises(UsageError, match="a checkpoint of another configuration: "):
        load_latest(folder, fresh("ppo"))


def test_nothing_needs_unpickling(two: tuple[Path, Any]) -> None:
    folder, _ = two
    path = folder / "checkpoint-000002"
    torch.load(path / "weights.pt", weights_only=True)
    with np.load(path / "arrays.npz", allow_pickle=False) as archive:
        assert all(archive[name].dtype != object for name in archive)
        filled = len(archive["replay/rewards"])
    state = json.loads((path / "state.json").read_text())
    # Only what the memory holds is written: 60 steps of 4 vehicles.
    assert filled == state["learner"]["counters"]["num_timesteps"] // VEHICLES == 15


if __name__ == "__main__":
    arrays: dict[str, Any] = {**resume(sys.argv[1], Path(sys.argv[2]))}
    np.savez(sys.argv[3], **arrays)

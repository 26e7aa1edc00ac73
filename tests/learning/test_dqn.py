"""Replay against a list of episodes, double DQN against hand calculation and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.logger import configure

from airl_mav.training.algorithms import make_model
from airl_mav.training.config import AlgorithmSpec, NetworkSpec
from airl_mav.training.dqn import DoubleDQN, NStepReplay
from tests.support.toy_fleet import ToyFleet

SHAPES: dict[str, tuple[tuple[int, ...], np.dtype[Any]]] = {
    "depth": ((1, 2, 2), np.dtype(np.uint8)),
    "goal": ((3,), np.dtype(np.float32)),
}
ON, DEAD, LATE = 0, 1, 2


def seen(numbers: Any) -> dict[str, np.ndarray]:
    """Return a distinct observation for each number."""
    numbers = np.asarray(numbers)
    depth = np.broadcast_to((numbers % 251)[..., None, None, None], (*numbers.shape, 1, 2, 2))
    goal = np.stack([numbers, numbers / 2, -numbers], axis=-1)
    return {"depth": depth.astype(np.uint8), "goal": goal.astype(np.float32)}


class Told:
    """The same steps as a plain list for each vehicle."""

    def __init__(self, vehicles: int) -> None:
        self.steps: list[list[tuple[Any, ...]]] = [[] for _ in range(vehicles)]

    def add(
        self,
        now: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        ends: np.ndarray,
        last: np.ndarray,
    ) -> None:
        for vehicle, steps in enumerate(self.steps):
            steps.append(
                (now[vehicle], actions[vehicle], rewards[vehicle], ends[vehicle], last[vehicle])
            )

    def chain(
        self, vehicle: int, start: int, n_step: int, gamma: float
    ) -> tuple[int, float, float, int | None]:
        """Return (action, return, discount, number of the next observation or None)."""
        steps = self.steps[vehicle]
        total = 0.0
        for k in range(n_step):
            _, _, reward, end, last = steps[start + k]
            total += gamma**k * reward
            if end == DEAD:
                return steps[start][1], total, 0.0, None
            if end == LATE:
                return steps[start][1], total, gamma ** (k + 1), last
        return steps[start][1], total, gamma**n_step, steps[start + n_step][0]


def fill(memory: NStepReplay, vehicles: int, steps: int, seed: int, ending: float) -> Told:
    """Store random steps and return them as a list; observations are numbered consecutively."""
    rng = np.random.default_rng(seed)
    told = Told(vehicles)
    count = 0
    for _ in range(steps):
        now = np.arange(count, count + vehicles)
        last = now + vehicles * 100_000
        count += vehicles
        ends = rng.choice([ON, DEAD, LATE], vehicles, p=[1 - ending, ending / 2, ending / 2])
        actions, rewards = rng.integers(25, size=vehicles), rng.normal(size=vehicles)
        infos = [
            {"terminal_observation": seen(last[i]), "TimeLimit.truncated": bool(ends[i] == LATE)}
            if ends[i] != ON
            else {}
            for i in range(vehicles)
        ]
        memory.add(seen(now), actions, rewards, ends != ON, infos)
        told.add(now, actions, rewards, ends, last)
    return told


def check(memory: NStepReplay, told: Told, steps: int, n_step: int, gamma: float) -> None:
    """Every transition that can be sampled is the one of the list."""
    first = max(0, steps - memory.rows)
    vehicles = memory.vehicles
    assert len(memory) == max(min(steps, memory.rows) - n_step, 0) * vehicles
    pairs = [(s, v) for s in range(first, steps - n_step) for v in range(vehicles)]
    if not pairs:
        return
    starts, who = np.array(pairs).T
    batch = memory.transitions(starts % memory.rows, who)
    for i, (start, vehicle) in enumerate(pairs):
        action, total, discount, following = told.chain(vehicle, start, n_step, gamma)
        assert batch.actions[i] == action
        assert batch.returns[i] == pytest.approx(total, rel=1e-5, abs=1e-5)
        assert batch.discounts[i] == pytest.approx(discount, rel=1e-6)
        expected = seen(told.steps[vehicle][start][0])
        for key in SHAPES:
            np.testing.assert_array_equal(batch.observations[key][i], expected[key])
            if following is not None:
                np.testing.assert_array_equal(batch.next_observations[key][i], seen(following)[key])


@given(
    vehicles=st.integers(1, 5),
    capacity=st.integers(1, 60),
    n_step=st.integers(1, 6),
    steps=st.integers(1, 70),
    ending=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    seed=st.integers(0, 1000),
)
def test_transitions_are_those_of_the_episodes(
    vehicles: int, capacity: int, n_step: int, steps: int, ending: float, seed: int
) -> None:
    memory = NStepReplay(capacity, vehicles, SHAPES, n_step, gamma=0.9)
    told = fill(memory, vehicles, steps, seed, ending)
    check(memory, told, steps, n_step, 0.9)


@given(steps=st.integers(1, 40), more=st.integers(0, 30), seed=st.integers(0, 1000))
def test_state_goes_over_to_another_memory(steps: int, more: int, seed: int) -> None:
    first = NStepReplay(50, 2, SHAPES, 3, 0.9)
    fill(first, 2, steps, seed, 0.3)
    second = NStepReplay(50, 2, SHAPES, 3, 0.9)
    second.set_state({key: array.copy() for key, array in first.get_state().items()})
    for memory in (first, second):
        fill(memory, 2, more, seed + 1, 0.3)
    a, b = first.get_state(), second.get_state()
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key])


def test_state_of_another_size_is_refused() -> None:
    state = NStepReplay(50, 2, SHAPES, 3, 0.9).get_state()
    with pytest.raises(ValueError, match="does not fit"):
        NStepReplay(50, 3, SHAPES, 3, 0.9).set_state(state)


def test_samples_are_uniform() -> None:
    memory = NStepReplay(40, 4, SHAPES, 3, 0.9)
    fill(memory, 4, 17, 0, 0.2)
    drawn = memory.sample(20_000, np.random.default_rng(0)).observations["goal"][:, 0]
    values, counts = np.unique(drawn, return_counts=True)
    # The newest ten steps of four vehicles that have three more behind them.
    np.testing.assert_array_equal(values, np.arange(4 * 4, 14 * 4))
    assert np.abs(counts - 500).max() < 5 * np.sqrt(500)


def test_memory_for_last_observations_does_not_leak() -> None:
    memory = NStepReplay(40, 4, SHAPES, 3, 0.9)
    fill(memory, 4, 300, 0, 1.0)
    assert len(memory.get_state()["last/goal"]) <= 2 * memory.rows * 4


def learner(vehicles: int = 4, **fields: Any) -> DoubleDQN:
    spec = AlgorithmSpec(**({"batch_size": 16, "learning_starts": 0} | fields))
    model = make_model(spec, NetworkSpec(), ToyFleet(vehicles), seed=0)
    assert isinstance(model, DoubleDQN)
    model.set_logger(configure(None, []))
    return model


@pytest.mark.parametrize("double", [True, False])
def test_one_update_is_the_one_by_hand(double: bool) -> None:
    model = learner(double=double, n_step=2, gamma=0.9)
    model.learn(200)
    with torch.no_grad():
        for weights in model.q_net_target.parameters():
            weights.add_(0.05 * torch.randn(weights.shape))
    batch = model.replay.sample(64, model.generator)

    def values(net: torch.nn.Module, observations: dict[str, np.ndarray]) -> np.ndarray:
        with torch.no_grad():
            return net({k: torch.from_numpy(v) for k, v in observations.items()}).numpy()

    later = values(model.q_net_target, batch.next_observations)
    online = values(model.q_net, batch.next_observations)
    best = (online if double else later).argmax(1)
    # The two rules must differ, or this shows nothing.
    assert (online.argmax(1) != later.argmax(1)).any()
    target = batch.returns + batch.discounts * later[np.arange(64), best]
    error = np.abs(values(model.q_net, batch.observations)[np.arange(64), batch.actions] - target)
    huber = np.where(error < 1, 0.5 * error**2, error - 0.5).mean()
    assert model._update(batch) == pytest.approx(huber, rel=1e-5)


@pytest.mark.parametrize("vehicles", [1, 5, 32, 100])
def test_intervals_count_steps_of_single_vehicles(
    vehicles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = learner(vehicles, env_steps_per_update=32, target_interval=500)
    copies = []
    monkeypatch.setattr("airl_mav.training.dqn.polyak_update", lambda *_: copies.append(1))
    updates = []

    def update(_: object) -> float:
        updates.append(1)
        return 0.0

    monkeypatch.setattr(model, "_update", update)
    model.learn(3200)
    steps = model.num_timesteps
    assert len(copies) == steps // 500
    skipped = (model.learning_starts + vehicles) // 32 + 1
    assert steps // 32 - skipped <= len(updates) <= steps // 32
    assert model._n_updates == len(updates)


def test_vehicles_explore_each_for_itself() -> None:
    model = learner(200)
    model.learn(400)
    model.exploration_rate = 0.25
    shares = []
    assert isinstance(model._last_obs, dict)
    greedy = model.q_net({k: torch.from_numpy(v) for k, v in model._last_obs.items()}).argmax(1)
    for _ in range(50):
        actions, _ = model._sample_action(0, n_envs=200)
        shares.append((actions != greedy.numpy()).mean())
    # Of three actions a random one differs from the greedy one in two cases of three.
    assert np.mean(shares) == pytest.approx(0.25 * 2 / 3, abs=0.02)
    assert min(shares) > 0 and max(shares) < 0.5


def test_same_seed_same_weights() -> None:
    runs = [learner() for _ in range(2)]
    for model in runs:
        model.learn(600)
    for a, b in zip(runs[0].policy.parameters(), runs[1].policy.parameters(), strict=True):
        assert torch.equal(a, b)


class Endless(ToyFleet):
    """Vehicles at rest with reward 1 a step; episodes of five steps terminate or are truncated."""

    def __init__(self, vehicles: int, *, dies: bool) -> None:
        super().__init__(vehicles)
        self.dies = dies

    def step_wait(self) -> Any:
        self.time = self.time + 1
        self.place = self.time.copy()
        done = self.time >= 5
        last = self._seen()
        infos = [
            {
                "terminal_observation": {k: v[i] for k, v in last.items()},
                "TimeLimit.truncated": not self.dies,
            }
            for i in range(self.num_envs)
        ]
        self.time[done] = self.place[done] = 0
        return self._seen(), np.ones(self.num_envs, np.float32), done, infos


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("n_step", "dies"),
    [
        (3, True),
        pytest.param(1, False, marks=pytest.mark.nightly),
        pytest.param(1, True, marks=pytest.mark.nightly),
        pytest.param(3, False, marks=pytest.mark.nightly),
    ],
)
def test_values_converge_to_the_closed_form(n_step: int, dies: bool) -> None:
    spec = AlgorithmSpec(
        learning_rate=3e-3,
        gamma=0.7,
        batch_size=32,
        buffer_size=400,
        learning_starts=40,
        n_step=n_step,
        env_steps_per_update=5,
        target_interval=150,
    )
    env = Endless(5, dies=dies)
    model = make_model(spec, NetworkSpec(), env, seed=0)
    assert isinstance(model, DoubleDQN)
    model.learn(3000)
    env.time = env.place = np.arange(5)
    now = {k: torch.from_numpy(v) for k, v in env._seen().items()}
    with torch.no_grad():
        values = model.q_net(now).max(1).values.numpy()
    left = 5 - np.arange(5)
    # Termination: the sum of the remaining rewards. Truncation: the task continues forever.
    expected = (1 - 0.7**left) / 0.3 if dies else np.full(5, 1 / 0.3)
    np.testing.assert_allclose(values, expected, rtol=0.08)


def test_bfloat16_learns_with_float32_weights() -> None:
    model = learner(precision="bfloat16")
    model.learn(400)
    assert model._n_updates > 0
    assert all(w.dtype == torch.float32 for w in model.policy.parameters())
    assert isinstance(model.action_space, spaces.Discrete)

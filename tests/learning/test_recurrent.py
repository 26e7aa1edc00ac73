"""A policy with a memory in flight: each flight has its own, from its first decision on."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav import Scenario, rehearse
from airl_mav.envs.evaluation import LearnedPilots, SinglePilots, fly_episodes, fly_seeds
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.experiments.gym_flier import environment_of
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.actions import ActionSpec, command, commands
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.observation import Observation
from airl_mav.policy.observation_spec import ObservationSpec, SeenCamera
from airl_mav.policy.registry import LearnedPolicy, load_learned
from airl_mav.scenario.aircraft import Ports
from airl_mav.training.algorithms import policy_arguments
from airl_mav.training.config import NetworkSpec
from airl_mav.training.export import export_sb3
from airl_mav.training.onnx_export import GreedyDecisions
from tests.support.lockstep_kit import demo_scenario
from tests.support.policy_kit import facts, make_model
from tests.support.ports import choose_ports

SEEDS = (1, 2, 3, 4, 5)
SMOOTH = (2, 3, 4, 6, 7)
"""Flights without a pixel on an edge, where rounding of 1e-7 changes the depth and the flight."""
HOLD_S = 0.4
SHAPE = ObservationSpec(height_px=24, width_px=32, horizontal_fov_deg=90.0, range_m=20.0)


@pytest.fixture(scope="module")
def model() -> Any:
    kwargs = {"lstm_hidden_size": 12}
    return make_model("RecurrentPPO", "velocity", spec=SHAPE, n_steps=8, policy_kwargs=kwargs)


@pytest.fixture(scope="module")
def policy(model: Any, tmp_path_factory: pytest.TempPathFactory) -> LearnedPolicy:
    folder = tmp_path_factory.mktemp("policy") / "dreamer"
    export_sb3(model, facts(name="dreamer", actions=ActionSpec(set="velocity")), folder)
    return load_learned(folder)


@pytest.fixture(scope="module")
def spec() -> EnvironmentSpec:
    episode = {"time_limit_s": 12.0, "hold_s": HOLD_S, "goal_radius_m": 2.5, "altitude_m": 2.0}
    arena = {"arena": "dynamic-obstacles", "actions": "velocity"}
    return spec_of(None, {**arena, "episode": episode})


def fresh(policy: LearnedPolicy) -> LearnedPolicy:
    return policy.with_generator(np.random.default_rng(0))


class Recorded:
    """The companion's policy, with a record of its observations and actions."""

    def __init__(self, policy: LearnedPolicy, seen: list[Any], done: list[Any]) -> None:
        self.policy, self.seen, self.done = policy, seen, done

    def act(self, observation: Observation) -> Any:
        action = self.policy.act(observation)
        self.seen.append(observation)
        self.done.append(action)
        return action


def test_the_twin_flies_as_the_companion_bit_for_bit(
    policy: LearnedPolicy, spec: EnvironmentSpec
) -> None:
    """More flights than slots: a slot's memory must not outlive its flight."""
    together = fly_seeds(
        Navigation(spec, 2), LearnedPilots(policy, lambda _: np.random.default_rng(0)), SEEDS
    )
    alone = fly_seeds(Navigation(spec, 1), SinglePilots(lambda: fresh(policy), 30.0), SEEDS)
    by_seed = {flown.seed: flown for _, flown in together}
    assert by_seed == {flown.seed: flown for _, flown in alone}
    assert len(by_seed) == len(SEEDS)


def test_the_memory_decides(policy: LearnedPolicy, spec: EnvironmentSpec) -> None:
    """Or the test before would pass without any."""

    class Forgetful(LearnedPilots):
        def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
            for i in range(len(flying)):
                self.begin(i, 0)
            return super().decide(seen, flying)

    kinds = (LearnedPilots, Forgetful)
    flown = [
        next(fly_seeds(Navigation(spec, 1), kind(policy, np.random.default_rng), [1]))[1]
        for kind in kinds
    ]
    assert flown[0].distance_m != flown[1].distance_m


def test_the_selection_flies_as_the_export(
    model: Any, policy: LearnedPolicy, spec: EnvironmentSpec
) -> None:
    """The learner's own decisions in training, two slots for five flights."""
    decide = GreedyDecisions(model)
    learner = {
        each.seed: each for each in fly_episodes(spec, decide, SMOOTH, slots=2, began=decide.began)
    }
    pilots = LearnedPilots(policy, np.random.default_rng)
    for _, flown in fly_seeds(Navigation(spec, 2), pilots, SMOOTH):
        assert learner[flown.seed].decisions == flown.decisions
        assert learner[flown.seed].distance_m == pytest.approx(flown.distance_m, rel=1e-5)


def test_what_was_seen_before_is_kept_alike_in_twin_and_companion(tmp_path: Path) -> None:
    """Compare stacks of three images: in lockstep, the images of the previous decisions."""
    shape = SHAPE.model_copy(update={"frames": 3})
    velocity = ActionSpec(set="velocity")
    stacked = make_model("PPO", "velocity", spec=shape, n_steps=8, batch_size=8)
    folder = tmp_path / "stacked"
    export_sb3(stacked, facts(name="stacked", actions=velocity, observation=shape), folder)
    policy = load_learned(folder)
    scenario = demo_scenario(policy=str(folder), time_limit_s=5.0)
    seen: list[Observation] = []
    fly(scenario, Recorded(policy, seen, []), 0, 1)
    navigation = Navigation(environment_of(scenario), 1)
    navigation.begin([0], [1])
    twin: list[Observation] = []
    for _ in range(4):
        twin.append(deepcopy(navigation.see()))
        chosen = policy.act_batch(encode_layout(shape, twin[-1]))
        assert policy.act(twin[-1].rows(0)) == command(velocity, chosen[0])
        navigation.fly(commands(velocity, chosen))
    for flight in (seen, [each.rows(0) for each in twin]):
        assert len(flight) > 3
        for k, each in enumerate(flight):
            before = flight[max(k - 2, 0) : k][::-1]
            for kept, image in zip(each.earlier_mm, before, strict=False):
                np.testing.assert_array_equal(kept, image.depth_mm)
            # The simulator pads missing images with zeros; the companion keeps more than required.
            assert all((kept == 0).all() for kept in each.earlier_mm[k:])


def test_a_companion_begins_each_flight_with_nothing_in_mind(model: Any, tmp_path: Path) -> None:
    """Feed observations recorded in lockstep over MAVLink to the model: it repeats the actions."""
    folder = tmp_path / "dreamer"
    export_sb3(model, facts(name="dreamer", actions=ActionSpec(set="velocity")), folder)
    scenario = demo_scenario(policy=str(folder), time_limit_s=5.0)
    for seed in (1, 2):
        seen: list[Observation] = []
        done: list[Any] = []
        begun = scenario.fresh_policy(seed)
        assert isinstance(begun, LearnedPolicy)
        fly(scenario, Recorded(begun, seen, done), 0, seed)
        assert len(done) > 5
        # A new policy object, as in a restarted companion, repeats the decisions.
        again = scenario.fresh_policy(seed)
        assert [again.act(each) for each in seen] == done


@pytest.mark.nightly
def test_a_policy_with_a_memory_flies_in_a_companion_of_its_own(model: Any, tmp_path: Path) -> None:
    """Level sitl: the companion is another process, which has ONNX Runtime and no torch."""
    folder = tmp_path / "dreamer"
    export_sb3(model, facts(name="dreamer", actions=ActionSpec(set="velocity")), folder)
    ports = choose_ports()
    asked = Scenario(
        level="sitl",
        policy=str(folder),
        arena="no-obstacles",
        episodes=1,
        time_limit_s=6.0,
        ports=Ports(
            api_port=ports.api,
            api_local_port=ports.api_local,
            gcs_port=ports.gcs,
            gcs_local_port=ports.gcs_local,
            camera_port=ports.camera,
        ),
    )
    run = rehearse(asked, out=tmp_path / "run")
    (episode,) = run.episodes
    assert episode.outcome in (Outcome.TIMEOUT, Outcome.SUCCESS, Outcome.COLLISION)
    setpoints = run.stamps[0]["setpoint"]
    assert len(setpoints) > 5
    # Each image leads to a new decision, which is flown.
    assert np.ptp(setpoints[:, 0]) > 0.0
    assert np.isfinite(setpoints).all()


@pytest.mark.nightly
def test_a_memory_of_what_several_cameras_saw(tmp_path: Path) -> None:
    """The export decides as the learner, and each image counts."""
    left = SeenCamera(height_px=24, width_px=32, horizontal_fov_deg=90.0, range_m=10.0)
    shape = SHAPE.model_copy(update={"cameras": {"left": left}})
    kwargs = {"lstm_hidden_size": 12, **policy_arguments(NetworkSpec())}
    made = make_model("RecurrentPPO", "velocity", spec=shape, n_steps=8, policy_kwargs=kwargs)
    actions = ActionSpec(set="velocity")
    card = export_sb3(made, facts(name="two", actions=actions, observation=shape), tmp_path)
    assert set(card.state) == {"hidden", "cell"}
    spec = spec_of(None, {"vehicle": "quad-rig", "actions": "velocity", "cameras": {"left": {}}})
    twin, decide = Navigation(spec, 2), GreedyDecisions(made)
    exported = load_learned(tmp_path)
    twin.begin([0, 1], [1, 2])
    for slot in range(2):
        decide.began(slot)
    for _ in range(3):
        seen = twin.observe()
        assert seen.keys() == {"depth", "velocity", "goal", "depth_left"}
        blind = {**seen, "depth_left": 255 - seen["depth_left"]}
        assert not np.array_equal(fresh(exported).act_batch(seen), fresh(exported).act_batch(blind))
        chosen = exported.act_batch(seen)
        np.testing.assert_allclose(chosen, decide(seen), atol=1e-4)
        twin.fly(commands(actions, chosen))

"""Rewards by hand: the numbers are worked out in the comments."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.envs.fleet import FlightArrays, FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.rewards import Step, costs, reward_of
from airl_mav.envs.spec import Costs, EnvironmentSpec
from airl_mav.envs.vector import NavigationVectorEnv

NEARER, AWAY, GOAL, CRASH, FAST, STILL = range(6)
HOLD_S = 0.5


def flights(distance_m: list[float], speed_m_s: list[float], **verdicts: int) -> FlightArrays:
    """Return flights in progress, except for vehicles with a verdict, given by its name."""
    n = len(distance_m)
    verdict = np.full(n, FlightStatus.FLYING, np.int64)
    for name, i in verdicts.items():
        verdict[i] = FlightStatus[name]
    return FlightArrays(
        verdict=verdict,
        time_s=np.zeros(n),
        distance_m=np.zeros(n),
        energy_j=np.zeros(n),
        goal_distance_m=np.array(distance_m),
        speed_m_s=np.array(speed_m_s),
        battery=np.ones(n),
        touched=np.zeros(n, np.int64),
    )


def rewards(
    name: str, before: FlightArrays, now: FlightArrays, hold_s: float
) -> NDArray[np.float64]:
    return reward_of(name)(Step(before, now, np.zeros((len(now.verdict), 3)), hold_s))


BEFORE = flights([20.0, 20.0, 4.0, 20.0, 20.0, 20.0], [0.0] * 6)
NOW = flights(
    [18.0, 21.0, 2.5, 18.0, 16.0, 20.0],
    [4.0, 2.0, 3.0, 4.0, 7.0, 0.0],
    SUCCESS=GOAL,
    COLLISION=CRASH,
)


@pytest.mark.parametrize(
    ("name", "case", "expected"),
    [
        # +-1 at the end, 0.02 a metre of progress, -0.005 a decision.
        ("shaped", NEARER, 0.02 * 2.0 - 0.005),
        ("shaped", AWAY, -0.02 * 1.0 - 0.005),
        ("shaped", GOAL, 1.0 + 0.02 * 1.5 - 0.005),
        ("shaped", CRASH, -1.0 + 0.02 * 2.0 - 0.005),
        ("shaped", FAST, 0.02 * 4.0 - 0.005),
        ("shaped", STILL, -0.005),
        # 1000 a - 1000 b - D_g + g (5 m/s - V) 0.5 s, with g = 1 only when nearer than before.
        ("paper", NEARER, -18.0 + 0.5 * 1.0),
        ("paper", AWAY, -21.0),
        ("paper", GOAL, 1000.0 - 2.5 + 0.5 * 2.0),
        ("paper", CRASH, -1000.0 - 18.0 + 0.5 * 1.0),
        ("paper", FAST, -16.0 - 0.5 * 2.0),
        ("paper", STILL, -20.0),
        ("paper-scaled", NEARER, -0.0175),
        ("paper-scaled", GOAL, 0.9985),
        ("paper-scaled", CRASH, -1.0175),
    ],
)
def test_by_hand(name: str, case: int, expected: float) -> None:
    assert rewards(name, BEFORE, NOW, HOLD_S)[case] == pytest.approx(expected, abs=1e-12)


def test_the_paper_s_correction_rewards_slowness_on_the_way_to_the_goal() -> None:
    """Its text calls D_c a penalty; its formula adds it when nearer, less of it when faster."""
    paid = rewards("paper", BEFORE, NOW, HOLD_S) + NOW.goal_distance_m
    slow, fast = paid[[NEARER, FAST]]
    assert slow > 0 > fast


def test_shaped_pays_progress_once_whatever_the_steps() -> None:
    """The progress terms of a flight telescope: no reward for flying to and fro."""
    way = [30.0, 25.0, 27.0, 22.0, 10.0, 12.0, 2.0]
    before, now = flights(way[:-1], [0.0] * 6), flights(way[1:], [0.0] * 6)
    assert rewards("shaped", before, now, HOLD_S).sum() == pytest.approx(0.02 * 28.0 - 6 * 0.005)


def test_failures_are_collisions_and_empty_batteries_not_timeouts() -> None:
    spec = EnvironmentSpec(arena="no-obstacles")
    navigation = Navigation(spec, 5)
    navigation.begin(range(5), range(5))
    before = navigation.flights()
    # Flying, success, collision, battery, timeout.
    now = before._replace(verdict=np.arange(5))
    found = rewards("shaped", before, now, spec.episode.hold_s)
    assert found.round().tolist() == [0.0, 1.0, -1.0, -1.0, 0.0]


@pytest.mark.parametrize("name", ["shaped", "paper", "paper-scaled"])
def test_the_environment_pays_what_the_formula_says(name: str) -> None:
    """Distances and speeds from telemetry that anybody can read in the observation."""
    env = NavigationVectorEnv(
        3, reward=name, arena="no-obstacles", randomisation={"navigation_noise": 0.0}
    )
    _, info = env.reset(seed=[1, 2, 3])
    distance = info["goal_distance_m"]
    for _ in range(6):
        seen, reward, terminated, truncated, info = env.step(np.array([22, 20, 7]))
        assert not (terminated | truncated).any()
        speed = 5.0 * np.linalg.norm(seen["velocity"].astype(np.float64), axis=1)
        now = info["goal_distance_m"]
        expected = {
            "shaped": 0.02 * (distance - now) - 0.005,
            "paper": -now + (now < distance) * (5.0 - speed) * 0.5,
            "paper-scaled": (-now + (now < distance) * (5.0 - speed) * 0.5) / 1000.0,
        }[name]
        assert reward == pytest.approx(expected, abs=1e-5)
        assert seen["goal"][:, 2] * 20.0 == pytest.approx(now, abs=1e-4)
        distance = now


def test_costs_by_hand() -> None:
    """A command that turns by a right angle at 3 and 4 m/s is a step of 5 m/s."""
    last = np.array([[3.0, 0.0, 0.5], [1.0, 0.0, 0.0]])
    chosen = np.array([[0.0, 4.0, -0.5], [1.0, 0.0, 0.0]])
    before, now = flights([9.0, 9.0], [0.0, 0.0]), flights([8.0, 8.0], [1.0, 1.0])
    now.energy_j[:] = 100.0, 50.0
    weights = Costs(command_step=0.01, turn_step=0.1, energy=2.0)
    step = Step(before, now, chosen, HOLD_S)
    found = costs(weights, last, step)
    assert found == pytest.approx([0.05 + 0.1 + 0.2, 0.1])
    assert not costs(Costs(), last, step).any()


def test_a_failure_costs_what_it_is_said_to() -> None:
    """A collision and an empty battery; not the goal, not the end of time."""
    before, now = flights([9.0] * 5, [0.0] * 5), flights([8.0] * 5, [1.0] * 5)
    ends = ("FLYING", "SUCCESS", "COLLISION", "BATTERY", "TIMEOUT")
    now.verdict[:] = [FlightStatus[name] for name in ends]
    still = np.zeros((5, 3))
    found = costs(Costs(failure=2.5), still, Step(before, now, still, HOLD_S))
    assert found.tolist() == [0.0, 0.0, 2.5, 2.5, 0.0]


def test_the_environment_takes_the_costs_off_its_reward() -> None:
    """Flown alike, with and without; a flight's first command differs from none."""
    paid = {}
    weights = {"command_step": 0.01, "turn_step": 0.2, "energy": 0.5}
    for name, costly in (("dear", weights), ("free", {})):
        env = NavigationVectorEnv(2, arena="no-obstacles", costs=costly)
        _, info = env.reset(seed=[1, 2])
        rows = []
        # arc-25: 3.5 m/s straight on; at a stand with 72 deg/s to the right; the same again.
        for action in (17, 4, 4):
            before_j = info["energy_j"]
            _, reward, *_, info = env.step(np.array([action, action]))
            rows.append(np.stack([reward, info["energy_j"] - before_j]))
        paid[name] = np.array(rows)
    taken, drawn_kj = paid["free"][:, 0] - paid["dear"][:, 0], paid["free"][:, 1] / 1000.0
    steps = np.array([0.01 * 3.5, 0.01 * 3.5 + 0.2 * np.radians(72.0), 0.0])
    assert taken == pytest.approx(steps[:, None] + 0.5 * drawn_kj)
    assert (drawn_kj > 0.01).all()

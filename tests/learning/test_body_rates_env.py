"""The batch twin commanded by body rates: as an environment, and as a companion would fly it."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import airl_mav.envs  # noqa: F401 (registers the environments)
from airl_mav.control.demand import KIND_US
from airl_mav.core.constants import TICK_US, US_PER_MS, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import quats_to_euler
from airl_mav.envs.decision import (
    RATES_FOLLOWED_US,
    FrameTimes,
    Timing,
    expire,
    new_decision,
    next_stretch,
    take,
)
from airl_mav.envs.faults import delays_of
from airl_mav.envs.fleet import ROWS, FlightStatus, new_fleet
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.rewards import Step, reward_of
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from companion.mavsdk_link import OFFBOARD_SETTLE_S

KNOBS: dict[str, Any] = {
    "arena": "no-obstacles",
    "actions": "body-rates",
    "decisions": "pipelined",
    "in_flight": ["tilt", "rates", "height", "setpoint"],
}
HOVER = (0.0, 0.0, 0.0, 0.5)


def spec(**more: Any) -> EnvironmentSpec:
    return spec_of(None, KNOBS | more)


def begun(n: int, **more: Any) -> Navigation:
    navigation = Navigation(spec(**more), n)
    navigation.begin(range(n), range(1, n + 1))
    return navigation


def tilts(navigation: Navigation) -> np.ndarray:
    roll, pitch, _ = quats_to_euler(navigation.fleet.quaternion)
    return np.hypot(roll, pitch)


def test_the_environment_keeps_to_gymnasiums_rules() -> None:
    env = gym.make("airl/Navigation-v0", **KNOBS)
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
    observation, _ = env.reset(seed=1)
    assert observation["in_flight"].shape == (3 + 3 + 1 + 4,)
    # Level, at rest, 2.5 m high, and nothing was commanded.
    expected = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(observation["in_flight"], expected, atol=0.05)
    check_env(env.unwrapped, skip_render_check=True)


def test_body_rates_are_followed_as_late_as_by_px4() -> None:
    """Until then the velocity is flown with which the companion has entered Offboard: zero."""
    settled_us = round(OFFBOARD_SETTLE_S * US_PER_S)
    assert KIND_US - settled_us == RATES_FOLLOWED_US
    navigation, turning = begun(3), np.tile((1.5, 0.0, 0.0, 0.5), (3, 1))
    followed = np.full(3, -1)
    for _ in range(25):
        navigation.fly(turning)
        turned = (tilts(navigation) > 0.05) & (followed < 0)
        followed[turned] = navigation.fleet.time_us[turned]
    assert (followed > RATES_FOLLOWED_US).all()
    assert (followed < RATES_FOLLOWED_US + 200_000).all()
    assert (navigation.fleet.omega[:, 0] > 1.3).all()


def test_what_is_commanded_turns_as_commanded() -> None:
    rates = np.array([[0.8, 0, 0, 0.5], [0, -0.8, 0, 0.5], [0, 0, 0.8, 0.5], [0, 0, 0, 0.6]])
    navigation = begun(4)
    for _ in range(24):
        navigation.fly(rates)
    omega = navigation.fleet.omega
    np.testing.assert_allclose(omega, rates[:, :3], atol=0.08)
    assert navigation.fleet.velocity[3, 2] < -0.3, "more thrust climbs"
    assert navigation.fleet.by_rates.all()


class Clockwork:
    """Vehicles in the middle of a long decision, where only time advances."""

    def __init__(self, n: int) -> None:
        frames = FrameTimes(np.zeros(n, np.int64), 33_333, 5_000, delays_of([]))
        timing = Timing(True, TICK_US, 500_000, -1, 38, 2.5, delays_of([]), frames)
        self.fleet, self._decision = new_fleet(n), new_decision(timing, np.zeros((n, 9)))
        self._state = np.zeros((ROWS, 1))
        self._decision.tick[:], self._decision.events[:] = 1 << 30, 1

    def fly(self, until_ms: int) -> tuple[float, bool, tuple[float, ...]]:
        self._decision.pause_us[:] = until_ms * US_PER_MS
        for i in range(len(self.fleet.time_us)):
            while ticks := next_stretch(self._decision, self.fleet, i, self._state, 0):
                self.fleet.time_us[i] += TICK_US * ticks
        return self.told()

    def take(self, setpoint: tuple[float, ...]) -> None:
        for i in range(len(self.fleet.time_us)):
            take(self._decision, self.fleet, np.array(setpoint), i, self._state, 0)

    def expire(self, i: int) -> None:
        expire(self._decision, self.fleet, i, self._state, 0)

    def told(self, i: int = 0) -> tuple[float, bool, tuple[float, ...]]:
        """Return the time [ms], True for body rates, and the current setpoint of vehicle i."""
        fleet = self.fleet
        return fleet.time_us[i] / US_PER_MS, bool(fleet.by_rates[i]), tuple(fleet.setpoint[i])


def test_kinds_of_setpoints_are_followed_when_px4_publishes_its_control_mode() -> None:
    vehicles = Clockwork(2)
    turn, end, stand = (0.1, 0.2, 0.3, 0.6), (0.0, 0.0, 0.0, 0.6), (0.0, 0.0, 0.0, 0.0)
    vehicles.fly(100)
    vehicles.take(turn)
    assert vehicles.told() == (100.0, False, stand)
    # Not before the tick that begins then.
    assert vehicles.fly(400) == (400.0, False, stand)
    assert vehicles.fly(404) == (404.0, True, turn)
    vehicles.expire(0)
    assert vehicles.told() == (404.0, True, end)
    assert vehicles.told(1) == (404.0, True, turn)
    assert vehicles.fly(904) == (904.0, False, stand)
    assert vehicles.told(1) == (904.0, True, turn)
    vehicles.take(turn)
    assert vehicles.fly(1400) == (1400.0, False, stand)
    # Two changes in one go, of which the first is the other's.
    assert vehicles.fly(3000) == (3000.0, True, turn)
    assert vehicles.told(1) == (3000.0, True, turn)


def stands(navigation: Navigation) -> list[bool]:
    """Return who has come to stand after two seconds of hovering by body rates, one tilted."""
    tilted = (0.6, 0.0, 0.0, 0.52)
    for _ in range(22):
        navigation.fly(np.tile(tilted, (navigation.n, 1)))
    navigation._extra_us[:] = 1_200_000
    navigation.fly(np.tile(tilted, (navigation.n, 1)))
    return (tilts(navigation) < 0.1).tolist()


def test_overdue_body_rates_are_replaced_by_a_stand() -> None:
    """Apply the companion watchdog's timeout; `decision_timeout_s` changes it."""
    assert stands(begun(2)) == [True, True]
    rules = {"decision_timeout_s": 3.0}
    assert stands(begun(2, episode=rules)) == [False, False]


def test_a_saved_stall_goes_on_as_it_was() -> None:
    whole, first = begun(3), begun(3)
    for navigation in (whole, first):
        stands(navigation)
    second = Navigation(spec(), 3)
    second.set_state(first.get_state())
    for navigation in (whole, second):
        navigation._extra_us[:] = 40_000
        for _ in range(20):
            navigation.fly(np.tile((0.3, 0.1, 0.2, 0.55), (3, 1)))
    np.testing.assert_array_equal(second.fleet.quaternion, whole.fleet.quaternion)
    np.testing.assert_array_equal(second.fleet.by_rates, whole.fleet.by_rates)


def test_an_expired_command_is_a_hover_by_velocity() -> None:
    """Hover like the companion: zero body rates would keep the tilt."""
    rules = {"hold_s": 0.1, "hover_after_s": 0.0}
    navigation = begun(2, decisions="sequential", episode=rules, delay={"native_ms": 400.0})
    for _ in range(3):
        navigation.fly(np.tile((0.6, 0.0, 0.0, 0.52), (2, 1)))
    # Now the next decision takes 0.4 s: the last command has expired long before.
    most = 0.0
    for _ in range(3):
        navigation.fly(np.tile(HOVER, (2, 1)))
        most = max(most, float(tilts(navigation).max()))
    assert navigation.fleet.verdict.tolist() == [FlightStatus.FLYING] * 2
    assert most < 0.3


def test_a_saved_flight_goes_on_as_it_was() -> None:
    rng = np.random.default_rng(1)
    actions = rng.uniform([-1, -1, -1, 0.4], [1, 1, 1, 0.6], (40, 3, 4))
    whole, first = begun(3), begun(3)
    for chosen in actions:
        whole.fly(chosen)
    for chosen in actions[:20]:
        first.fly(chosen)
    second = Navigation(spec(), 3)
    second.set_state(first.get_state())
    for chosen in actions[20:]:
        second.fly(chosen)
    np.testing.assert_array_equal(second.fleet.quaternion, whole.fleet.quaternion)
    np.testing.assert_array_equal(second.fleet.by_rates, whole.fleet.by_rates)


def test_a_checkpoint_of_velocities_has_nothing_of_body_rates() -> None:
    plain = Navigation(spec_of(None, {"arena": "no-obstacles"}), 2)
    plain.begin(range(2), (1, 2))
    assert "fleet.by_rates" not in plain.get_state()
    assert not any("by_rates" in name for name in plain.get_state())


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"compensate": True}, "compensate = True: accepted: False with actions 'body-rates'"),
        ({"costs": {"command_step": 0.1}}, "costs.command_step = 0.1: accepted: 0.0"),
        ({"safe_velocity": {"sensing_distance_m": 5}}, "safe_velocity"),
    ],
)
def test_what_is_of_velocities_is_refused(more: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        spec(**more)


def test_commands_are_four_numbers() -> None:
    navigation = begun(2)
    with pytest.raises(ValueError, match=r"\(2, 3\): accepted: \(2, 4\)"):
        navigation.fly(np.zeros((2, 3)))


def test_what_a_failure_costs_is_taken_off_any_reward() -> None:
    """Straight into the floor: 4 of the reward, and 6 more."""
    paid = []
    for failure in (0.0, 6.0):
        knobs = KNOBS | {"reward": "progress", "costs": {"failure": failure}}
        env = gym.make("airl/Navigation-v0", **knobs)
        env.reset(seed=1)
        ended, last = False, 0.0
        while not ended:
            _, reward, ended, truncated, _ = env.step(np.array([0.0, 0.0, 0.0, -1.0], np.float32))
            last = float(reward)
            assert not truncated
        paid.append(last)
    assert paid[0] < -3.5
    assert paid[0] - paid[1] == pytest.approx(6.0)


def test_the_reward_of_progress_by_hand() -> None:
    navigation = begun(2)
    before = navigation.flights()
    commands = np.array([(1.0, -2.0, 0.5, 0.5), HOVER])
    navigation.fly(commands)
    now = navigation.flights()
    found = reward_of("progress")(Step(before, now, commands, 0.5))
    nearer = before.goal_distance_m - now.goal_distance_m
    passed = now.time_s - before.time_s
    by_hand = 0.3 * nearer - 0.1 * passed - 0.002 * np.array([1.0 + 4.0 + 0.25, 0.0])
    np.testing.assert_allclose(found, by_hand)
    level = reward_of("progress")(Step(before, now, np.array([(3.0, 1.0, 2.0), (0, 0, 0)]), 0.5))
    np.testing.assert_allclose(level - found, [0.002 * (5.25 - 4.0), 0.0], atol=1e-12)
    assert math.isfinite(found.sum())


def test_the_reward_without_haste_by_hand() -> None:
    """Three vehicles as fast as 2, 8 and 20 m/s: 1, 2/3 and none of 4 m/s count."""
    navigation, fast = begun(3), np.array([2.0, 8.0, 20.0])
    before, commands = navigation.flights(), np.tile((0.0, 2.0, 0.0, 0.5), (3, 1))
    now = before._replace(time_s=before.time_s + 0.1, speed_m_s=fast)
    now = now._replace(goal_distance_m=before.goal_distance_m - 0.1 * fast)
    found = reward_of("paced")(Step(before, now, commands, 0.5))
    np.testing.assert_allclose(found, [0.3 * 0.2 - 0.008, 0.3 * 0.4 * 2 / 3 - 0.008, -0.008])
    ended = now._replace(
        verdict=np.array([FlightStatus.SUCCESS, FlightStatus.COLLISION, now.verdict[2]])
    )
    np.testing.assert_allclose(
        reward_of("paced")(Step(before, ended, commands, 0.5)) - found, [4.0, -4.0, 0.0]
    )

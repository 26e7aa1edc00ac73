"""Experts for imitation learning. Each decides for the flights of a batch twin, in its action set.

`greedy` is the classical baseline with the policy's observations. `planner` uses the true arena,
`gates` the true openings of its gates and computes its own actions (`GatePilot`). Other experts
choose among commands of the action set: all of a discrete set, or a fan of directions and speeds of
the continuous set.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.imitation.planner import Planner
from airl_mav.arena.gates import Openings, openings_of
from airl_mav.arena.geometry import Arena
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import ned_to_heading, quats_to_euler
from airl_mav.envs import sb3
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.saved_state import State
from airl_mav.policy.action_sets import VELOCITIES, VERTICAL, ActionSpec, commands, discrete_actions
from airl_mav.policy.actions import fastest_climb
from airl_mav.policy.greedy import GreedyPolicy, GreedySettings
from airl_mav.training.config import ExpertName

AHEAD_S = 0.4
"""Prediction time of the position [s]: about the dead time plus half the response time."""

GAIN_1_S = 1.0
"""Gain from lateral and vertical offset to an opening's middle to speed [1/s]."""

STANDOFF_M = 2.0
"""Waiting distance in front of a wall until the vehicle is lined up [m]."""

BEHIND_M = 0.4
"""Distance behind a wall, plus the vehicle's radius, at which to turn to the next gate [m]."""

MARGIN_M = 0.35
"""Gap to the frame at which full speed is reached [m]."""

NOWHERE = 1e6
"""North coordinate of a missing gate [m]."""


class GatePilot:
    """Pilot through gates for the flights of a batch twin."""

    def __init__(self, navigation: Navigation) -> None:
        """Store the flights.

        Raises:
            FieldError: The action set has no vertical speed, or is discrete.
        """
        actions = navigation.spec.action_spec
        if actions.set not in VELOCITIES or actions.set not in VERTICAL:
            accepted = ", ".join(name for name in VELOCITIES if name in VERTICAL)
            raise FieldError("environment.actions", actions.set, f"{accepted} with expert gates")
        self._navigation = navigation
        self._speed, self._climb = actions.max_speed_m_s, fastest_climb(actions.max_speed_m_s)
        self._middle = np.full((navigation.n, 1, 3), NOWHERE)
        self._half = np.ones((navigation.n, 1, 3))
        self._goal = np.zeros((navigation.n, 3))

    def begin(self, slots: Sequence[int]) -> None:
        """Read the arenas of episodes that start or resume in slots."""
        for i in slots:
            arena = self._navigation.arenas[i]
            assert arena is not None  # noqa: S101 (an episode has begun in it)
            self._put(i, openings_of(arena), arena)

    def _put(self, i: int, openings: Openings, arena: Arena) -> None:
        room = self._middle.shape[1]
        if (more := len(openings) + 1 - room) > 0:
            pad = ((0, 0), (0, more), (0, 0))
            self._middle = np.pad(self._middle, pad, constant_values=NOWHERE)
            self._half = np.pad(self._half, pad, constant_values=1.0)
        self._middle[i], self._half[i] = NOWHERE, 1.0
        self._middle[i, : len(openings)] = openings.center
        self._half[i, : len(openings)] = openings.half_size
        height_m = arena.goal_height_m
        if height_m is None:
            height_m = self._navigation.spec.episode.altitude_m
        self._goal[i] = (*arena.goal, -height_m)

    def decide(self) -> NDArray[np.float32]:
        """Return the actions (n, 3) for the present states."""
        fleet, _, vehicle = self._navigation.whole_truth()
        # Predicted position at which the new command acts.
        here = fleet.position + AHEAD_S * fleet.velocity
        _, _, yaw = quats_to_euler(fleet.quaternion)
        each = np.arange(len(here))
        reach = vehicle.radius + BEHIND_M
        # A gate counts as passed once the whole vehicle is behind it; gates are sorted northwards.
        passed = self._middle[:, :, 0] + self._half[:, :, 0] + reach < fleet.position[:, 0, None]
        gate = passed.sum(axis=1)
        middle, half = self._middle[each, gate], self._half[each, gate]
        off = middle[:, 1:] - here[:, 1:]
        room = half[:, 1:] - np.array([vehicle.radius, vehicle.half_height]) - MARGIN_M
        # 1 = lined up, 0 = outside the opening.
        share = np.abs(off) / np.maximum(room, 0.1)
        # Full speed while the offset uses up to two thirds of the room, none from four thirds on.
        lined_up = np.clip(2.0 - 1.5 * share.max(axis=1), 0.0, 1.0)
        before = middle[:, 0] - half[:, 0] - here[:, 0]
        waiting = np.clip(GAIN_1_S * (before - STANDOFF_M), -1.0, self._speed)
        wanted = np.empty_like(here)
        wanted[:, 0] = lined_up * self._speed + (1.0 - lined_up) * waiting
        wanted[:, 1:] = GAIN_1_S * off
        to_goal = GAIN_1_S * (self._goal - here)
        # Behind the last gate the goal is the target.
        wanted = np.where((middle[:, 0] >= NOWHERE)[:, None], to_goal, wanted)
        body = ned_to_heading(wanted, yaw)
        level = np.hypot(body[:, 0], body[:, 1])
        # Limit the horizontal speed, keep its direction.
        body[:, :2] *= np.minimum(1.0, self._speed / np.maximum(level, 1e-9))[:, None]
        body[:, :2] /= self._speed
        body[:, 2] = np.clip(body[:, 2] / self._climb, -1.0, 1.0)
        return body.astype(np.float32)


DIRECTIONS = 48
"""Number of directions in the fan."""

SPEEDS = (0.2, 0.5, 0.75, 1.0)
"""Speeds in the fan, relative to the maximum."""

TURN_M = 1.5
"""Weight of a yaw rate error: equivalent speed error [m/s] per 1 rad/s."""


class Choices(NamedTuple):
    """Candidate actions of an expert."""

    actions: NDArray[Any]
    """(c,) for a discrete set, (c, 2) for the continuous set."""
    commands: NDArray[np.float64]
    """(c, 3) corresponding commands: forward, right [m/s], yaw rate [rad/s]."""


def choices(spec: ActionSpec) -> Choices:
    """Return the candidate actions of an expert."""
    count = discrete_actions(spec)
    if spec.set in VERTICAL:
        accepted = "one without a vertical speed; with one, expert gates"
        raise FieldError("environment.actions", spec.set, accepted)
    if count is None and spec.set not in VELOCITIES:
        accepted = f"a discrete action set, or {' or '.join(map(repr, VELOCITIES))}"
        raise FieldError("environment.actions", spec.set, accepted)
    if count is not None:
        actions: NDArray[Any] = np.arange(count)
    else:
        course = np.arange(DIRECTIONS) * 2.0 * math.pi / DIRECTIONS
        fan = np.stack([np.cos(course), np.sin(course)], axis=1)
        still = np.zeros((1, 2))
        actions = np.concatenate([still, *(share * fan for share in SPEEDS)]).astype(np.float32)
    return Choices(actions, commands(spec, actions))


class Chooser(Protocol):
    """Interface of experts: decide for the flights of a batch twin."""

    def begin(self, slots: Sequence[int]) -> None:
        """Start episodes in slots."""

    def decide(self) -> NDArray[np.int64]:
        """Return the indices (n,) of the commands for the present states."""


class GreedyPilots:
    """Greedy baseline, one per flight; selects the nearest command. A `Chooser`."""

    def __init__(self, navigation: Navigation, known: NDArray[np.float64]) -> None:
        """Store the flights and the candidate commands (c, 3).

        Raises FieldError without a depth camera.
        """
        if navigation.camera.kind != "depth":
            accepted = f"planner with a camera of kind {navigation.camera.kind!r}"
            raise FieldError("expert", "greedy", accepted)
        self._navigation = navigation
        self._commands = known
        self._settings = GreedySettings(period_s=navigation.spec.episode.hold_s)
        self.pilots = [GreedyPolicy(self._settings) for _ in range(navigation.n)]

    def begin(self, slots: Sequence[int]) -> None:
        """Reset the pilots of starting episodes."""
        for i in slots:
            self.pilots[i] = GreedyPolicy(self._settings)

    def decide(self) -> NDArray[np.int64]:
        """Return the indices (n,) of the commands for the present observations."""
        seen = self._navigation.see()
        actions = [pilot.act(seen.rows(i)) for i, pilot in enumerate(self.pilots)]
        wanted = np.array([(a.forward_m_s, a.right_m_s, a.yaw_rate_rad_s) for a in actions])
        # Compare all commands with the wish; a yaw rate counts as an equivalent speed.
        off = (wanted[:, None] - self._commands) * (1.0, 1.0, TURN_M)
        nearest: NDArray[np.int64] = (off**2).sum(axis=2).argmin(axis=1)
        return nearest


class Expert(sb3.Expert):
    """Expert and its memory, with checkpoint support."""

    def __init__(self, name: ExpertName, navigation: Navigation) -> None:
        """Create an expert by name, for the flights of a batch twin."""
        self._navigation = navigation
        self._chooser: Planner | GreedyPilots | GatePilot
        self._choices: Choices | None = None
        if name == "gates":
            self._chooser = GatePilot(navigation)
        else:
            self._choices = choices(navigation.spec.action_spec)
            kind = Planner if name == "planner" else GreedyPilots
            self._chooser = kind(navigation, self._choices.commands)
        self._begun = np.zeros(navigation.n, np.bool_)
        self._sides = np.ones(navigation.n)

    def begin(self, slots: Sequence[int]) -> None:
        """Start episodes in slots."""
        self._begun[list(slots)] = True
        self._chooser.begin(slots)

    def decide(self) -> NDArray[Any]:
        """Return the actions of n vehicles for their present states, in a policy's format."""
        decided = self._chooser.decide()
        return decided if self._choices is None else self._choices.actions[decided]

    def _held(self) -> Mapping[str, Any]:
        if isinstance(self._chooser, GreedyPilots):
            self._sides[:] = [pilot.side for pilot in self._chooser.pilots]
        return {"begun": self._begun, "sides": self._sides}

    def set_state(self, state: State) -> None:
        """Restore a saved state; restore the flights first."""
        super().set_state(state)
        # The planner's maps and the gates' openings follow from the arenas, so they are not saved.
        self._chooser.begin(np.flatnonzero(self._begun).tolist())
        if isinstance(self._chooser, GreedyPilots):
            for pilot, side in zip(self._chooser.pilots, self._sides.tolist(), strict=True):
                pilot.side = side

"""Experts: who is imitated. Each decides for the flights of a batch twin, in its action set.

`greedy` is the classical baseline: it sees what a policy sees. `planner` knows the true arena,
`gates` the openings of its gates, for which it decides by itself (`GatePilot`). Another expert
chooses among commands of the action set: all of a discrete set, a fan of directions and
speeds of the continuous one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.gates import Openings, openings_of
from airl_mav.arena.geometry import Arena
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import ned_to_heading, quats_to_euler
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.planner import Planner
from airl_mav.envs.saved_state import State, Stateful
from airl_mav.envs.spec import ExpertName
from airl_mav.policy.action_sets import VELOCITIES, VERTICAL, ActionSpec, commands, discrete_actions
from airl_mav.policy.actions import fastest_climb
from airl_mav.policy.greedy import GreedyPolicy, GreedySettings

AHEAD_S = 0.4
"""How far ahead of the vehicle its place is taken: about its dead time and half its response."""

GAIN_1_S = 1.0
"""Speed per metre off the middle of an opening, sideways and vertically."""

STANDOFF_M = 2.0
"""Where it waits before a wall until it is lined up [m]."""

BEHIND_M = 0.4
"""So far behind the wall the vehicle turns to the next gate, its own radius added [m]."""

MARGIN_M = 0.35
"""Gap to the frame from which on it flies at full speed [m]."""

NOWHERE = 1e6
"""North of everything [m]: where there is no further gate."""


class GatePilot:
    """Decides for the flights of a batch twin."""

    def __init__(self, navigation: Navigation) -> None:
        """Take the flights.

        Raises:
            FieldError: The action set has no vertical speed, or is a discrete one.
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
        """Look at the arenas of the episodes that slots begin, or go on with."""
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
        here = fleet.position + AHEAD_S * fleet.velocity
        _, _, yaw = quats_to_euler(fleet.quaternion)
        each = np.arange(len(here))
        reach = vehicle.radius + BEHIND_M
        passed = self._middle[:, :, 0] + self._half[:, :, 0] + reach < fleet.position[:, 0, None]
        gate = passed.sum(axis=1)
        middle, half = self._middle[each, gate], self._half[each, gate]
        off = middle[:, 1:] - here[:, 1:]
        room = half[:, 1:] - np.array([vehicle.radius, vehicle.half_height]) - MARGIN_M
        # 1: lined up; 0: not within the opening at all.
        share = np.abs(off) / np.maximum(room, 0.1)
        lined_up = np.clip(2.0 - 1.5 * share.max(axis=1), 0.0, 1.0)
        before = middle[:, 0] - half[:, 0] - here[:, 0]
        waiting = np.clip(GAIN_1_S * (before - STANDOFF_M), -1.0, self._speed)
        wanted = np.empty_like(here)
        wanted[:, 0] = lined_up * self._speed + (1.0 - lined_up) * waiting
        wanted[:, 1:] = GAIN_1_S * off
        to_goal = GAIN_1_S * (self._goal - here)
        wanted = np.where((middle[:, 0] >= NOWHERE)[:, None], to_goal, wanted)
        body = ned_to_heading(wanted, yaw)
        level = np.hypot(body[:, 0], body[:, 1])
        body[:, :2] *= np.minimum(1.0, self._speed / np.maximum(level, 1e-9))[:, None]
        body[:, :2] /= self._speed
        body[:, 2] = np.clip(body[:, 2] / self._climb, -1.0, 1.0)
        return body.astype(np.float32)


DIRECTIONS = 48
"""Directions of the fan."""

SPEEDS = (0.2, 0.5, 0.75, 1.0)
"""Its speeds, as shares of the fastest."""

TURN_M = 1.5
"""How far off a yaw rate of 1 rad/s too much is, as a speed [m/s]."""


class Choices(NamedTuple):
    """Actions that an expert chooses from."""

    actions: NDArray[Any]
    """(c,) of a discrete set, (c, 2) of the continuous one."""
    commands: NDArray[np.float64]
    """(c, 3) what they command: forward, right [m/s], yaw rate [rad/s]."""


def choices(spec: ActionSpec) -> Choices:
    """Return the actions that an expert chooses from."""
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
    """Decides for the flights of a batch twin."""

    def begin(self, slots: Sequence[int]) -> None:
        """Episodes begin in slots."""

    def decide(self) -> NDArray[np.int64]:
        """Return the indices (n,) of the commands chosen for the present states."""


class GreedyPilots:
    """The baseline, one a flight; the nearest command to its own is chosen. A `Chooser`."""

    def __init__(self, navigation: Navigation, known: NDArray[np.float64]) -> None:
        """Take the flights, and the commands (c, 3) to choose from.

        Raises FieldError where they see no depth.
        """
        if navigation.camera.kind != "depth":
            accepted = f"planner with a camera of kind {navigation.camera.kind!r}"
            raise FieldError("expert", "greedy", accepted)
        self._navigation = navigation
        self._commands = known
        self._settings = GreedySettings(period_s=navigation.spec.episode.hold_s)
        self.pilots = [GreedyPolicy(self._settings) for _ in range(navigation.n)]

    def begin(self, slots: Sequence[int]) -> None:
        """Forget the flights before."""
        for i in slots:
            self.pilots[i] = GreedyPolicy(self._settings)

    def decide(self) -> NDArray[np.int64]:
        """Return the indices (n,) of the commands chosen for the present observations."""
        seen = self._navigation.see()
        actions = [pilot.act(seen.rows(i)) for i, pilot in enumerate(self.pilots)]
        wanted = np.array([(a.forward_m_s, a.right_m_s, a.yaw_rate_rad_s) for a in actions])
        off = (wanted[:, None] - self._commands) * (1.0, 1.0, TURN_M)
        nearest: NDArray[np.int64] = (off**2).sum(axis=2).argmin(axis=1)
        return nearest


class Expert(Stateful):
    """An expert with its memory, as a checkpoint keeps it."""

    def __init__(self, name: ExpertName, navigation: Navigation) -> None:
        """Take an expert by name, for the flights of a batch twin."""
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
        """Episodes begin in slots."""
        self._begun[list(slots)] = True
        self._chooser.begin(slots)

    def decide(self) -> NDArray[Any]:
        """Return the actions of n vehicles in their present states, as a policy gives them."""
        decided = self._chooser.decide()
        return decided if self._choices is None else self._choices.actions[decided]

    def _held(self) -> Mapping[str, Any]:
        if isinstance(self._chooser, GreedyPilots):
            self._sides[:] = [pilot.side for pilot in self._chooser.pilots]
        return {"begun": self._begun, "sides": self._sides}

    def set_state(self, state: State) -> None:
        """Restore a saved state; the flights' own has been restored before."""
        super().set_state(state)
        self._chooser.begin(np.flatnonzero(self._begun).tolist())
        if isinstance(self._chooser, GreedyPilots):
            for pilot, side in zip(self._chooser.pilots, self._sides.tolist(), strict=True):
                pilot.side = side

"""Experts: who is imitated. Each decides for the flights of a batch twin, in its action set.

`greedy` is the classical baseline: it sees what a policy sees. `planner` knows the true arena,
`gates` the openings of its gates, for which it decides by itself (`gate_pilot`). Another expert
chooses among commands of the action set: all of a discrete set, a fan of directions and
speeds of the continuous one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import FieldError
from airl_mav.envs.gate_pilot import GatePilot
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.planner import Planner
from airl_mav.envs.saved_state import State, Stateful
from airl_mav.envs.spec import ExpertName
from airl_mav.policy.action_sets import (
    VELOCITIES,
    VERTICAL,
    ActionSpec,
    commands,
    discrete_actions,
)
from airl_mav.policy.greedy import GreedyPolicy, GreedySettings

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
        ...

    def decide(self) -> NDArray[np.int64]:
        """Return the indices (n,) of the commands chosen for the present states."""
        ...


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
